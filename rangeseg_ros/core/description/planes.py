"""Planes of regions: uncertainty, place and shape."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.description.outlines import Outline, lies_ahead
from rangeseg_ros.core.description.shapes import RegionShape, Shape, Shapes
from rangeseg_ros.core.fitting.cells import POINT, SCATTER, WEIGHT, WEIGHTED_RAY
from rangeseg_ros.core.fitting.coplanar import common_surfaces
from rangeseg_ros.core.fitting.fits import Fits, symmetric
from rangeseg_ros.core.fitting.uncertainty import plane_jacobians, sandwich
from rangeseg_ros.core.runtime.threads import submit
from rangeseg_ros.core.sensing.moments import COUNT
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import (
    random_variance,
    systematic_variance,
)


@dataclass(frozen=True, eq=False)
class Plane:
    """A planar region: normal . p + distance = 0 in metres, in the frame of the image.

    Attributes
    ----------
    label : int
        Value in the label image, 1...
    id : int
        Identity over time, see `tracking.Tracker`; the label when nothing is tracked.
    surface : int
        The same for regions of one image that lie on one plane, seen apart: the label of the
        largest of them. See `coplanar.common_surfaces`. When tracked, the identity of the
        surface over time.
    normal : (3,) float64
        Unit normal towards the sensor.
    distance : float
        Distance of the origin from the plane, metres, positive for a sensor at the origin.
    covariance : (4, 4) float64
        Covariance of (normal, distance), of rank 3, from the errors of the sensor model.
    centroid : (3,) float64
        Mean of the points that the plane explains, projected to the plane, metres.
    count : int
        Number of measured pixels.
    rms : float
        Root mean square distance from the plane, metres, of the points that it explains.
    confidence : float
        0...1: the share of the pixels that the plane explains, times the mean square residual that
        the sensor model expects of them over the observed one where that is larger. About 1 for
        planes, less for what is bent, rough or spills over its border.
    shape : Shape or RegionShape
        What `area`, `extents`, `centre` and `orientation` are of, worked out when first asked
        for.
    outline : Outline
        What `hull` and `holes` are made of when first asked for.
    role : str
        Of `roles.ROLES`; empty when none is asked for.
    """

    label: int
    id: int
    surface: int
    normal: NDArray[np.float64]
    distance: float
    covariance: NDArray[np.float64]
    centroid: NDArray[np.float64]
    count: int
    rms: float
    confidence: float
    shape: Shape | RegionShape = field(repr=False)
    outline: Outline = field(repr=False)
    role: str = ''

    @property
    def area(self) -> float:
        """Area of the pixels on the plane, square metres."""
        return self.shape.area

    @property
    def extents(self) -> NDArray[np.float64]:
        """(2,) length and width of the rectangle around the region, metres.

        Its sides run along the principal axes of the region's area.
        """
        return self.shape.extents

    @property
    def centre(self) -> NDArray[np.float64]:
        """(3,) centre of that rectangle, metres."""
        return self.shape.centre

    @property
    def orientation(self) -> NDArray[np.float64]:
        """(4,) quaternion x, y, z, w of the frame of that rectangle.

        Its x axis runs along the length, pointing to the image's right, its z axis is the normal.
        """
        return self.shape.orientation

    @property
    def hull(self) -> NDArray[np.float64]:
        """(N, 3) outline on the plane, metres, counter-clockwise seen from the sensor.

        Follows the region's largest part within `outlines.TOLERANCE` pixels; concave as it is.
        """
        return self.outline.hull

    @property
    def holes(self) -> list[NDArray[np.float64]]:
        """Outlines (N, 3) of the holes in the hull, clockwise seen from the sensor."""
        return self.outline.holes


def describe_regions(labels: NDArray[np.uint16], image: RangeImage, fits: Fits) -> list[Plane]:
    """Uncertainty, place and shape of every region's plane.

    Parameters
    ----------
    labels : (H, W) uint16
        1...M, 0 for no plane; labels whose pixels determine no plane, or one without a finite
        outline, are left out.
    image : RangeImage
        (H, W).
    fits : Fits
        Of these labels.

    Returns
    -------
    list of Plane
        In the order of the labels.
    """
    theta, sums = fits.theta, fits.explained
    found = np.flatnonzero(theta.any(axis=1))
    if not len(found):
        return []
    surfaces = submit(common_surfaces, fits)
    distance = np.zeros(len(theta))
    distance[found] = 1 / np.linalg.norm(theta[found], axis=1)
    normal = -theta * distance[:, None]
    jacobian = plane_jacobians(normal, distance)
    covariance = sandwich(jacobian, fits.covariance)

    inliers = np.maximum(sums[:, COUNT], 1)
    centroid = sums[:, POINT:SCATTER] / inliers[:, None]
    scatter = symmetric(sums[:, SCATTER:]) / inliers[:, None, None]
    offset = (normal * centroid).sum(axis=1)
    square = np.einsum('ki,kij,kj->k', normal, scatter, normal)
    square += distance * (2 * offset + distance)
    rms = np.sqrt(np.maximum(square, 0))
    centroid = centroid - (offset + distance)[:, None] * normal
    expected = distance**2 * _expected_square(fits)
    share = 1 - fits.outliers / np.maximum(fits.pixels, 1)
    confidence = share * np.minimum(1, expected / np.maximum(square, 1e-18))

    shapes = Shapes(labels, image, theta, fits.inner)
    boxes = fits.boxes()
    outlines = {k: _outline(k, labels, image, boxes[k], theta[k]) for k in found.tolist()}
    # Of steep planes neither need be finite.
    doubtful = found[~lies_ahead(boxes[found], theta[found], image.camera)]
    if len(doubtful):
        finite = shapes.finite() & np.isfinite(centroid).all(1)
        kept = finite[doubtful] & np.array([outlines[int(k)].exists() for k in doubtful])
        found = np.setdiff1d(found, doubtful[~kept])
    surface = surfaces.result()
    return [
        Plane(
            label=int(k),
            id=int(k),
            surface=int(surface[k]),
            normal=normal[k],
            distance=float(distance[k]),
            covariance=covariance[k],
            centroid=centroid[k],
            count=int(fits.pixels[k]),
            rms=float(rms[k]),
            confidence=float(confidence[k]),
            shape=RegionShape(shapes, int(k)),
            outline=outlines[int(k)],
        )
        for k in found
    ]


def _expected_square(fits: Fits) -> NDArray[np.float64]:
    """Mean square distance from the planes, over distance^2, that the sensor's errors make."""
    cells, theta, sensor = fits.cells, fits.theta, fits.sensor
    region = np.repeat(fits.regions_of_parts(), np.diff(cells.start))
    count, weight = cells.sums[:, COUNT], cells.sums[:, WEIGHT]
    ray = cells.sums[:, WEIGHTED_RAY:WEIGHT]
    level = (ray * theta[region]).sum(axis=1) / np.where(count > 0, weight, 1)
    # n . p + d changes by d / y times the error of y, whose variance is a + b y^4.
    squared = np.where(level > 0, level, 1) ** 2
    variance = random_variance(sensor, squared) + systematic_variance(sensor, squared)
    total = np.bincount(region, count * variance / squared, len(theta))
    return total / np.maximum(np.bincount(region, count, len(theta)), 1)


def _outline(
    label: int,
    labels: NDArray[np.uint16],
    image: RangeImage,
    box: NDArray[np.intp],
    theta: NDArray[np.float64],
) -> Outline:
    top, left, bottom, right = (int(edge) for edge in box)
    crop = slice(top, bottom), slice(left, right)
    return Outline(labels[crop], label, top, left, theta, image.camera or image.rays[crop])
