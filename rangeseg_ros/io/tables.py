"""Tables as CSV: planes, stairs, and the ground of each image."""

from __future__ import annotations

import csv
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.ground.stairs import Stairs
from rangeseg_ros.core.rotations import quaternions
from rangeseg_ros.core.segmentation import Segmentation
from rangeseg_ros.io.files import replacing
from rangeseg_ros.messages.clouds import COVARIANCE, EDGE

STAIRS = (*EDGE, 'width', 'count', 'rise', 'run', 'direction')
"""Columns of stairs: ends of the first edge in the frame of the image; metres."""
GROUND = ('found', 'height', 'confidence', 'tilt')
"""Columns of the ground: whether one is found, how far below the camera it is, metres, how likely
it is the floor that the robot stands on, and degrees between the stated up and that of the planes,
0 where they agree."""


def _points(points: NDArray) -> str:
    return ';'.join(' '.join(f'{x:.9g}' for x in point) for point in points)


def _axes(name: str, axes: str = 'xyz') -> list[str]:
    return [f'{name}_{axis}' for axis in axes]


# Columns of the fields of a plane that are no single value, and their values; the covariance is
# symmetric.
_PARTS: dict[str, tuple[list[str], Callable[[Any], Iterable[Any]]]] = {
    'normal': (_axes('normal'), list),
    'centroid': (_axes('centroid'), list),
    'covariance': (COVARIANCE, lambda covariance: covariance[np.triu_indices(4)]),
    'shape': (
        ['area', 'length', 'width', *_axes('centre'), *_axes('orientation', 'xyzw')],
        lambda shape: [shape.area, *shape.extents, *shape.centre, *quaternions(shape.frame)],
    ),
    'outline': (
        ['hull', 'holes'],
        lambda outline: [_points(outline.hull), '|'.join(map(_points, outline.holes))],
    ),
}


def columns(kind: type[Plane] = Plane, without: Collection[str] = ()) -> list[str]:
    """Names of the columns of planes, in the order of the fields of `kind`.

    `covariance_xd` is that of normal_x and distance. Outlines are points 'x y z' joined by ';',
    holes are joined by '|'.
    """
    names = [field.name for field in fields(kind) if field.name not in without]
    return [column for name in names for column in _PARTS.get(name, ([name], list))[0]]


def values(plane: Plane, without: Collection[str] = ()) -> list[Any]:
    """Values of `plane` for `columns`."""
    found: list[Any] = []
    for field in fields(plane):
        if field.name not in without:
            value = getattr(plane, field.name)
            found.extend(_PARTS[field.name][1](value) if field.name in _PARTS else [value])
    return found


def parts_value(plane: Plane) -> str:
    """All parts of a plane, joined by '||': the hull of each and its holes, joined by '|'."""
    return '||'.join('|'.join(map(_points, part)) for part in plane.outline.parts)


def stairs_values(stairs: Stairs) -> list[Any]:
    """Values of a staircase for the columns `STAIRS`."""
    size = (stairs.width, stairs.count, stairs.rise, stairs.run, stairs.direction)
    return [*stairs.edge.ravel(), *size]


def ground_values(result: Segmentation) -> list[Any]:
    """Values of an image for the columns `GROUND`."""
    ground, tilt = result.ground, result.tilt.degrees if result.tilt else 0.0
    if ground is None or not ground.stand.found:
        return [0, '', '', tilt]
    return [1, ground.stand.height(ground.field.up), ground.stand.confidence, tilt]


@contextmanager
def open_table(
    path: Path, columns: Iterable[str]
) -> Iterator[Callable[[Iterable[Iterable[Any]]], None]]:
    """Begin a table; gives what appends rows, which are in the file at once."""
    with path.open('w', newline='', buffering=1) as file:
        table = csv.writer(file, lineterminator='\n')
        table.writerow(columns)
        yield lambda rows: table.writerows(map(_text, row) for row in rows)


def write_table(path: Path, columns: Sequence[str], rows: Iterable[Iterable[Any]]) -> None:
    """Write a table, whole or not at all."""
    with replacing(path) as partial, open_table(partial, columns) as append:
        append(rows)


def _text(value: Any) -> str:
    return f'{value:.9g}' if isinstance(value, float | np.floating) else str(value)
