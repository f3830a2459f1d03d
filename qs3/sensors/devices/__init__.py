"""The depth sensors: one device, one file."""
