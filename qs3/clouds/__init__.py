"""Point clouds in files. Imports nothing of qs3 but its errors."""
