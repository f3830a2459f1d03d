"""Published datasets, fetched when a person asks for one: python -m qs3.data.download.

Nothing in a run imports this package: training never downloads.
"""
