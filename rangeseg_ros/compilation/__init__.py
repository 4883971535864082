"""Kernels compiled ahead of the first frame, by several processes."""
