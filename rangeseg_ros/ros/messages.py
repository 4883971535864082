"""Arrays <-> ROS messages, whoever implements the message classes: rclpy or rosbags.

Messages are read by their fields and made by a `Make`, so that the node and an offline replay
publish and write the same bytes, and this module imports without ROS.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.camera import Camera
from rangeseg_ros.core.planes import Plane
from rangeseg_ros.core.range_image import RangeImage
from rangeseg_ros.core.segmenter import Segmentation
from rangeseg_ros.io.depth_encodings import decode_compressed, decode_image

# Makes a message from the name of its type and all its fields, e.g.
# make('geometry_msgs/msg/Point', x=0.0, y=0.0, z=1.0); octets are given as uint8 arrays.
Make = Callable[..., Any]

# One row of `~/planes`: the fields of a Plane.
PLANE_TYPE = np.dtype(
    [
        ('x', '<f4'),
        ('y', '<f4'),
        ('z', '<f4'),
        ('normal_x', '<f4'),
        ('normal_y', '<f4'),
        ('normal_z', '<f4'),
        ('distance', '<f4'),
        ('label', '<u4'),
        ('id', '<u4'),
        ('count', '<u4'),
        ('rms', '<f4'),
        ('area', '<f4'),
        ('covariance', '<f4', 16),
    ]
)

# sensor_msgs/PointField: datatype -> numpy.
_POINT_FIELD_TYPES = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}


class MessageError(ValueError):
    """A message whose fields contradict each other."""


def make_rclpy(kind: str, **fields: Any) -> Any:
    """Make a message of the sourced ROS installation, or of the wheels."""
    # rclpy takes an array of bytes as it is, and a numpy array octet by octet.
    arguments = {
        key: array('B', value.tobytes()) if isinstance(value, np.ndarray) else value
        for key, value in fields.items()
    }
    return message_class(kind)(**arguments)


def message_class(kind: str) -> type:
    """Class of rclpy for e.g. 'sensor_msgs/msg/Image'; ImportError when it is not installed."""
    package, _, name = kind.split('/')
    found: type = getattr(import_module(f'{package}.msg'), name)
    return found


def depth_from_message(message: Any) -> NDArray[np.uint16] | NDArray[np.float32]:
    """Depth image (H, W) of a sensor_msgs/Image, or a CompressedImage of compressedDepth.

    Raises
    ------
    EncodingError
        The message holds no depth image, or a damaged one.
    """
    if hasattr(message, 'format'):
        return decode_compressed(message.format, message.data)
    return decode_image(
        message.height,
        message.width,
        message.encoding,
        bool(message.is_bigendian),
        message.step,
        message.data,
    )


def camera_from_message(info: Any) -> Camera:
    """Camera of a sensor_msgs/CameraInfo; the same object, with its rays, while nothing changes.

    Raises
    ------
    CameraError
        Intrinsics that cannot belong to a pinhole camera.
    """
    roi = info.roi
    return _camera(
        info.width,
        info.height,
        tuple(float(value) for value in info.k),
        tuple(float(value) for value in info.p),
        (info.binning_x, info.binning_y),
        (roi.x_offset, roi.y_offset, roi.width, roi.height),
    )


@lru_cache(maxsize=4)
def _camera(*fields: Any) -> Camera:
    return Camera.from_matrices(*fields)


def points_from_message(cloud: Any) -> NDArray[np.float32] | NDArray[np.float64]:
    """Points (H, W, 3), metres, of an organised sensor_msgs/PointCloud2.

    Raises
    ------
    MessageError
        No fields x, y, z of one floating-point type, one row only, or damaged.
    """
    records = _records(cloud)
    kinds = {records.dtype[name] for name in 'xyz' if name in records.dtype.names}
    if len(kinds) != 1 or not set('xyz') <= set(records.dtype.names) or kinds.pop().kind != 'f':
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
    (N,) structured array, one row per plane, with the columns of `PLANE_TYPE`: `x`, `y`, `z`
    (centroid, metres), `normal_x`, `normal_y`, `normal_z` (unit, towards the sensor), `distance`
    (metres: normal . p + distance = 0), `label`, `id`, `count` (pixels), `rms` (metres), `area`
    (square metres), `covariance` ((N, 16): of normal and distance, 4x4 row by row).

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
        dtype = np.dtype(
            {
                'names': [field.name for field in cloud.fields],
                'formats': [
                    (order + _POINT_FIELD_TYPES[field.datatype], field.count)
                    if field.count > 1
                    else order + _POINT_FIELD_TYPES[field.datatype]
                    for field in cloud.fields
                ],
                'offsets': [field.offset for field in cloud.fields],
                'itemsize': cloud.point_step,
            }
        )
    except (ValueError, KeyError) as error:
        raise MessageError(f'cloud has contradictory fields: {error}') from None
    data = np.frombuffer(cloud.data, np.uint8)
    if cloud.height * cloud.width == 0:
        return np.empty((cloud.height, cloud.width), dtype).astype(dtype.newbyteorder('='))
    row = cloud.width * cloud.point_step
    needed = cloud.row_step * (cloud.height - 1) + row
    if cloud.row_step < row or data.size < needed:
        raise MessageError(
            f'{data.size} bytes of data are too few for {cloud.width}x{cloud.height} points of '
            f'{cloud.point_step} bytes in rows of {cloud.row_step} bytes'
        )
    strides = (cloud.row_step, cloud.point_step)
    records: NDArray[np.void] = np.ndarray((cloud.height, cloud.width), dtype, data, 0, strides)
    return records.astype(dtype.newbyteorder('='))


def image_message(make: Make, header: Any, pixels: NDArray, encoding: str) -> Any:
    """sensor_msgs/Image of an array (H, W) or (H, W, channels)."""
    rows = np.ascontiguousarray(pixels, pixels.dtype.newbyteorder('<'))
    return make(
        'sensor_msgs/msg/Image',
        header=header,
        height=rows.shape[0],
        width=rows.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=rows.strides[0],
        data=rows.reshape(-1).view(np.uint8),
    )


def planes_message(make: Make, header: Any, planes: Sequence[Plane]) -> Any:
    """sensor_msgs/PointCloud2 with one point per plane; see `planes_from_message`."""
    rows = np.array(
        [
            (
                *plane.centroid,
                *plane.normal,
                plane.distance,
                plane.label,
                plane.id,
                plane.count,
                plane.rms,
                plane.area,
                plane.covariance.ravel(),
            )
            for plane in planes
        ],
        PLANE_TYPE,
    )
    datatypes = {kind: number for number, kind in _POINT_FIELD_TYPES.items()}
    fields = []
    for name in PLANE_TYPE.names or ():
        column, offset = PLANE_TYPE.fields[name][:2]  # type: ignore[index]
        fields.append(
            make(
                'sensor_msgs/msg/PointField',
                name=name,
                offset=offset,
                datatype=datatypes[column.base.str[1:]],
                count=int(np.prod(column.shape)),
            )
        )
    return make(
        'sensor_msgs/msg/PointCloud2',
        header=header,
        height=1,
        width=rows.size,
        fields=fields,
        is_bigendian=False,
        point_step=PLANE_TYPE.itemsize,
        row_step=rows.nbytes,
        data=rows.view(np.uint8),
        is_dense=True,
    )


@dataclass(frozen=True)
class Output:
    """What the node publishes on one topic.

    Attributes
    ----------
    kind : str
        Type of the message.
    message : callable
        (make, header, image, result) -> message.
    """

    kind: str
    message: Callable[[Make, Any, RangeImage, Segmentation], Any]


OUTPUTS = {
    'labels': Output(
        'sensor_msgs/msg/Image',
        lambda make, header, image, result: image_message(make, header, result.labels, 'mono16'),
    ),
    'planes': Output(
        'sensor_msgs/msg/PointCloud2',
        lambda make, header, image, result: planes_message(make, header, result.planes),
    ),
}
