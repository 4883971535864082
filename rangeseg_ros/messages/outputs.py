"""What is published of a segmentation: one message per topic of the node."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.ground.classes import GROUND, OBSTACLE
from rangeseg_ros.core.ground.points import (
    MOST_POINTS,
    drops,
    outlines,
    points_of_class,
    thinned,
    unseen,
)
from rangeseg_ros.core.ground.survey import Survey
from rangeseg_ros.core.ground.terrain import Terrain
from rangeseg_ros.core.mapping.placement import moved_planes
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.segmentation import Segmentation
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.drawing import overlay
from rangeseg_ros.messages.clouds import (
    planes_message,
    points_message,
    stairs_message,
)
from rangeseg_ros.messages.grids import grid_message, grid_points_message
from rangeseg_ros.messages.images import image_message
from rangeseg_ros.messages.make import CLOUD, GRID, IMAGE, MARKERS, STATUS, Make, header_of
from rangeseg_ros.messages.markers import (
    Marker,
    markers_bytes,
    of_outline,
    of_planes,
    of_ramps,
    of_stairs,
)
from rangeseg_ros.messages.status import status_message

Message = Callable[[Make, Any, RangeImage, Segmentation], Any]


class Output(NamedTuple):
    """A topic of the node: the type of its message, and how that is made.

    `message` takes make, header, image and result; it gives a message, or its bytes where that is
    faster.
    """

    kind: str
    message: Message


def _markers(draw: Callable[[RangeImage, Segmentation], list[Marker]]) -> Output:
    def message(make: Make, header: Any, image: RangeImage, result: Segmentation) -> Any:
        return markers_bytes(header, draw(image, result))

    return Output(MARKERS, message)


def _image(encoding: str, pick: Callable[[RangeImage, Segmentation], Any]) -> Output:
    def message(make: Make, header: Any, image: RangeImage, result: Segmentation) -> Any:
        return image_message(make, header, pick(image, result), encoding)

    return Output(IMAGE, message)


def _points(
    find: Callable[[RangeImage, Terrain], NDArray[np.float32]], most: int = MOST_POINTS
) -> Output:
    """A topic of points of the terrain, thinned to so many."""

    def message(make: Make, header: Any, image: RangeImage, result: Segmentation) -> Any:
        found = np.zeros((0, 4), np.float32)
        if result.ground is not None:
            found = find(image, result.ground)
            survey = result.survey
            size = survey.cloud_resolution if isinstance(survey, Survey) else 0.0
            found = thinned(found, size, most)
        return points_message(make, header, found)

    return Output(CLOUD, message)


def _of(
    kind: str, message: Callable[[Make, Any, Any], Any], pick: Callable[[Segmentation], Any]
) -> Output:
    """A topic of a part of the result."""
    return Output(kind, lambda make, header, image, result: message(make, header, pick(result)))


OUTPUTS = {
    # What a robot stops for is published before pictures. Of edges, no point is left out that has
    # no other near it, however many there are.
    'drops': _points(drops, sys.maxsize),
    'grid': _of(GRID, grid_message, lambda result: result.grid),
    'obstacles': _points(lambda image, terrain: points_of_class(image, terrain, OBSTACLE)),
    'ground': _points(lambda image, terrain: points_of_class(image, terrain, GROUND)),
    'unseen': _points(unseen, sys.maxsize),
    'terrain': _image('mono8', lambda image, result: result.terrain),
    'labels': _image('mono16', lambda image, result: result.labels),
    'planes': _of(CLOUD, planes_message, lambda result: result.planes),
    'markers': _markers(lambda image, result: of_planes(result.planes)),
    'overlay': _image(
        'rgb8', lambda image, result: overlay(image.inverse, result.labels, result.planes)
    ),
    'normals': _image('32FC3', lambda image, result: result.normals),
    'edges': _image('mono8', lambda image, result: 255 * result.edges.astype(np.uint8)),
    'outline': _markers(
        lambda image, result: of_outline(outlines(image, result.ground) if result.ground else [])
    ),
    'stairs': _markers(lambda image, result: of_stairs(result.stairs) + of_ramps(result.ramps)),
    'stairs_points': _of(CLOUD, stairs_message, lambda result: result.stairs),
    'grid_points': _of(CLOUD, grid_points_message, lambda result: result.grid),
    'status': _of(STATUS, status_message, lambda result: result),
}

IN_TARGET = frozenset({'planes', 'markers'})
"""Outputs in the target frame, where there is one; the others belong to the sensor's pixels."""

MAP_OUTPUTS: dict[str, tuple[str, Callable[[Make, Any, Sequence[Plane]], Any]]] = {
    'map': (CLOUD, planes_message),
    'map_markers': (
        MARKERS,
        lambda make, header, planes: markers_bytes(header, of_planes(planes)),
    ),
}
"""Topics of the map of planes: their types and how messages are made, in the fixed frame."""


def messages_of(
    make: Make,
    header: Any,
    image: RangeImage,
    result: Segmentation,
    target: tuple[str, Transform] | None,
    names: Iterable[str],
) -> Iterator[tuple[str, Any]]:
    """Names of `OUTPUTS` and their messages; `target` is a frame and the motion to it."""
    here = there = header, result
    if target:
        moved = replace(result, planes=moved_planes(result.planes, target[1]))
        there = header_of(make, header.stamp, target[0]), moved
    for name in names:
        head, shown = there if name in IN_TARGET else here
        yield name, OUTPUTS[name].message(make, head, image, shown)
