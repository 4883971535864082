"""Observed surface normals (H, W, 3), thesis 5.7: unit vectors towards the sensor, or NaN."""

from __future__ import annotations

import cv2
import numpy as np

from rangeseg_ros.core.arrays import Floats, Mask, Singles
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.sensing.grid import Grid
from rangeseg_ros.core.sensing.moments import COLUMNS, ROWS, SYMMETRIC, cofactors
from rangeseg_ros.core.sensing.range_image import RangeImage


def observed_normals(image: RangeImage, grid: Grid, config: Config) -> Singles:
    """Normals by the method that `config` names.

    With jump edges by plane deviation, which lie between pixels, there are none where a tangent
    crosses one.
    """
    if config.normals == 'plane_fit':
        return plane_fit(image, config.normal_radius)
    normals = cross_product(image, config.normal_baseline)
    if config.jump_edges == 'plane':
        reach = config.normal_baseline
        normals[_within(~grid.right, reach) | _within(~grid.below.T, reach).T] = np.nan
    return normals


def cross_product(image: RangeImage, baseline: int) -> Singles:
    """Cross product of the tangents between the neighbours of a pixel (thesis 5.7.1).

    Between those so many pixels to the left and right, above and below, which must be measured; 1
    in the thesis. The noise of the direction falls in proportion.
    """
    reach, (height, width) = baseline, image.shape
    u, v = np.zeros((2, height, width, 3))
    with np.errstate(divide='ignore', invalid='ignore'):
        points = np.where(image.valid[..., None], image.rays / image.inverse[..., None], np.nan)
    u[:, reach : width - reach] = points[:, 2 * reach :] - points[:, : -2 * reach]
    v[reach : height - reach] = points[2 * reach :] - points[: -2 * reach]
    x = u[..., 2] * v[..., 1] - u[..., 1] * v[..., 2]
    y = u[..., 0] * v[..., 2] - u[..., 2] * v[..., 0]
    z = u[..., 1] * v[..., 0] - u[..., 0] * v[..., 1]
    return _towards_sensor(np.stack([x, y, z], axis=-1), image)


def plane_fit(image: RangeImage, radius: int) -> Singles:
    """Plane of least squares in inverse range through 2 radius + 1 rows and columns (5.7.2).

    That is where the noise of structured light and stereo is constant. The plane n . p + d = 0 is
    linear in inverse range, (-n/d) . ray = inverse, so that the sums of the normal equations are
    box filters over the image.
    """
    rays = np.where(image.valid[..., None], image.rays, 0).astype(np.float64)
    products = _means(rays[..., ROWS] * rays[..., COLUMNS], radius)
    inverse = np.stack(cofactors(*np.moveaxis(products, 2, 0))[:6], axis=-1)[..., SYMMETRIC]
    right = _means(rays * image.inverse[..., None], radius)
    # Cramer's rule, without the determinant: the result is normalised anyhow.
    return _towards_sensor((inverse @ right[..., None])[..., 0], image, radius)


def _means(values: Floats, radius: int) -> Floats:
    """Means (H, W, n) over windows, as if 0 outside the image."""
    size = 2 * radius + 1, 2 * radius + 1
    means = cv2.boxFilter(values, -1, size, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(means, np.float64)


def _towards_sensor(normals: Floats, image: RangeImage, radius: int = 0) -> Singles:
    """Unit vectors against the rays; NaN for vectors without a direction and for windows that
    reach out of the image or hold a pixel that was not measured."""
    kernel = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    valid = image.valid.astype(np.uint8)
    complete = cv2.erode(valid, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0
    length = np.linalg.norm(normals, axis=2)
    facing = (normals * image.rays).sum(axis=2)
    scale = np.full(length.shape, np.nan)
    np.divide(-np.sign(facing), length, out=scale, where=complete & (length > 0) & (facing != 0))
    return (normals * scale[..., None]).astype(np.float32)


def _within(edges: Mask, reach: int) -> Mask:
    """Pixels (H, W) with an edge of (H, W-1) among the `reach` to their left or right."""
    framed = np.pad(edges, ((0, 0), (reach, reach)))
    kernel = np.ones((1, 2 * reach), np.uint8)
    near = cv2.dilate(framed.astype(np.uint8), kernel, anchor=(reach, 0))
    return near[:, reach : reach + edges.shape[1] + 1] > 0
