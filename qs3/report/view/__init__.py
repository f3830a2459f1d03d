"""`qs3 view`: clouds of files, datasets and runs on a page where they can be turned."""
