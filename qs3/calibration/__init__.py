"""Depth sensors held against known targets, and presets fitted to depth cameras."""
