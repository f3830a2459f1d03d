"""Mesh2Point: place, view, scan, fuse, sample; workers and resume."""
