"""Tables of stairs, and of the ground of each image: CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from rangeseg_ros.core.ground.stairs import Stairs
from rangeseg_ros.core.segmentation import Segmentation
from rangeseg_ros.io.files import replacing

STAIRS = (
    *('edge_x1', 'edge_y1', 'edge_z1', 'edge_x2', 'edge_y2', 'edge_z2'),
    *('width', 'count', 'rise', 'run', 'direction'),
)
"""Columns of stairs: ends of the first edge in the frame of the image; metres."""
GROUND = ('found', 'height', 'confidence', 'tilt')
"""Columns of the ground: whether one is found, how far below the camera it is, metres, how likely
it is the floor that the robot stands on, and degrees between the stated up and that of the planes,
0 where they agree."""


def stairs_row(stairs: Stairs) -> list[str]:
    """Values of a staircase for the columns `STAIRS`."""
    numbers = [*stairs.edge.ravel(), stairs.width]
    return [
        *(f'{float(x):.9g}' for x in numbers),
        str(stairs.count),
        *(f'{x:.9g}' for x in (stairs.rise, stairs.run)),
        stairs.direction,
    ]


def ground_row(result: Segmentation) -> list[str]:
    """Values of an image for the columns `GROUND`."""
    ground, tilt = result.ground, result.tilt.degrees if result.tilt else 0.0
    if ground is None or not ground.stand.found:
        return ['0', '', '', f'{tilt:.9g}']
    height = ground.stand.height(ground.field.up)
    return ['1', *(f'{x:.9g}' for x in (height, ground.stand.confidence, tilt))]


def write_table(path: Path, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Write a table, whole or not at all."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator='\n')
    table.writerow(columns)
    table.writerows(rows)
    with replacing(path) as partial:
        partial.write_text(text.getvalue())
