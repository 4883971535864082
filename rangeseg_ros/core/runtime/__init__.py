"""Threads and memory: how kernels run, apart from what they compute."""
