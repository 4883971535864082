"""What a measured point is to a robot that drives."""

UNKNOWN, GROUND, OBSTACLE, DROP = range(4)
"""Values of `Segmentation.terrain`: not measured or not known, ground, in the way, below."""
