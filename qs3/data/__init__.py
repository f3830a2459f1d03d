"""Datasets: the store on disk, the domains, the importers of published files."""
