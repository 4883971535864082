"""What is published of a segmentation: one message per topic of the node."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.ground.classes import GROUND, OBSTACLE
from rangeseg_ros.core.ground.grid import empty_grid
from rangeseg_ros.core.ground.points import drops, outlines, points_of_class, thinned, unseen
from rangeseg_ros.core.ground.survey import Survey
from rangeseg_ros.core.ground.terrain import Terrain
from rangeseg_ros.core.mapping.placement import moved_planes
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.segmentation import Segmentation
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.drawing import overlay
from rangeseg_ros.messages.clouds import (
    grid_points_message,
    planes_message,
    points_message,
    stairs_message,
)
from rangeseg_ros.messages.grids import GRID, grid_header, grid_message, grid_points
from rangeseg_ros.messages.images import image_message
from rangeseg_ros.messages.make import Make
from rangeseg_ros.messages.marker_bytes import markers_bytes
from rangeseg_ros.messages.markers import (
    Marker,
    of_outline,
    of_planes,
    of_ramps,
    of_stairs,
)
from rangeseg_ros.messages.status import status_message

_NONE = np.zeros((0, 4), np.float32)


@dataclass(frozen=True)
class Output:
    """A topic of the node.

    Attributes
    ----------
    kind : str
        Type of the message.
    message : callable
        (make, header, image, result) -> message, or its bytes where that is faster.
    """

    kind: str
    message: Callable[[Make, Any, RangeImage, Segmentation], Any]


def _of_markers(draw: Callable[[RangeImage, Segmentation], list[Marker]]) -> Output:
    """A topic of markers."""
    return Output(
        'visualization_msgs/msg/MarkerArray',
        lambda make, header, image, result: markers_bytes(header, draw(image, result)),
    )


def _of_image(encoding: str, pick: Callable[[RangeImage, Segmentation], Any]) -> Output:
    """A topic of images."""
    return Output(
        'sensor_msgs/msg/Image',
        lambda make, header, image, result: image_message(
            make, header, pick(image, result), encoding
        ),
    )


def _planes(make: Make, header: Any, image: RangeImage, result: Segmentation) -> Any:
    return planes_message(make, header, result.planes)


def _ground(make: Make, header: Any, image: RangeImage, result: Segmentation) -> Any:
    return points_message(make, header, _points(image, result, GROUND))


def _obstacles(make: Make, header: Any, image: RangeImage, result: Segmentation) -> Any:
    return points_message(make, header, _points(image, result, OBSTACLE))


def _drops(make: Make, header: Any, image: RangeImage, result: Segmentation) -> Any:
    return _crossings(make, header, image, result, drops)


def _unseen(make: Make, header: Any, image: RangeImage, result: Segmentation) -> Any:
    return _crossings(make, header, image, result, unseen)


def _crossings(
    make: Make,
    header: Any,
    image: RangeImage,
    result: Segmentation,
    find: Callable[[RangeImage, Terrain], NDArray[np.float32]],
) -> Any:
    found = _NONE if result.ground is None else find(image, result.ground)
    # However many: none of them is left out where there is no other near it.
    return points_message(make, header, thinned(found, _resolution(result), len(found)))


def _points(image: RangeImage, result: Segmentation, kind: int) -> NDArray[np.float32]:
    if result.ground is None:
        return _NONE
    return thinned(points_of_class(image, result.ground, kind), _resolution(result))


def _resolution(result: Segmentation) -> float:
    return result.survey.config.cloud_resolution if isinstance(result.survey, Survey) else 0.0


def _grid(make: Make, header: Any, image: RangeImage, result: Segmentation) -> Any:
    return grid_message(make, header, result.grid or empty_grid())


def _grid_points(make: Make, header: Any, image: RangeImage, result: Segmentation) -> Any:
    grid = result.grid or empty_grid()
    return grid_points_message(make, grid_header(make, header, grid), grid_points(grid))


def _stairs_points(make: Make, header: Any, image: RangeImage, result: Segmentation) -> Any:
    return stairs_message(make, header, result.stairs)


def _outline(image: RangeImage, result: Segmentation) -> list[Marker]:
    return of_outline([] if result.ground is None else outlines(image, result.ground))


def _stairs(image: RangeImage, result: Segmentation) -> list[Marker]:
    return [*of_stairs(result.stairs), *of_ramps(result.ramps)]


def _status(make: Make, header: Any, image: RangeImage, result: Segmentation) -> Any:
    return status_message(make, header, result)


OUTPUTS = {
    # What a robot stops for is published before pictures.
    'drops': Output('sensor_msgs/msg/PointCloud2', _drops),
    'obstacles': Output('sensor_msgs/msg/PointCloud2', _obstacles),
    'unseen': Output('sensor_msgs/msg/PointCloud2', _unseen),
    'ground': Output('sensor_msgs/msg/PointCloud2', _ground),
    'terrain': _of_image('mono8', lambda image, result: result.terrain),
    'labels': _of_image('mono16', lambda image, result: result.labels),
    'planes': Output('sensor_msgs/msg/PointCloud2', _planes),
    'markers': _of_markers(lambda image, result: of_planes(result.planes)),
    'overlay': _of_image(
        'rgb8', lambda image, result: overlay(image.inverse, result.labels, result.planes)
    ),
    'normals': _of_image('32FC3', lambda image, result: result.normals),
    'edges': _of_image('mono8', lambda image, result: 255 * result.edges.astype(np.uint8)),
    'outline': _of_markers(_outline),
    'stairs': _of_markers(_stairs),
    'stairs_points': Output('sensor_msgs/msg/PointCloud2', _stairs_points),
    'grid': Output(GRID, _grid),
    'grid_points': Output('sensor_msgs/msg/PointCloud2', _grid_points),
    'status': Output('diagnostic_msgs/msg/DiagnosticArray', _status),
}

IN_TARGET = frozenset({'planes', 'markers'})
"""Outputs in the target frame, where there is one; the others belong to the sensor's pixels."""


def _map_markers(make: Make, header: Any, planes: Sequence[Plane]) -> Any:
    return markers_bytes(header, of_planes(planes))


MAP_OUTPUTS: dict[str, tuple[str, Callable[[Make, Any, Sequence[Plane]], Any]]] = {
    'map': ('sensor_msgs/msg/PointCloud2', planes_message),
    'map_markers': ('visualization_msgs/msg/MarkerArray', _map_markers),
}
"""Topics of the map of planes: their types and how messages are made, in the fixed frame."""


def in_target(
    make: Make, header: Any, result: Segmentation, frame: str, motion: Transform
) -> tuple[Any, Segmentation]:
    """Header and result of the outputs `IN_TARGET`, in the frame that `motion` leads to."""
    there = make('std_msgs/msg/Header', stamp=header.stamp, frame_id=frame)
    return there, replace(result, planes=moved_planes(result.planes, motion))
