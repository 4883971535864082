"""Test pieces that are detected, by kind, size and distance, with lower confidence bounds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rangeseg_ros.core.ground.classes import DROP, GROUND, OBSTACLE
from rangeseg_ros.evaluation.terrain import Shares
from rangeseg_ros.simulation.terrain.testpieces import PIECES

FEWEST = 30
"""Pixels of a piece from which on it is in sight."""
LEVEL = 0.95
"""Of the lower confidence bounds, one-sided."""


class Detection(NamedTuple):
    """Scenes with a test piece of one size at one distance.

    Attributes
    ----------
    kind : str
    size, distance : float
        Metres; the size of ramps is in degrees.
    scenes, detected, ground : int
        In which the piece is in sight, in which most of it has its class, and in which most of it
        is called ground.
    bound : float
        Lower confidence bound of the probability that it is detected.
    worst : str
        The scene in which the least of it was found, and its share.
    """

    kind: str
    size: float
    distance: float
    scenes: int
    detected: int
    ground: int
    bound: float
    worst: str


def lower_bound(successes: int, trials: int) -> float:
    """One-sided lower bound of a probability at `LEVEL` (C. Clopper and E. Pearson 1934)."""
    if not successes:
        return 0.0
    low, high = 0.0, 1.0
    while low < (middle := (low + high) / 2) < high:
        # The probability of so many successes or more.
        terms = (
            _binomial(trials, k) * middle**k * (1 - middle) ** (trials - k)
            for k in range(successes, trials + 1)
        )
        low, high = (middle, high) if sum(terms) < 1 - LEVEL else (low, middle)
    return low


def _binomial(n: int, k: int) -> float:
    return float(np.prod([(n - k + i) / i for i in range(1, k + 1)]))


def detections(images: Sequence[Shares]) -> list[Detection]:
    """A row for each kind, size and distance of test pieces, in the order of the images."""
    rows = []
    kinds = dict.fromkeys(image.kind for image in images)
    for kind in (kind for kind in kinds if kind.split()[0] in PIECES and len(kind.split()) == 3):
        name, size, distance = kind.split()
        found = []
        for image in images:
            # Of ramps that are ground, the ground is what is to be found.
            flat = name == 'ramp' and not image.pixels[[OBSTACLE, DROP]].any()
            true = [GROUND] if flat else [OBSTACLE, DROP]
            total = image.pixels[true].sum()
            if image.kind == kind and total >= FEWEST:
                right = sum(image.pixels[k, k] for k in true) / total
                ground = 0.0 if flat else image.pixels[true, GROUND].sum() / total
                found.append((float(right), float(ground), image.name))
        detected = sum(right > 0.5 for right, _, _ in found)
        worst = f'{min(found)[2]}: {min(found)[0]:.2f}' if found else ''
        danger = sum(ground > 0.5 for _, ground, _ in found)
        bound = lower_bound(detected, len(found))
        size_, at = float(size), float(distance)
        rows.append(Detection(name, size_, at, len(found), detected, danger, bound, worst))
    return rows


def detection_table(rows: Sequence[Detection]) -> str:
    """Text of `detections`: detected of the scenes in which a piece is in sight, and the bound."""
    places = sorted({row.distance for row in rows})
    lines = ['test pieces detected (lower bound), at ' + ', '.join(f'{p:g} m' for p in places)]
    for kind, size in dict.fromkeys((row.kind, row.size) for row in rows):
        cells = [
            f'{row.detected}/{row.scenes} ({row.bound:.2f})' if row.scenes else '-'
            for row in rows
            if (row.kind, row.size) == (kind, size)
        ]
        lines.append(f'{kind:<10}{size:>5g}' + ''.join(f'{cell:>16}' for cell in cells))
    return '\n'.join(lines)
