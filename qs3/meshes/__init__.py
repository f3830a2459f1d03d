"""Meshes: files, folders of them, and how an object is placed."""
