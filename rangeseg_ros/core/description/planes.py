"""Planes of regions: uncertainty, place and shape."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, TypeVar

import numpy as np

from rangeseg_ros.core.arrays import Floats, Indices, Labels
from rangeseg_ros.core.description.shapes import Outline, RegionShape, Shape, triangles
from rangeseg_ros.core.fitting.coplanar import common_surfaces
from rangeseg_ros.core.fitting.fits import Fits
from rangeseg_ros.core.fitting.region_sums import POINT, SCATTER
from rangeseg_ros.core.fitting.uncertainty import plane_jacobians, squares
from rangeseg_ros.core.rotations import quaternions
from rangeseg_ros.core.sensing.moments import COLUMNS, COUNT, ROWS
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance, systematic_variance

# A border is taken seriously up to this many times the range of the farthest part of its plane.
_FAR = 2.0
# The upper triangle of a symmetric matrix, and how often the matrix has each of its entries.
_TWICE = np.where(np.equal(ROWS, COLUMNS), 1, 2)

Own = TypeVar('Own', bound='Plane')


@dataclass(frozen=True, eq=False, repr=False)
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
        normal . p + distance = 0, metres: positive where the origin is on the sensor's side.
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
    probability : float
        0...1: that the region is a plane and no curved surface; of regions with 0.9, nine of ten
        are, see `by_planes.posterior`.
    outline : Outline
        What `hull` and `holes` are made of when first asked for.
    shape : Shape or RegionShape
        What `area`, `extents`, `centre` and `orientation` are of, worked out when first asked
        for.
    role : str
        Of `roles.ROLES`; empty when none is asked for.
    """

    label: int
    id: int
    surface: int
    normal: Floats
    distance: float
    covariance: Floats
    centroid: Floats
    count: int
    rms: float
    confidence: float
    probability: float
    outline: Outline = field(repr=False)
    shape: Shape | RegionShape = field(repr=False)
    role: str = ''

    def named(self: Own, **names: int | str) -> Own:
        """The same plane with another `id`, `surface` or `role`.

        As `dataclasses.replace` does it, which takes each field by itself, ten times as long.
        """
        return self._made({**vars(self), **names})

    @classmethod
    def _made(cls: type[Own], values: dict[str, Any]) -> Own:
        """A plane with the values of all fields."""
        plane = object.__new__(cls)
        vars(plane).update(values)
        return plane

    def __repr__(self) -> str:
        x, y, z = self.normal
        name = f'Plane {self.id}' + (f' ({self.role})' if self.role else '')
        return (
            f'<{name}: {self.area:.3g} m², normal ({x:.3f}, {y:.3f}, {z:.3f}), '
            f'distance {self.distance:.4g} m, rms {1000 * self.rms:.2g} mm>'
        )

    def mesh(self) -> tuple[Floats, Indices]:
        """Vertices (N, 3), metres, and triangles (T, 3) of them, of the outline without its holes.

        Triangles are rows of vertices, counter-clockwise seen from the sensor.
        """
        vertices, faces = np.zeros((0, 3)), np.zeros((0, 3), np.intp)
        for rings in self.outline.parts:
            if len(rings[0]) > 2:
                faces = np.append(faces, len(vertices) + triangles(rings, self.normal), axis=0)
                vertices = np.concatenate([vertices, *rings])
        return vertices, faces

    def to_dict(self) -> dict[str, Any]:
        """The plane as numbers, texts and lists of them, as JSON takes it."""
        names = [f.name for f in fields(self) if f.name not in ('shape', 'outline')]
        names += ['area', 'extents', 'centre', 'orientation', 'hull', 'holes']
        return {name: _plain(getattr(self, name)) for name in names}

    @property
    def area(self) -> float:
        """Area of the pixels on the plane, square metres."""
        return self.shape.area

    @property
    def extents(self) -> Floats:
        """(2,) length and width of the rectangle around the region, metres.

        Its sides run along the principal axes of the region's area.
        """
        return self.shape.extents

    @property
    def centre(self) -> Floats:
        """(3,) centre of that rectangle, metres."""
        return self.shape.centre

    @property
    def corners(self) -> Floats:
        """(4, 3) corners of that rectangle, metres."""
        half = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)]) * self.extents / 2
        corners: Floats = self.centre + half @ self.shape.frame[:, :2].T
        return corners

    @property
    def orientation(self) -> Floats:
        """(4,) quaternion x, y, z, w of the frame of that rectangle.

        Its x axis runs along the length, pointing to the image's right, its z axis is the normal.
        """
        return quaternions(self.shape.frame)

    @property
    def hull(self) -> Floats:
        """(N, 3) outline on the plane, metres, counter-clockwise seen from the sensor.

        Follows the region's largest part within `shapes.TOLERANCE` pixels; concave as it is.
        """
        return self.outline.hull

    @property
    def holes(self) -> list[Floats]:
        """Outlines (N, 3) of the holes in the hull, clockwise seen from the sensor."""
        return self.outline.holes


