"""A differentiable twin of the speckle-stereo sensor, and what it is used for."""
