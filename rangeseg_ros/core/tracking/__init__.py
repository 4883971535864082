"""Identities of planes over time."""
