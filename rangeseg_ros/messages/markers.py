"""Planes, the ground and stairs as RViz markers: what is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

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

_NOWHERE = np.zeros((0, 3))


class Marker(NamedTuple):
    """What a visualization_msgs/Marker says, at the origin unless it is a text at `position`.

    Its ns, id and type; metres; red, green, blue and opacity, 0...1; points (N, 3), metres.
    """

    namespace: str
    number: int
    kind: int
    scale: tuple[float, float, float]
    colour: tuple[float, float, float, float]
    points: NDArray[np.floating] = _NOWHERE
    text: str = ''
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    action: int = ADD


CLEAR = Marker('', 0, ARROW, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0, 0.0), action=DELETEALL)
"""Removes all older markers; the first of every message."""


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
    x, y, z = position.tolist()
    size, white = (0.0, 0.0, 0.12), (1.0, 1.0, 1.0, 1.0)
    return Marker(namespace, number, TEXT_VIEW_FACING, size, white, text=text, position=(x, y, z))
