"""Depth sensors: patterns, cameras, matching, and the renderers behind them."""
