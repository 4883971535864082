"""What PCD files hold, made by hand."""


def literal_lzf(data):
    """LZF of incompressible data: runs of at most 32 literal bytes."""
    runs = (data[i : i + 32] for i in range(0, len(data), 32))
    return b''.join(bytes([len(run) - 1]) + run for run in runs)
