"""Clouds that can be turned, in one HTML page that needs nothing else."""
