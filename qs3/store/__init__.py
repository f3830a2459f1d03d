"""Datasets on disk: arrays, manifest, description, and the parts of an unfinished one."""
