"""The rangeseg command."""
