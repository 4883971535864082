"""The segmenter: arrays in, arrays out."""

from rangeseg_ros.core.runtime.cache import choose_cache

# Before any module with kernels is imported.
choose_cache()