def _plain(value: Any) -> Any:
    if isinstance(value, list):
        return [_plain(part) for part in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def describe_regions(
    labels: Labels,
    image: RangeImage,
    fits: Fits,
    roots: Floats,
    sensor: SensorModel,
    probability: Floats | None = None,
) -> list[Plane]:
    """Planes of the regions 1...M of `labels` (H, W), but of those whose pixels determine none.

    `roots` (M + 1, 3, 3) are those of the fits, `probability` (M + 1,) is that of the regions to
    be planes, 1 where it is not given. `sensor` is that of the pixels, of which those of the image
    may be means.
    """
    theta = fits.theta
    probability = np.ones(len(theta)) if probability is None else probability
    if not theta.any():
        return []
    normal, distance, centroid, rms, confidence = _described(fits, sensor)
    covariance = squares(plane_jacobians(normal, distance) @ roots)
    if image.place.any():
        # From the sensor to the frame of the points.
        shift = np.eye(4)
        shift[3, :3] = -image.place
        distance, covariance = distance - normal @ image.place, shift @ covariance @ shift.T
        centroid = centroid + image.place

    farthest = fits.farthest() / _FAR
    found = np.flatnonzero(farthest > 0)
    known, outlines = found.tolist(), []
    for k, box, far in zip(known, fits.sums.box[found].tolist(), farthest[found], strict=True):
        crop = slice(box[0], box[2]), slice(box[1], box[3])
        rays = image.camera or image.rays[crop]
        outlines.append(Outline(labels[crop], k, box[0], box[1], theta[k], float(far), rays))
    # Numbers of Python, all at once: taken out of the arrays one by one they take longer.
    surfaces = common_surfaces(fits, squares(roots))
    numbers = surfaces, distance, fits.sums.pixels, rms, confidence, probability
    group, offset, *figures = (column[found].tolist() for column in numbers)
    equations = normal[found], offset, covariance[found]
    place, right = image.place, image.axes[:, 0].copy()
    shapes = [RegionShape(outline, place, right) for outline in outlines]
    columns = known, known, group, *equations, centroid[found], *figures, outlines, shapes
    names = [f.name for f in fields(Plane)]
    return [
        Plane._made({'role': '', **dict(zip(names, values, strict=False))})
        for values in zip(*columns, strict=True)
    ]


def _described(fits: Fits, sensor: SensorModel) -> tuple[Floats, ...]:
    """What regions 0...M have as planes, see `Plane`.

    Normal, distance, centroid, rms, confidence.
    """
    theta, total, cells = fits.theta, fits.total, fits.sums.cells
    slope = np.sqrt((theta * theta).sum(axis=1))
    distance = np.divide(1, slope, out=np.zeros_like(slope), where=slope > 0)
    normal = -theta * distance[:, None]
    inliers = np.maximum(total[:, COUNT], 1)[:, None]
    centroid = total[:, POINT : POINT + 3] / inliers
    offset = (normal * centroid).sum(axis=1)
    # The scatter matrix between the normals: its upper triangle, with the rest of it.
    twice = _TWICE * normal[:, ROWS] * normal[:, COLUMNS]
    square = (twice * total[:, SCATTER : SCATTER + 6] / inliers).sum(axis=1)
    square += distance * (2 * offset + distance)
    centroid -= (offset + distance)[:, None] * normal
    # What the errors of the sensor make of it: n . p + d changes by d / y times the error of y.
    region, level = fits.sums.owners, fits.level
    squared = np.where(level > 0, level * level, 1.0)
    pixels = np.bincount(region, cells[:, COUNT], len(theta))

    def across(variance: Floats) -> Floats:
        total = np.bincount(region, cells[:, COUNT] * variance / squared, len(theta))
        return total / np.maximum(pixels, 1) * distance**2

    random = random_variance(fits.sensor, squared)
    expected = across(random + systematic_variance(fits.sensor, squared))
    hidden = across(random_variance(sensor, squared) - random)
    explained = np.minimum(1, expected / np.maximum(square, 1e-18))
    confidence = (1 - fits.sums.outliers / np.maximum(fits.sums.pixels, 1)) * explained
    rms = np.sqrt(np.maximum(square, 0) + hidden)
    return normal, distance, centroid, rms, confidence
