"""Published datasets, fetched when a person asks for one: qs3 download.

Nothing in a run imports this package: training never downloads.
"""
