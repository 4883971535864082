"""Planes as RViz markers."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rangeseg_ros.core.description.outlines import triangles
from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.meaning.stairs import Stairs
from rangeseg_ros.drawing import colours
from rangeseg_ros.messages.make import Make

# visualization_msgs/Marker: type and action.
ARROW, LINE_STRIP, TEXT_VIEW_FACING, TRIANGLE_LIST = 0, 4, 9, 11
ADD, DELETEALL = 0, 3

ARROW_LENGTH = 0.2
"""Length of the drawn normals, metres."""


def markers_message(make: Make, header: Any, planes: Sequence[Plane]) -> Any:
    """visualization_msgs/MarkerArray: hulls, normals and names of `planes`, no older ones.

    Namespaces `hulls`, `normals` and `ids`, whose texts are id and role; a marker's id is the
    plane's, its colour that of the overlay. Every three points of a hull are a triangle,
    counter-clockwise seen from the sensor.
    """
    markers = _Markers(make, header)
    for plane, colour in zip(planes, colours([plane.id for plane in planes]) / 255, strict=True):
        rgb = [float(part) for part in colour]
        tip = plane.centroid + ARROW_LENGTH * plane.normal
        hull = markers.add('hulls', plane.id, TRIANGLE_LIST, (1.0, 1.0, 1.0), (*rgb, 0.6))
        hull.points = _triangles(make, plane)
        normal = markers.add('normals', plane.id, ARROW, (0.02, 0.04, 0.06), (*rgb, 1.0))
        normal.points = _points(make, (plane.centroid, tip))
        markers.add_text('ids', plane.id, f'{plane.id} {plane.role}'.strip(), tip)
    return markers.message()


def outline_message(make: Make, header: Any, lines: Sequence[NDArray[np.floating]]) -> Any:
    """visualization_msgs/MarkerArray: the closed `lines` (N, 3) around the ground, no older ones.

    Namespace `ground`, of type LINE_STRIP.
    """
    markers = _Markers(make, header)
    for number, line in enumerate(lines):
        strip = markers.add('ground', number, LINE_STRIP, (0.02, 0.0, 0.0), (0.1, 0.9, 0.1, 1.0))
        strip.points = _points(make, np.concatenate([line, line[:1]]))
    return markers.message()


def stairs_message(make: Make, header: Any, staircases: Sequence[Stairs]) -> Any:
    """visualization_msgs/MarkerArray: the first edges of staircases and what they are, no others.

    Namespaces `edges`, of type LINE_STRIP, and `stairs`, whose texts are such as
    'up 4 x 0.17 / 0.28 m': direction, treads in sight, rise and run.
    """
    markers = _Markers(make, header)
    for number, stairs in enumerate(staircases):
        edge = markers.add('edges', number, LINE_STRIP, (0.04, 0.0, 0.0), (1.0, 0.6, 0.0, 1.0))
        edge.points = _points(make, stairs.edge)
        markers.add_text('stairs', number, str(stairs), stairs.edge.mean(axis=0))
    return markers.message()


def _points(make: Make, coordinates: ArrayLike) -> list[Any]:
    rows = np.asarray(coordinates, float).tolist()
    return [make('geometry_msgs/msg/Point', x=x, y=y, z=z) for x, y, z in rows]


def _triangles(make: Make, plane: Plane) -> list[Any]:
    """Corners of triangles that make up the outline of `plane` without its holes."""
    corners = []
    for rings in plane.outline.parts:
        if len(rings[0]) > 2:
            # A message may hold one point at several places.
            points = _points(make, np.concatenate(rings))
            corners += [points[k] for k in triangles(rings, plane.normal).ravel().tolist()]
    return corners


class _Markers:
    """The markers of a message: the first one removes all that are older."""

    def __init__(self, make: Make, header: Any) -> None:
        self._make = make
        self._header = header
        self._markers: list[Any] = []
        self._blank = _blank(make, header)
        self.add('', 0, ARROW, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0, 0.0)).action = DELETEALL

    def message(self) -> Any:
        """visualization_msgs/MarkerArray."""
        return self._make('visualization_msgs/msg/MarkerArray', markers=self._markers)

    def add_text(
        self, namespace: str, number: int, text: str, position: NDArray[np.floating]
    ) -> None:
        """Add white letters of 12 cm that face whoever looks."""
        size, white = (0.0, 0.0, 0.12), (1.0, 1.0, 1.0, 1.0)
        marker = self.add(namespace, number, TEXT_VIEW_FACING, size, white)
        marker.pose = _pose(self._make, position)
        marker.text = text

    def add(
        self,
        namespace: str,
        number: int,
        kind: int,
        scale: tuple[float, float, float],
        colour: tuple[float, ...],
    ) -> Any:
        """Add a visualization_msgs/Marker at the origin."""
        make = self._make
        marker = copy(self._blank)
        marker.ns, marker.id, marker.type = namespace, number, kind
        marker.scale = make('geometry_msgs/msg/Vector3', **dict(zip('xyz', scale, strict=True)))
        marker.color = make('std_msgs/msg/ColorRGBA', **dict(zip('rgba', colour, strict=True)))
        self._markers.append(marker)
        return marker


def _blank(make: Make, header: Any) -> Any:
    """visualization_msgs/Marker with every field, as not all makers have defaults.

    To be copied: rclpy makes the parts of a marker anew even where they are given.
    """
    time = make('builtin_interfaces/msg/Time', sec=0, nanosec=0)
    untextured = make(
        'sensor_msgs/msg/CompressedImage',
        header=make('std_msgs/msg/Header', stamp=time, frame_id=''),
        format='',
        data=np.empty(0, np.uint8),
    )
    mesh = make('visualization_msgs/msg/MeshFile', filename='', data=np.empty(0, np.uint8))
    return make(
        'visualization_msgs/msg/Marker',
        header=header,
        ns='',
        id=0,
        type=ARROW,
        action=ADD,
        pose=_pose(make, np.zeros(3)),
        scale=make('geometry_msgs/msg/Vector3', x=1.0, y=1.0, z=1.0),
        color=make('std_msgs/msg/ColorRGBA', r=0.0, g=0.0, b=0.0, a=0.0),
        lifetime=make('builtin_interfaces/msg/Duration', sec=0, nanosec=0),
        frame_locked=False,
        points=[],
        colors=[],
        texture_resource='',
        texture=untextured,
        uv_coordinates=[],
        text='',
        mesh_resource='',
        mesh_file=mesh,
        mesh_use_embedded_materials=False,
    )


def _pose(make: Make, position: NDArray[np.floating]) -> Any:
    (point,) = _points(make, position[None])
    unturned = make('geometry_msgs/msg/Quaternion', x=0.0, y=0.0, z=0.0, w=1.0)
    return make('geometry_msgs/msg/Pose', position=point, orientation=unturned)
