"""Point clouds in files. Used by whatever reads or writes clouds; knows of no dataset."""
