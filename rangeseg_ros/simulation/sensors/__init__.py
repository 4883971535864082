"""Depth sensors behind one interface: true depth, camera and random numbers in, depth out."""
