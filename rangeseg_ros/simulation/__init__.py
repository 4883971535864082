"""Simulated scenes and sensors with known truth."""
