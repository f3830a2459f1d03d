"""A sensor preset from a few depth frames of a flat wall: `python -m qs3.sensors.fit --help`."""
