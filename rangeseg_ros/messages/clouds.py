"""Point clouds of messages: organised clouds in, points out, `~/planes` out and back."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from numpy.lib.recfunctions import unstructured_to_structured
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats, Singles
from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.ground.roles import ROLES
from rangeseg_ros.core.ground.stairs import Stairs
from rangeseg_ros.messages.make import CLOUD, Make, MessageError, elements

COVARIANCE = [f'covariance_{i}{j}' for i, j in combinations_with_replacement('xyzd', 2)]
# One row of `~/planes`: the fields of a Plane.
PLANE_TYPE = np.dtype(
    [
        *((name, '<f4') for name in ('x', 'y', 'z', 'normal_x', 'normal_y', 'normal_z')),
        ('distance', '<f4'),
        *((name, '<u4') for name in ('label', 'id', 'surface', 'role', 'count')),
        *((name, '<f4') for name in ('rms', 'confidence', 'probability', 'area')),
        *((name, '<f4') for name in ('length', 'width', 'centre_x', 'centre_y', 'centre_z')),
        *((f'orientation_{axis}', '<f4') for axis in 'xyzw'),
        *((name, '<f4') for name in COVARIANCE),
    ]
)

POINT_TYPE = np.dtype([('x', '<f4'), ('y', '<f4'), ('z', '<f4')])
_HEIGHT_TYPE = np.dtype([*POINT_TYPE.descr, ('height', '<f4')])
EDGE = tuple(f'edge_{axis}{end}' for end in (1, 2) for axis in 'xyz')
_STAIRS_TYPE = np.dtype(
    [
        *POINT_TYPE.descr,
        *((name, '<f4') for name in (*EDGE, 'width', 'rise', 'run')),
        ('count', '<u4'),
        ('direction', '<i4'),
    ]
)

# sensor_msgs/PointField: datatype -> numpy.
_POINT_FIELD_TYPES = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}

# Points of a thinned cloud: as many as layers of costmaps take in the time of a frame.
MOST_POINTS = 20_000


def points_from_message(cloud: Any) -> Singles | Floats:
    """Points (H, W, 3), metres, of an organised sensor_msgs/PointCloud2; else MessageError."""
    if not cloud.height * cloud.width:
        raise MessageError(f'cloud is empty ({cloud.width}x{cloud.height})')
    records = _records(cloud)
    columns: Any = records.dtype.fields or {}
    kinds = {str(columns[name][0]) if name in columns else 'missing' for name in 'xyz'}
    if kinds not in ({'float32'}, {'float64'}):
        raise MessageError('cloud must have the fields x, y, z of one floating-point type')
    if cloud.height < 2 and cloud.width > 1:
        raise MessageError(f'cloud is not organised ({cloud.width}x{cloud.height})')
    return np.stack([records[name] for name in 'xyz'], axis=-1)


def planes_from_message(cloud: Any) -> NDArray[np.void]:
    """Planes of a message of `~/planes`.

    Parameters
    ----------
    cloud : sensor_msgs/PointCloud2
        Of rclpy or rosbags.

    Returns
    -------
    (N,) structured array
        One row per plane, with the columns of `PLANE_TYPE`: `x`, `y`, `z` (centroid, metres),
        `normal_x`, `normal_y`, `normal_z` (unit, towards the sensor), `distance` (metres:
        normal . p + distance = 0), `label`, `id`, `surface` (the same for parts of one plane seen
        apart), `role` (index in `roles.ROLES`, 1 is floor), `count` (pixels), `rms` (metres),
        `confidence` (0...1), `probability` (0...1, to be a plane and no curved surface), `area`
        (square metres), `length`, `width`, `centre_x`, `centre_y`, `centre_z` (of the rectangle
        around the region, metres), `orientation_x`, `orientation_y`, `orientation_z`,
        `orientation_w` (quaternion of the frame with x along the length and z along the normal),
        `covariance_xx`, `covariance_xy` ... `covariance_dd` (upper triangle of the 4x4 covariance
        of normal x, y, z and distance d).

    Raises
    ------
    MessageError
        The message is damaged.
    """
    return _records(cloud).ravel()


def _records(cloud: Any) -> NDArray[np.void]:
    """Structured array (H, W) of the fields of a PointCloud2, native byte order."""
    order = '>' if cloud.is_bigendian else '<'
    try:
        kinds = [order + _POINT_FIELD_TYPES[field.datatype] for field in cloud.fields]
        counts = [(field.count,) if field.count > 1 else () for field in cloud.fields]
        dtype = np.dtype(
            {
                'names': [field.name for field in cloud.fields],
                'formats': list(zip(kinds, counts, strict=True)),
                'offsets': [field.offset for field in cloud.fields],
                'itemsize': cloud.point_step,
            }
        )
    except (ValueError, KeyError) as error:
        raise MessageError(f'cloud has contradictory fields: {error}') from None
    if cloud.height * cloud.width == 0:
        return np.empty((cloud.height, cloud.width), dtype.newbyteorder('='))
    return elements(cloud, dtype, cloud.row_step, 'points')


def planes_message(make: Make, header: Any, planes: Sequence[Plane]) -> Any:
    """sensor_msgs/PointCloud2 with one point per plane; see `planes_from_message`."""
    upper = np.triu_indices(4)
    rows = [
        (
            *(*plane.centroid, *plane.normal, plane.distance),
            *(plane.label, plane.id, plane.surface, ROLES.index(plane.role or 'other')),
            *(plane.count, plane.rms, plane.confidence, plane.probability, plane.area),
            *(*plane.extents, *plane.centre, *plane.orientation),
            *plane.covariance[upper],
        )
        for plane in planes
    ]
    return cloud_message(make, header, np.array(rows, PLANE_TYPE))


def thinned(points: Singles, resolution: float, most: int = MOST_POINTS) -> Singles:
    """One of the points (N, K), that begin with x, y, z, of each cube that has any.

    Cubes have sides of `resolution` metres, 0 for all points, and ones twice, four times, ... as
    long where more than `most` points would be left.
    """
    if resolution <= 0 or not len(points):
        return points
    kept, cubes = np.arange(len(points)), np.floor(points[:, :3].T / resolution).astype(np.int64)
    while True:
        x, y, z = cubes - cubes.min(axis=1, keepdims=True)
        key = (y * (x.max() + 1) + x) * (z.max() + 1) + z
        first = np.sort(np.unique(key, return_index=True)[1])
        kept, cubes = kept[first], cubes[:, first]
        if len(kept) <= most:
            return points[kept]
        cubes >>= 1  # twice as large


def points_message(make: Make, header: Any, points: Singles) -> Any:
    """sensor_msgs/PointCloud2 of points (N, 4) with their height, metres."""
    return cloud_message(make, header, unstructured_to_structured(points, _HEIGHT_TYPE))


def stairs_message(make: Make, header: Any, stairs: Sequence[Stairs]) -> Any:
    """sensor_msgs/PointCloud2 with a point per staircase, in the middle of its first edge.

    Its fields are those of the table of stairs; `direction` is 1 for up and -1 for down.
    """
    rows = [
        (
            *(*seen.edge.mean(axis=0), *seen.edge.ravel(), seen.width, seen.rise, seen.run),
            *(seen.count, 1 if seen.direction == 'up' else -1),
        )
        for seen in stairs
    ]
    return cloud_message(make, header, np.array(rows, _STAIRS_TYPE))


def cloud_message(make: Make, header: Any, rows: NDArray[np.void]) -> Any:
    """sensor_msgs/PointCloud2 of one row, a point for each of the records (N,)."""
    return make(
        CLOUD,
        header=header,
        height=1,
        width=rows.size,
        fields=_fields(make, rows.dtype),
        is_bigendian=False,
        point_step=rows.dtype.itemsize,
        row_step=rows.nbytes,
        data=rows.view(np.uint8),
        is_dense=True,
    )


@lru_cache(maxsize=8)
def _fields(make: Make, kind: np.dtype[np.void]) -> list[Any]:
    """sensor_msgs/PointField of each field of a type; made once, as nobody changes them."""
    datatypes = {kind: number for number, kind in _POINT_FIELD_TYPES.items()}
    return [
        make(
            'sensor_msgs/msg/PointField',
            name=name,
            offset=offset,
            datatype=datatypes[column.str[1:]],
            count=1,
        )
        for name, (column, offset, *_) in (kind.fields or {}).items()
    ]
