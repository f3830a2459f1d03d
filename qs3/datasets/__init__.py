"""Published datasets and one's own: readers into the store, domains, downloads."""
