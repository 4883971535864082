"""Method planes: surfaces grown from blocks, then every pixel labelled with its plane."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.growing import surfaces
from rangeseg_ros.core.moments import CHI2, COUNT, RATIO, block_moments, fit_all
from rangeseg_ros.core.range_image import RangeImage
from rangeseg_ros.core.refinement import Models, Problem, label_pixels, region_moments
from rangeseg_ros.core.sensor import SensorModel

BLOCK = 4
ROUNDS = 2
MIN_SEED = 250


def plane_labels(image, horizontal, vertical, sensor, lap=lambda s: None):
    inverse, rays = image.inverse, image.rays
    blocks = block_moments(inverse, rays, horizontal, vertical, BLOCK)
    lap('blocks')
    flat = blocks.reshape(-1, 12)
    whole = flat[flat[:, COUNT] == BLOCK * BLOCK]
    _, residual = fit_all(whole)
    mean = np.sqrt(whole[:, CHI2] / BLOCK**2)
    sensor = sensor.measured(mean, residual / (BLOCK**2 - 3))
    count = np.maximum(flat[:, COUNT], 1)
    level = np.sqrt(flat[:, CHI2] / count)
    variance = sensor.variance(level)
    flat[:, RATIO] = flat[:, COUNT] * sensor.systematic_variance(level) / np.maximum(variance, 1e-30)
    flat[:, :COUNT] /= np.maximum(variance, 1e-30)[:, None]
    weight = np.where(image.valid, 1 / np.maximum(sensor.variance(inverse), 1e-30), 0).astype(np.float32)
    ratio = (sensor.systematic_variance(inverse) * weight).astype(np.float32)
    lap('noise')
    links = block_links(horizontal, vertical, BLOCK)
    surface, moments = surfaces(blocks, links)
    keep = moments[:, COUNT] >= MIN_SEED
    keep[0] = True
    table = np.where(keep, np.cumsum(keep) - 1, 0)
    surface, moments = table[surface], moments[keep]
    lap('grow')
    problem = Problem(inverse, rays, weight, horizontal, vertical)
    for _ in range(ROUNDS):
        models = Models.of(moments)
        labels, value = label_pixels(problem, surface, models, BLOCK)
        moments = region_moments(labels, len(moments), inverse, rays, weight, ratio, np.zeros_like(weight))
    lap('label')
    return labels, value, sensor


def block_links(horizontal, vertical, size):
    """Which neighbouring blocks at least half of the pixels along their border connect."""
    right = horizontal[:, size - 1 :: size] > 0
    below = vertical[size - 1 :: size] > 0
    rows = -(-len(horizontal) // size)
    columns = -(-vertical.shape[1] // size)
    right = np.add.reduceat(right.astype(np.uint8), np.arange(0, len(right), size), axis=0)
    below = np.add.reduceat(below.astype(np.uint8), np.arange(0, below.shape[1], size), axis=1)
    return right[:, : columns - 1] * 2 >= size, below[: rows - 1] * 2 >= size
