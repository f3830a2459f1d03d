"""Metrics, validators without labels, accuracy estimates, and what is unlike the source."""
