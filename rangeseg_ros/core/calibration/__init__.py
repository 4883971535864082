"""The fixed distortion of a sensor, learned from the planes it sees."""
