"""Compiled kernels, threads and memory: how kernels run, apart from what they compute."""
