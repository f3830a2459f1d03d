"""Point clouds in files. Nothing in them is trusted."""
