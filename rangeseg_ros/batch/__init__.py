"""Whole recordings, one after the other or many at once."""
