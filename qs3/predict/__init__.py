"""Classes of clouds in files, by a trained classifier: `python -m qs3.predict --help`."""
