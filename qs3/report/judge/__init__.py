"""Saved runs judged on an archive of real objects that nobody trained on.

intervals.py   accuracy with its interval: rooms as clusters, and seeds
judging.py     runs, objects, predictions, figures
text.py        the table for people, CSV and JSON
cli.py         the command: qs3 report judge --help
"""
