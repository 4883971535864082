"""What is published of a segmentation: one message per topic of the node."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from rangeseg_ros.core.arrays import Singles
from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.ground import points
from rangeseg_ros.core.ground.cells import GROUND, OBSTACLE
from rangeseg_ros.core.ground.ground_input import GroundInput
from rangeseg_ros.core.ground.terrain import Terrain
from rangeseg_ros.core.mapping.map_planes import moved_planes
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.segmentation import Segmentation
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.drawing import overlay
from rangeseg_ros.messages import clouds, grids, markers
from rangeseg_ros.messages.images import image_message
from rangeseg_ros.messages.make import CLOUD, GRID, IMAGE, MARKERS, STATUS, Make, header_of
from rangeseg_ros.messages.status import status_message

Pick = Callable[[RangeImage, Segmentation], Any]


class Output(NamedTuple):
    """A topic of the node: the type of its message, how that is made, and of what.

    It may be made as bytes, where that is faster.
    """

    kind: str
    encode: Callable[[Make, Any, Any], Any]
    pick: Pick

    def message(self, make: Make, header: Any, image: RangeImage, result: Segmentation) -> Any:
        """Message of an image and its result."""
        return self.encode(make, header, self.pick(image, result))


def _drawn(make: Make, header: Any, drawn: Sequence[markers.Marker]) -> bytes:
    return markers.markers_bytes(header, drawn)


def _image(encoding: str, pick: Pick) -> Output:
    return Output(IMAGE, partial(image_message, encoding=encoding), pick)


def _points(
    find: Callable[[RangeImage, Terrain], Singles], most: int = clouds.MOST_POINTS
) -> Output:
    """A topic of points of the terrain, thinned to so many."""

    def pick(image: RangeImage, result: Segmentation) -> Singles:
        if result.ground is None:
            return np.zeros((0, 4), np.float32)
        source = result.source
        size = source.config.cloud_resolution if isinstance(source, GroundInput) else 0.0
        return clouds.thinned(find(image, result.ground), size, most)

    return Output(CLOUD, clouds.points_message, pick)


OUTPUTS = {
    # What a robot stops for is published before pictures. Of edges, no point is left out that has
    # no other near it, however many there are.
    'drops': _points(points.drops, sys.maxsize),
    'grid': Output(GRID, grids.grid_message, lambda image, result: result.grid),
    'obstacles': _points(lambda image, terrain: points.points_of_class(image, terrain, OBSTACLE)),
    'ground': _points(lambda image, terrain: points.points_of_class(image, terrain, GROUND)),
    'unseen': _points(points.unseen, sys.maxsize),
    'terrain': _image('mono8', lambda image, result: result.terrain),
    'labels': _image('mono16', lambda image, result: result.labels),
    'planes': Output(CLOUD, clouds.planes_message, lambda image, result: result.planes),
    'markers': Output(MARKERS, _drawn, lambda image, result: markers.of_planes(result.planes)),
    'overlay': _image(
        'rgb8', lambda image, result: overlay(image.inverse, result.labels, result.planes)
    ),
    'normals': _image('32FC3', lambda image, result: result.normals),
    'edges': _image('mono8', lambda image, result: 255 * result.edges.astype(np.uint8)),
    'outline': Output(
        MARKERS,
        _drawn,
        lambda image, result: markers.of_outline(
            points.outlines(image, result.ground) if result.ground else []
        ),
    ),
    'stairs': Output(
        MARKERS,
        _drawn,
        lambda image, result: markers.of_stairs(result.stairs) + markers.of_ramps(result.ramps),
    ),
    'stairs_points': Output(CLOUD, clouds.stairs_message, lambda image, result: result.stairs),
    'grid_points': Output(CLOUD, grids.grid_points_message, lambda image, result: result.grid),
    'status': Output(STATUS, status_message, lambda image, result: result),
}

IN_TARGET = frozenset({'planes', 'markers'})
"""Outputs in the target frame, where there is one; the others belong to the sensor's pixels."""

MAP_OUTPUTS: dict[str, tuple[str, Callable[[Make, Any, Sequence[Plane]], Any]]] = {
    'map': (CLOUD, clouds.planes_message),
    'map_markers': (
        MARKERS,
        lambda make, header, planes: _drawn(make, header, markers.of_planes(planes)),
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
