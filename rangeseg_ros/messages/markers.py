"""Planes as RViz markers."""

from __future__ import annotations

from collections.abc import Sequence
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
    markers = [_marker(make, header, '', 0, ARROW, action=DELETEALL)]
    for plane, colour in zip(planes, colours([plane.id for plane in planes]) / 255, strict=True):
        rgb = [float(part) for part in colour]
        tip = plane.centroid + ARROW_LENGTH * plane.normal
        markers.append(
            _marker(
                make,
                header,
                'hulls',
                plane.id,
                TRIANGLE_LIST,
                colour=(*rgb, 0.6),
                points=_triangles(make, plane),
            )
        )
        markers.append(
            _marker(
                make,
                header,
                'normals',
                plane.id,
                ARROW,
                scale=(0.02, 0.04, 0.06),
                colour=(*rgb, 1.0),
                points=_points(make, (plane.centroid, tip)),
            )
        )
        markers.append(
            _marker(
                make,
                header,
                'ids',
                plane.id,
                TEXT_VIEW_FACING,
                scale=(0.0, 0.0, 0.12),
                colour=(1.0, 1.0, 1.0, 1.0),
                position=_points(make, (tip,))[0],
                text=f'{plane.id} {plane.role}'.strip(),
            )
        )
    return make('visualization_msgs/msg/MarkerArray', markers=markers)


def outline_message(make: Make, header: Any, lines: Sequence[NDArray[np.floating]]) -> Any:
    """visualization_msgs/MarkerArray: the closed `lines` (N, 3) around the ground, no older ones.

    Namespace `ground`, of type LINE_STRIP.
    """
    markers = [_marker(make, header, '', 0, ARROW, action=DELETEALL)]
    for number, line in enumerate(lines):
        closed = np.concatenate([line, line[:1]])
        markers.append(
            _marker(
                make,
                header,
                'ground',
                number,
                LINE_STRIP,
                scale=(0.02, 0.0, 0.0),
                colour=(0.1, 0.9, 0.1, 1.0),
                points=_points(make, closed),
            )
        )
    return make('visualization_msgs/msg/MarkerArray', markers=markers)


def stairs_message(make: Make, header: Any, staircases: Sequence[Stairs]) -> Any:
    """visualization_msgs/MarkerArray: the first edges of staircases and what they are, no others.

    Namespaces `edges`, of type LINE_STRIP, and `stairs`, whose texts are such as
    'up 4 x 0.17 / 0.28 m': direction, treads in sight, rise and run.
    """
    markers = [_marker(make, header, '', 0, ARROW, action=DELETEALL)]
    for number, stairs in enumerate(staircases):
        markers.append(
            _marker(
                make,
                header,
                'edges',
                number,
                LINE_STRIP,
                scale=(0.04, 0.0, 0.0),
                colour=(1.0, 0.6, 0.0, 1.0),
                points=_points(make, stairs.edge),
            )
        )
        markers.append(
            _marker(
                make,
                header,
                'stairs',
                number,
                TEXT_VIEW_FACING,
                scale=(0.0, 0.0, 0.12),
                colour=(1.0, 1.0, 1.0, 1.0),
                position=_points(make, stairs.edge.mean(axis=0, keepdims=True))[0],
                text=str(stairs),
            )
        )
    return make('visualization_msgs/msg/MarkerArray', markers=markers)


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


def _marker(
    make: Make,
    header: Any,
    namespace: str,
    number: int,
    kind: int,
    *,
    action: int = ADD,
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0),
    colour: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0),
    points: Sequence[Any] = (),
    position: Any = None,
    text: str = '',
) -> Any:
    """visualization_msgs/Marker with every field, as not all makers have defaults."""
    time = make('builtin_interfaces/msg/Time', sec=0, nanosec=0)
    untextured = make(
        'sensor_msgs/msg/CompressedImage',
        header=make('std_msgs/msg/Header', stamp=time, frame_id=''),
        format='',
        data=np.empty(0, np.uint8),
    )
    return make(
        'visualization_msgs/msg/Marker',
        header=header,
        ns=namespace,
        id=number,
        type=kind,
        action=action,
        pose=make(
            'geometry_msgs/msg/Pose',
            position=position or make('geometry_msgs/msg/Point', x=0.0, y=0.0, z=0.0),
            orientation=make('geometry_msgs/msg/Quaternion', x=0.0, y=0.0, z=0.0, w=1.0),
        ),
        scale=make('geometry_msgs/msg/Vector3', **dict(zip('xyz', scale, strict=True))),
        color=make('std_msgs/msg/ColorRGBA', **dict(zip('rgba', colour, strict=True))),
        lifetime=make('builtin_interfaces/msg/Duration', sec=0, nanosec=0),
        frame_locked=False,
        points=list(points),
        colors=[],
        texture_resource='',
        texture=untextured,
        uv_coordinates=[],
        text=text,
        mesh_resource='',
        mesh_file=make('visualization_msgs/msg/MeshFile', filename='', data=np.empty(0, np.uint8)),
        mesh_use_embedded_materials=False,
    )
