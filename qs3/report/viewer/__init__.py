"""Clouds that can be turned, in one HTML page that needs nothing else."""

COLOURS = ("height", "view", "residual", "class", "confidence")
MOST_CLOUDS, MOST_POINTS, MOST_IN_ALL = 500, 200_000, 3_000_000
"""Limits of a page, a cloud, and all clouds together: 8 bytes a point and what is known of it."""
