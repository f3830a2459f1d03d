"""A sensor preset from a few depth frames of a flat wall: `qs3 fit --help`."""
