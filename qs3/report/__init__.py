"""From runs to tables and pictures. Reads metrics.json and datasets; writes neither."""
