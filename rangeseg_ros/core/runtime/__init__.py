"""Compiled kernels and threads: how kernels run, apart from what they compute."""
