"""The segmenter: arrays in, arrays out."""
