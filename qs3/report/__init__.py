"""From runs to tables and pictures. Reads results and datasets, and makes none."""
