"""What is published of a segmentation: one message per topic of the node."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.segmenter import Segmentation
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.drawing import overlay
from rangeseg_ros.messages.clouds import planes_message, points_message
from rangeseg_ros.messages.images import image_message
from rangeseg_ros.messages.make import Make
from rangeseg_ros.messages.markers import markers_message


@dataclass(frozen=True)
class Output:
    """A topic of the node.

    Attributes
    ----------
    kind : str
        Type of the message.
    message : callable
        (make, header, image, result) -> message.
    """

    kind: str
    message: Callable[[Make, Any, RangeImage, Segmentation], Any]


def _labels(make: Make, header: Any, image: RangeImage, result: Segmentation) -> Any:
    return image_message(make, header, result.labels, 'mono16')


def _planes(make: Make, header: Any, image: RangeImage, result: Segmentation) -> Any:
    return planes_message(make, header, result.planes)


def _markers(make: Make, header: Any, image: RangeImage, result: Segmentation) -> Any:
    return markers_message(make, header, result.planes)


def _overlay(make: Make, header: Any, image: RangeImage, result: Segmentation) -> Any:
    picture = overlay(image.inverse, result.labels, result.planes)
    return image_message(make, header, picture, 'rgb8')


def _normals(make: Make, header: Any, image: RangeImage, result: Segmentation) -> Any:
    return image_message(make, header, result.normals, '32FC3')


def _edges(make: Make, header: Any, image: RangeImage, result: Segmentation) -> Any:
    return image_message(make, header, 255 * result.edges.astype(np.uint8), 'mono8')


def _ground(make: Make, header: Any, image: RangeImage, result: Segmentation) -> Any:
    return _points(make, header, image, _on_floor(result))


def _obstacles(make: Make, header: Any, image: RangeImage, result: Segmentation) -> Any:
    return _points(make, header, image, image.valid & ~_on_floor(result))


def _points(make: Make, header: Any, image: RangeImage, where: NDArray[np.bool_]) -> Any:
    # Of these pixels only, which is faster than RangeImage.points.
    return points_message(make, header, image.rays[where] / image.inverse[where, None])


def _on_floor(result: Segmentation) -> NDArray[np.bool_]:
    """(H, W) True where a plane is the floor, or a part of it."""
    return np.isin(
        result.labels, [plane.label for plane in result.planes if plane.role == 'floor']
    )


OUTPUTS = {
    'labels': Output('sensor_msgs/msg/Image', _labels),
    'planes': Output('sensor_msgs/msg/PointCloud2', _planes),
    'markers': Output('visualization_msgs/msg/MarkerArray', _markers),
    'overlay': Output('sensor_msgs/msg/Image', _overlay),
    'normals': Output('sensor_msgs/msg/Image', _normals),
    'edges': Output('sensor_msgs/msg/Image', _edges),
    'ground': Output('sensor_msgs/msg/PointCloud2', _ground),
    'obstacles': Output('sensor_msgs/msg/PointCloud2', _obstacles),
}
