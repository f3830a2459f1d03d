"""Cameras, neighbours, sampling: pure functions that know nothing of the rest of qs3."""
