"""Planes through regions, with their uncertainty."""
