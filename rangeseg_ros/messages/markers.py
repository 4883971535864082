"""Planes, the ground and stairs as RViz markers.

A hull has a hundred points, each of them an object of Python to rclpy, to be made and read again:
serialised as they are here markers take half the time, outlines and triangles included. The layout
is that of OMG CDR, little-endian: what follows the four bytes of the encapsulation is aligned to
its size.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.ground.roles import Ramp
from rangeseg_ros.core.ground.stairs import Stairs
from rangeseg_ros.drawing import colours

# visualization_msgs/Marker: type and action.
ARROW, LINE_STRIP, TEXT_VIEW_FACING, TRIANGLE_LIST = 0, 4, 9, 11
ADD, DELETEALL = 0, 3

ARROW_LENGTH = 0.2
"""Length of the drawn normals, metres."""

_LITTLE_ENDIAN = b'\0\1\0\0'
_EMPTY_TEXT = struct.pack('<I4x', 1)
# Of a marker, from where it lies to its points: pose, scale, colour, lifetime, frame_locked.
_PLACED = struct.Struct('<10d4fiI?')
# From the points to the text: colours, texture_resource, texture (header, format, data), uv.
_UNTEXTURED = struct.pack('<I', 0) + _EMPTY_TEXT + bytes(8) + 2 * _EMPTY_TEXT + bytes(8)
# From the text to the end: mesh_resource, mesh_file (name, data), embedded materials.
_NO_MESH = 2 * _EMPTY_TEXT + bytes(5)


class Marker(NamedTuple):
    """What a visualization_msgs/Marker says, at the origin unless it is a text at `position`.

    Its ns, id and type; metres; red, green, blue and opacity, 0...1; points (N, 3), metres.
    """

    namespace: str
    number: int
    kind: int
    scale: tuple[float, float, float]
    colour: tuple[float, float, float, float]
    points: NDArray[np.floating] = np.zeros((0, 3))
    text: str = ''
    position: tuple[float, ...] = (0.0, 0.0, 0.0)
    action: int = ADD


CLEAR = Marker('', 0, ARROW, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0, 0.0), action=DELETEALL)
"""Removes all older markers; the first of every message."""


def markers_bytes(header: Any, markers: Iterable[Marker]) -> bytes:
    """A serialised visualization_msgs/MarkerArray of `markers`, and of no older ones.

    `header` is a std_msgs/Header of rclpy or rosbags.
    """
    drawn = [CLEAR, *markers]
    out = bytearray(_LITTLE_ENDIAN + struct.pack('<I', len(drawn)))
    stamp = struct.pack('<iI', header.stamp.sec, header.stamp.nanosec) + _string(header.frame_id)
    for marker in drawn:
        turn, lasting = (0.0, 0.0, 0.0, 1.0), (0, 0, False)
        placed = (*marker.position, *turn, *marker.scale, *marker.colour, *lasting)
        points = np.ascontiguousarray(marker.points, '<f8').tobytes()
        for size, data in (
            (4, stamp),
            (4, _string(marker.namespace)),
            (4, struct.pack('<3i', marker.number, marker.kind, marker.action)),
            (8, _PLACED.pack(*placed)),
            (4, struct.pack('<I', len(marker.points))),
            (8 if points else 1, points),
            (1, _UNTEXTURED + _string(marker.text)),
            (4, _NO_MESH),
        ):
            out += bytes((len(_LITTLE_ENDIAN) - len(out)) % size) + data
    return bytes(out)


def _string(text: str) -> bytes:
    data = text.encode() + b'\0'
    return struct.pack('<I', len(data)) + data


def of_planes(planes: Sequence[Plane]) -> list[Marker]:
    """Hulls, normals and names of `planes`.

    Namespaces `hulls`, `normals` and `ids`, whose texts are id and role; a marker's id is the
    plane's, its colour that of the overlay. Every three points of a hull are a triangle,
    counter-clockwise seen from the sensor.
    """
    markers = []
    for plane, colour in zip(planes, colours([plane.id for plane in planes]) / 255, strict=True):
        red, green, blue = colour.tolist()
        tip = plane.centroid + ARROW_LENGTH * plane.normal
        normal = np.array((plane.centroid, tip))
        size, thin = (1.0, 1.0, 1.0), (0.02, 0.04, 0.06)
        opaque, clear = (red, green, blue, 1.0), (red, green, blue, 0.6)
        vertices, triangles = plane.mesh()
        corners = vertices[triangles.ravel()]
        markers += [
            Marker('hulls', plane.id, TRIANGLE_LIST, size, clear, corners),
            Marker('normals', plane.id, ARROW, thin, opaque, normal),
            _text('ids', plane.id, f'{plane.id} {plane.role}'.strip(), tip),
        ]
    return markers


def of_outline(lines: Sequence[NDArray[np.floating]]) -> list[Marker]:
    """The closed `lines` (N, 3) around the ground: namespace `ground`, of type LINE_STRIP."""
    size, green = (0.02, 0.0, 0.0), (0.1, 0.9, 0.1, 1.0)
    return [
        Marker('ground', number, LINE_STRIP, size, green, np.concatenate([line, line[:1]]))
        for number, line in enumerate(lines)
    ]


def of_stairs(staircases: Sequence[Stairs]) -> list[Marker]:
    """The first edges of staircases and what they are.

    Namespaces `edges`, of type LINE_STRIP, and `stairs`, whose texts are such as
    'up 4 x 0.17 / 0.28 m': direction, treads in sight, rise and run.
    """
    markers = []
    size, orange = (0.04, 0.0, 0.0), (1.0, 0.6, 0.0, 1.0)
    for number, stairs in enumerate(staircases):
        markers += [
            Marker('edges', number, LINE_STRIP, size, orange, stairs.edge),
            _text('stairs', number, str(stairs), stairs.edge.mean(axis=0)),
        ]
    return markers


def of_ramps(ramps: Sequence[Ramp]) -> list[Marker]:
    """Where ramps climb and how steeply: namespaces `climbs`, of type ARROW, and `ramps`."""
    markers = []
    thin, orange = (0.03, 0.06, 0.1), (1.0, 0.6, 0.0, 1.0)
    for ramp in ramps:
        arrow = np.array((ramp.centre, ramp.centre + 2 * ARROW_LENGTH * ramp.climb))
        markers += [
            Marker('climbs', ramp.plane, ARROW, thin, orange, arrow),
            _text('ramps', ramp.plane, str(ramp), ramp.centre),
        ]
    return markers


def _text(namespace: str, number: int, text: str, position: NDArray[np.floating]) -> Marker:
    """White letters of 12 cm that face the viewer."""
    kind, size, white = TEXT_VIEW_FACING, (0.0, 0.0, 0.12), (1.0, 1.0, 1.0, 1.0)
    place = tuple(position.tolist())
    return Marker(namespace, number, kind, size, white, text=text, position=place)
