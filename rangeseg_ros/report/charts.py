"""Charts of a sequence of frames, as SVG."""

from __future__ import annotations

import io

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats
from rangeseg_ros.drawing import colours

MAX_BARS, MAX_LINES = 40, 8
"""Planes in the chart of ids, and in those of drift, at most."""

# One row per plane and frame.
SIGHTING = np.dtype(
    [('frame', int), ('id', int), ('area', float), ('distance', float), ('normal', float, 3)]
)


def longest_seen(sightings: NDArray[np.void], count: int) -> NDArray[np.int64]:
    """Ids of the planes with the largest area summed over all frames, largest first."""
    ids, place = np.unique(sightings['id'], return_inverse=True)
    order = np.argsort(-np.bincount(place, sightings['area']), kind='stable')
    chosen: NDArray[np.int64] = ids[order[:count]]
    return chosen


def runs(frames: NDArray[np.integer]) -> list[tuple[int, int]]:
    """First and last of each unbroken run of frames, which are given in order."""
    parts = np.split(frames, np.flatnonzero(np.diff(frames) > 1) + 1)
    return [(int(part[0]), int(part[-1])) for part in parts]


def id_bars(sightings: NDArray[np.void], times: Floats) -> str:
    """When each plane was in sight: a row for each id, `times` (N,) in seconds of the frames."""
    ids = np.sort(longest_seen(sightings, MAX_BARS))
    figure = Figure(figsize=(10, 1.2 + 0.2 * len(ids)), layout='constrained')
    axes = figure.subplots()
    step = np.median(np.diff(times)) if len(times) > 1 else 1.0
    for row, (number, colour) in enumerate(zip(ids, colours(ids) / 255, strict=True)):
        seen = runs(sightings['frame'][sightings['id'] == number])
        spans = [(times[first], times[last] - times[first] + step) for first, last in seen]
        axes.broken_barh(spans, (row - 0.4, 0.8), color=colour)
    axes.set_yticks(range(len(ids)), [str(number) for number in ids], fontsize=8)
    axes.invert_yaxis()
    axes.set(xlabel='seconds', ylabel='id')
    axes.grid(alpha=0.3)
    return svg(figure)


def drifts(sightings: NDArray[np.void], times: Floats) -> str:
    """How distance and normal of the largest planes change, relative to their medians."""
    figure = Figure(figsize=(10, 5.5), layout='constrained')
    upper, lower = figure.subplots(2, 1, sharex=True)
    ids = longest_seen(sightings, MAX_LINES)
    for number, colour in zip(ids, colours(ids) / 255, strict=True):
        own = sightings[sightings['id'] == number]
        middle = np.median(own['normal'], axis=0)
        cosine = own['normal'] @ middle / np.linalg.norm(middle)
        angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        distance = 1000 * (own['distance'] - np.median(own['distance']))
        # Lines do not cross the frames in which the plane was out of sight.
        gaps = np.flatnonzero(np.diff(own['frame']) > 1) + 1
        x = np.insert(times[own['frame']], gaps, np.nan)
        for axes, y in ((upper, distance), (lower, angle)):
            y = np.insert(y, gaps, np.nan)
            axes.plot(x, y, color=colour, marker='.', markersize=3, linewidth=1, label=number)
    upper.set_ylabel('distance, mm')
    lower.set(xlabel='seconds', ylabel='normal, degrees')
    lower.set_ylim(bottom=0)
    for axes in (upper, lower):
        axes.grid(alpha=0.3)
    if len(ids):
        figure.legend(*upper.get_legend_handles_labels(), title='id', loc='outside right upper')
    return svg(figure)


def svg(figure: Figure) -> str:
    """A figure as SVG."""
    text = io.StringIO()
    # Without date and random identifiers: the same figures give the same bytes.
    with rc_context({'svg.hashsalt': 'rangeseg'}):
        FigureCanvasSVG(figure).print_svg(text, metadata={'Date': None})
    return text.getvalue()
