"""Test pieces that are detected, by kind, size and distance, with lower confidence bounds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from scipy.special import betaincinv

from rangeseg_ros.core.ground.cells import DROP, GROUND, OBSTACLE
from rangeseg_ros.evaluation.terrain import Shares
from rangeseg_ros.simulation.terrain.testpieces import PIECES

FEWEST = 30
"""Pixels of a piece from which on it is in sight."""
LEVEL = 0.95
"""Of the lower confidence bounds, one-sided."""


class Detection(NamedTuple):
    """Scenes with a test piece of one size (metres, of ramps degrees) at one distance (metres).

    `scenes` are those in which it is in sight, `detected` those in which most of it has its class,
    `ground` those in which most of it is called ground. `bound` is the lower confidence bound of
    the probability that it is detected, `worst` the scene in which the least of it was found.
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
    return float(betaincinv(successes, trials - successes + 1, 1 - LEVEL)) if successes else 0.0


def detections(images: Sequence[Shares]) -> list[Detection]:
    """A row for each kind, size and distance of test pieces, in the order of the images."""
    found: dict[tuple[str, float, float], list[tuple[float, float, str]]] = {}
    for image in images:
        name, *numbers = image.kind.split()
        if name not in PIECES or len(numbers) != 2:
            continue
        of_piece = found.setdefault((name, float(numbers[0]), float(numbers[1])), [])
        # Of ramps that are ground, the ground is what is to be found.
        flat = name == 'ramp' and not image.pixels[[OBSTACLE, DROP]].any()
        true = [GROUND] if flat else [OBSTACLE, DROP]
        total = image.pixels[true].sum()
        if total >= FEWEST:
            right = image.pixels[true, true].sum() / total
            ground = 0.0 if flat else image.pixels[true, GROUND].sum() / total
            of_piece.append((float(right), float(ground), image.name))
    rows = []
    for piece, scenes in found.items():
        detected = sum(right > 0.5 for right, _, _ in scenes)
        danger = sum(ground > 0.5 for _, ground, _ in scenes)
        worst = f'{min(scenes)[2]}: {min(scenes)[0]:.2f}' if scenes else ''
        bound = lower_bound(detected, len(scenes))
        rows.append(Detection(*piece, len(scenes), detected, danger, bound, worst))
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
