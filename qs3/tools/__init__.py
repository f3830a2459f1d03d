"""Quickstart, doctor, and a toy problem for demonstrations."""
