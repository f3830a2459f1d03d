"""Every command, a typed function."""
