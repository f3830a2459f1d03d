"""Light and lenses that the devices share: patterns, cameras, lamps, who sees whom."""
