"""The page of a floor plan: to look at, to turn, to measure in."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rangeseg_ros.core.mapping.floor_plan import FloorPlan
from rangeseg_ros.drawing import colours
from rangeseg_ros.io.plans import meshes, plane_rows, svg
from rangeseg_ros.report.page import write_page


def write_plan_page(path: Path, name: str, plan: FloorPlan, warnings: Sequence[str] = ()) -> None:
    """Write the page, which needs no other file.

    Parameters
    ----------
    path : Path
    name : str
        Of the recording.
    plan : FloorPlan
    warnings : sequence of str
        What is to be known of the recording.
    """
    solids = [
        {
            'name': f'{plane.role} {plane.id}',
            'colour': colours([plane.id])[0].tolist(),
            'corners': np.round(corners, 4).tolist(),
            'faces': faces.tolist(),
        }
        for plane, corners, faces in meshes(plan)
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
        rows=sorted(plane_rows(plan), key=lambda row: -row['area']),
        openings=[round(opening.width, 3) for opening in plan.openings],
        solids=json.dumps(solids, separators=(',', ':')),
    )
