"""The picture of a floor plan, and its page: to look at, to turn, to measure in."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rangeseg_ros.drawing import colours
from rangeseg_ros.io.files import replacing
from rangeseg_ros.io.plans import plane_row
from rangeseg_ros.plan.floor_plan import FREE, OCCUPIED, FloorPlan, deviation_of
from rangeseg_ros.plan.right_angles import Squared
from rangeseg_ros.report.page import render, write_page

# Deviations of walls, metres, up to which they have the colours of the legend.
_CLASSES = (
    (0.002, '#1a9850'),
    (0.005, '#66a61e'),
    (0.01, '#e6ab02'),
    (0.02, '#e66101'),
    (np.inf, '#b2182b'),
)
_FILLS = {'floor': '#eef3f8', 'table': '#e4d8c4'}
# Around the plan, and below it for the legend, metres.
_MARGIN, _LEGEND = 0.3, 1.3


def svg(plan: FloorPlan) -> str:
    """The plan as an SVG picture, 100 units to the metre, y down."""
    height, width = plan.cells.shape
    left, low = plan.origin
    side = plan.resolution
    top = -low - height * side - _MARGIN
    down = height * side + 2 * _MARGIN + _LEGEND
    box = [left - _MARGIN, top, width * side + 2 * _MARGIN, down]
    level = []
    for plane in plan.planes:
        if plane.drawn:
            rings = [ring[:, :2] * (1, -1) for ring in plane.outline.rings]
            path = ''.join('M' + 'L'.join(f'{x:.3f} {y:.3f}' for x, y in r) + 'Z' for r in rings)
            fill = _FILLS.get(plane.role, '#ececec')
            level.append((plane.role, fill, path, _title(plane)))
    walls = []
    for wall in plan.walls:
        plane = plan.planes[wall.plane]
        colour = next(colour for most, colour in _CLASSES if deviation_of(plane) <= most)
        for ends in wall.segments:
            title = f'{_title(plane)}, {np.linalg.norm(ends[1] - ends[0]):.3f} m long'
            walls.append((plane.role, ends.round(3).tolist(), colour, title))
    return render(
        'plan.svg',
        plan=plan,
        box=np.round(box, 3).tolist(),
        side=side,
        free=_runs(plan, FREE),
        occupied=_runs(plan, OCCUPIED),
        level=level,
        walls=walls,
        openings=[(o.ends.round(3).tolist(), o.width) for o in plan.openings],
        stairs=[(flight.edges.round(3).tolist(), str(flight)) for flight in plan.stairs],
        classes=_CLASSES,
    )


def _title(plane: Squared) -> str:
    name = f'{plane.role} {plane.id}: {plane.area:.2f} m2'
    exact = f', {plane.exact}' if plane.exact else ''
    return f'{name}, standard deviation {1e3 * deviation_of(plane):.1f} mm{exact}'


def _runs(plan: FloorPlan, value: int) -> list[list[float]]:
    """Runs of cells of a value along the rows: left end, upper side and width, y down."""
    cells = np.pad((plan.cells == value).astype(np.int8), [(0, 0), (1, 1)])
    row, ends = np.nonzero(np.diff(cells, axis=1))
    start, end = ends.reshape(-1, 2).T * plan.resolution
    upper = -plan.origin[1] - (row[::2] + 1) * plan.resolution
    found: list[list[float]] = np.stack([plan.origin[0] + start, upper, end - start], 1).tolist()
    return [[round(v, 3) for v in run] for run in found]


def write_picture(path: Path, plan: FloorPlan) -> None:
    """Write the plan as SVG."""
    with replacing(path) as partial:
        partial.write_text(svg(plan), encoding='utf-8')


def write_plan_page(path: Path, name: str, plan: FloorPlan, warnings: Sequence[str] = ()) -> None:
    """Write the page of a recording, which needs no other file, with what is to be known of it."""
    solids = [
        {
            'name': f'{plane.role} {plane.id}',
            'colour': colours([plane.id])[0].tolist(),
            'corners': np.round(corners, 4).tolist(),
            'faces': faces.tolist(),
        }
        for plane in plan.planes
        for corners, faces in [plane.mesh()]
    ]
    write_page(
        path,
        'plan.html',
        name=name,
        warnings=warnings,
        frame=plan.frame,
        up=plan.up,
        degrees=float(np.degrees(plan.up.deviation)),
        turned=not np.array_equal(plan.motion.rotation, np.eye(3)),
        drawing=svg(plan),
        rows=sorted(map(plane_row, plan.planes), key=lambda row: -row['area']),
        openings=[round(opening.width, 3) for opening in plan.openings],
        stairs=[str(flight) for flight in plan.stairs],
        solids=json.dumps(solids, separators=(',', ':')),
    )
