"""Cameras, neighbours, sampling: pure functions that know nothing of data or nets."""
