"""Flights of stairs of a plan: what single frames saw of them, put together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rangeseg_ros.core.arrays import Floats
from rangeseg_ros.core.ground.stairs import Stairs
from rangeseg_ros.core.mapping.transforms import Transform

# Sightings of a flight, as often as cells of planes are found until they are sure.
_SIGHTINGS = 3


class Flight(NamedTuple):
    """Ends (N, 2, 2) of the first edge and of those behind it, up to the end of the last tread.

    Metres, from above. `rise` and `run` are those of a tread, `direction` is 'up' or 'down'.
    """

    edges: Floats
    rise: float
    run: float
    direction: str

    def __str__(self) -> str:
        return (
            f'stairs {self.direction}, {len(self.edges) - 1} x {self.rise:.2f} / {self.run:.2f} m'
        )


def flights(seen: Sequence[tuple[Stairs, Transform]]) -> list[Flight]:
    """Flights that several frames show at one place.

    Of each, the stairs and the motion that takes the frame of the image to that of the plan.
    Stairs are one flight where their first edges are less than a run apart and face one way.
    """
    groups: list[list[tuple[Stairs, Floats, Floats]]] = []
    for stairs, pose in seen:
        ends = pose.apply(stairs.edge)[:, :2]
        along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        ahead, middle = np.array([-along[1], along[0]]), ends.mean(axis=0)
        if ahead @ (middle - pose.shift[:2]) < 0:
            ahead, ends = -ahead, ends[::-1]
        for group in groups:
            first, there, way = group[0]
            gap, same = middle - there.mean(axis=0), first.direction == stairs.direction
            near = abs(way @ gap) < first.run and np.hypot(*gap) < max(first.width, stairs.width)
            if near and same and way @ ahead > 0.5**0.5:
                group.append((stairs, ends, ahead))
                break
        else:
            groups.append([(stairs, ends, ahead)])
    found = []
    for group in groups:
        if len(group) >= _SIGHTINGS:
            each, edges, ways = zip(*group, strict=True)
            rise, run = np.median([(one.rise, one.run) for one in each], axis=0).tolist()
            ahead = np.mean(ways, axis=0) / np.linalg.norm(np.mean(ways, axis=0))
            steps = run * np.arange(max(one.count for one in each) + 1)
            places = np.median(edges, axis=0) + steps[:, None, None] * ahead
            found.append(Flight(places, rise, run, each[0].direction))
    return found
