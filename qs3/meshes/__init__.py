"""Meshes: files, folders, and the embedded catalogue."""
