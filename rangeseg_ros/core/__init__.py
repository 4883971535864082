"""The segmenter: arrays in, arrays out."""

from rangeseg_ros.kernel_cache import choose_cache

# Before any module with kernels is imported.
choose_cache()
