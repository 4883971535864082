"""Planes of regions: fit, parameters, uncertainty, outline."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.range_image import RangeImage


@dataclass(frozen=True, eq=False)
class Plane:
    """A planar region: normal . p + distance = 0 in metres, in the frame of the image.

    Attributes
    ----------
    label : int
        Value in the label image, 1...
    id : int
        Identity over time; the label when nothing is tracked.
    normal : (3,) float64
        Unit normal towards the sensor.
    distance : float
        Distance of the origin from the plane, metres, positive for a sensor at the origin.
    covariance : (4, 4) float64
        Covariance of (normal, distance).
    centroid : (3,) float64
        Mean of the region's points projected to the plane, metres.
    count : int
        Number of pixels.
    rms : float
        Root mean square distance of the region's points from the plane, metres.
    area : float
        Area of the region on the plane, square metres.
    hull : (N, 3) float64
        Outline of the region on the plane, metres, counter-clockwise seen from the sensor.
    """

    label: int
    id: int
    normal: NDArray[np.float64]
    distance: float
    covariance: NDArray[np.float64]
    centroid: NDArray[np.float64]
    count: int
    rms: float
    area: float
    hull: NDArray[np.float64]


def fit_planes(labels: NDArray[np.uint16], image: RangeImage) -> list[Plane]:
    """Total-least-squares plane of every region.

    Parameters
    ----------
    labels : (H, W) uint16
        1...M, 0 for no plane; labels without three measured pixels are left out.
    image : RangeImage
        (H, W).

    Returns
    -------
    list of Plane
        In the order of the labels.
    """
    region = labels[image.valid]
    points = image.points[image.valid][region > 0].astype(np.float64)
    region = region[region > 0]
    size = int(labels.max(initial=0)) + 1
    count = np.bincount(region, minlength=size)
    safe = np.maximum(count, 1)

    def mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.bincount(region, values, size) / safe

    centroid = np.stack([mean(c) for c in points.T], axis=1)
    # Moments about the centroid: far planes would lose their digits to the distance.
    centred = (points - centroid[region]).T
    scatter = np.empty((size, 3, 3))
    for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
        scatter[:, i, j] = scatter[:, j, i] = mean(centred[i] * centred[j])
    variance, axes = np.linalg.eigh(scatter)
    normal = axes[:, :, 0]
    distance = -np.einsum('ij,ij->i', normal, centroid)
    flip = np.where(distance < 0, -1.0, 1.0)
    normal, distance = normal * flip[:, None], distance * flip
    rms = np.sqrt(np.maximum(variance[:, 0], 0))
    area = _areas(labels, image, normal, distance)
    return [
        Plane(
            label=int(k),
            id=int(k),
            normal=normal[k],
            distance=float(distance[k]),
            covariance=np.zeros((4, 4)),
            centroid=centroid[k],
            count=int(count[k]),
            rms=float(rms[k]),
            area=float(area[k]),
            hull=np.empty((0, 3)),
        )
        for k in np.flatnonzero(count >= 3)
        if k > 0
    ]


def _areas(
    labels: NDArray[np.uint16],
    image: RangeImage,
    normal: NDArray[np.float64],
    distance: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Area in square metres that each region's pixels cover on its plane."""
    size = len(normal)
    if min(image.shape) < 2:
        return np.zeros(size)
    # The parallelogram between the rays of neighbouring pixels, cut by the plane: with rays
    # r + t du + s dv the area on n . p + d = 0 is d^2 |du x dv . r| / |n . r|^3.
    rays = image.rays.astype(np.float64)
    du, dv = np.gradient(rays, axis=1), np.gradient(rays, axis=0)
    solid = np.abs(np.einsum('ijk,ijk->ij', np.cross(du, dv), rays))
    at = np.einsum('ijk,ijk->ij', rays, normal[labels])
    with np.errstate(divide='ignore', invalid='ignore'):
        cell = distance[labels] ** 2 * solid / np.abs(at) ** 3
    cell[~(np.isfinite(cell) & image.valid)] = 0
    return np.bincount(labels.ravel(), cell.ravel(), size)
