"""Backbones: clouds to features. One paper, one file."""
