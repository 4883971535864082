"""The report of a calibration: the field, what it explains, and planes before and after."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from rangeseg_ros.core.arrays import Singles
from rangeseg_ros.core.calibration.calibrate import Calibration
from rangeseg_ros.report.charts import svg
from rangeseg_ros.report.page import write_page


class Shown(NamedTuple):
    """Residuals of the planes of a frame, without and with the correction, and how many planes.

    `residuals` (2, H, W) are in 1/m, NaN where there is no plane.
    """

    frame: int
    residuals: Singles
    planes: tuple[int, int]


def write_calibration(
    path: Path,
    names: Sequence[str],
    result: Calibration,
    parameters: Mapping[str, object],
    shown: Sequence[Shown],
) -> None:
    """Write the page of recordings: `parameters` of the sensor, and frames to show."""
    distortion = result.distortion
    offset, slope, deviation = distortion.offset, distortion.slope, distortion.deviation
    assert deviation is not None
    limit = _extent(offset)
    fields = [('Distortion of the inverse depth, 1/m', offset, -limit, limit, 'RdBu_r')]
    if slope is not None:
        largest = _extent(slope)
        fields.append(('Change with the inverse depth', slope, -largest, largest, 'RdBu_r'))
    fields.append(('Standard deviation, 1/m', deviation, 0.0, limit, 'viridis'))
    views = result.views.astype(np.float32)
    fields.append(('Distances at which it was seen', views, 0.0, float(views.max()), 'viridis'))
    walls = []
    for frame, residuals, planes in shown:
        titled = zip(('before', 'after'), residuals, strict=True)
        pictures = [(title, image, -limit, limit, 'RdBu_r') for title, image in titled]
        walls.append((frame, planes, [_rms(image) for image in residuals], _images(pictures)))
    ninths = [
        (_rms(a), _rms(b), float(np.median(c)))
        for rows in zip(*(np.array_split(f, 3) for f in (offset, deviation, views)), strict=True)
        for a, b, c in zip(*(np.array_split(part, 3, axis=1) for part in rows), strict=True)
    ]
    write_page(
        path,
        'calibration.html',
        name=', '.join(names),
        result=result,
        rms=_rms(offset),
        known=_rms(deviation),
        regions=[ninths[:3], ninths[3:6], ninths[6:]],
        fields=_images(fields),
        profiles=_profiles(offset),
        walls=walls,
        parameters=parameters,
    )


def _extent(field: Singles) -> float:
    """Where the colours of a field end."""
    return float(np.quantile(np.abs(field), 0.99)) or 1e-6


def _rms(field: Singles) -> float:
    return float(np.sqrt(np.nanmean(field**2)))


def _images(images: Sequence[tuple[str, Singles, float, float, str]]) -> str:
    """Pictures with a title, a range and a colour map each, two in a row."""
    rows = -(-len(images) // 2)
    figure = Figure(figsize=(10, 3.6 * rows), layout='constrained')
    for place, (title, image, low, high, colours) in enumerate(images, 1):
        axes = figure.add_subplot(rows, 2, place)
        # No more pixels than the page shows.
        step = max(image.shape[1] // 320, 1)
        drawn = axes.imshow(image[::step, ::step], vmin=low, vmax=high, cmap=colours)
        axes.set_title(title, fontsize=10)
        axes.set_axis_off()
        figure.colorbar(drawn, ax=axes, shrink=0.8)
    return svg(figure)


def _profiles(offset: Singles) -> str:
    """Mean of the field over rows and over columns."""
    figure = Figure(figsize=(10, 3.2), layout='constrained')
    both = figure.subplots(1, 2, sharey=True)
    labels = 'column, mean over the rows', 'row, mean over the columns'
    for axis, (axes, label) in enumerate(zip(both, labels, strict=True)):
        axes.plot(offset.mean(axis=axis))
        axes.set_xlabel(label)
        axes.grid(alpha=0.3)
    both[0].set_ylabel('1/m')
    return svg(figure)
