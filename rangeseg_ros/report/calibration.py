"""The report of a calibration: the field, what it explains, and planes before and after."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from rangeseg_ros.core.calibration.calibrate import Calibration
from rangeseg_ros.report.charts import svg
from rangeseg_ros.report.page import write_page


class Shown(NamedTuple):
    """Residuals of the planes of a frame.

    Attributes
    ----------
    frame : int
    residuals : (2, H, W) float32
        Without and with the correction, 1/m, NaN where there is no plane.
    planes : (int, int)
        Number of planes.
    """

    frame: int
    residuals: NDArray[np.float32]
    planes: tuple[int, int]


def write_calibration(
    path: Path,
    names: Sequence[str],
    result: Calibration,
    parameters: Mapping[str, object],
    shown: Sequence[Shown],
) -> None:
    """Write the page.

    Parameters
    ----------
    path : Path
    names : sequence of str
        Recordings.
    result : Calibration
    parameters : mapping
        Of the sensor, as measured.
    shown : sequence of Shown
        Frames to show.
    """
    distortion = result.distortion
    limit = float(np.quantile(np.abs(distortion.offset), 0.99)) or 1e-6
    fields = {
        'Distortion of the inverse depth, 1/m': (distortion.offset, -limit, limit, 'RdBu_r'),
    }
    if distortion.slope is not None:
        largest = float(np.quantile(np.abs(distortion.slope), 0.99)) or 1e-6
        fields['Change with the inverse depth'] = (distortion.slope, -largest, largest, 'RdBu_r')
    deviation = distortion.deviation
    assert deviation is not None
    fields['Standard deviation, 1/m'] = (deviation, 0.0, limit, 'viridis')
    views = result.views.astype(np.float32)
    fields['Distances at which it was seen'] = (views, 0.0, float(views.max()), 'viridis')
    write_page(
        path,
        'calibration.html',
        name=', '.join(names),
        result=result,
        rms=float(np.sqrt((distortion.offset**2).mean())),
        known=float(np.sqrt((deviation**2).mean())),
        regions=_regions(result),
        fields=_images([(title, *field) for title, field in fields.items()], 2),
        profiles=_profiles(distortion.offset),
        walls=[
            (
                frame.frame,
                frame.planes,
                [float(np.sqrt(np.nanmean(image**2))) for image in frame.residuals],
                _images(
                    [
                        (title, image, -limit, limit, 'RdBu_r')
                        for title, image in zip(('before', 'after'), frame.residuals, strict=True)
                    ],
                    2,
                ),
            )
            for frame in shown
        ],
        parameters=parameters,
    )


def _regions(result: Calibration) -> list[list[tuple[float, float, float]]]:
    """Distortion, uncertainty and views, of a ninth of the image each, row by row."""
    distortion = result.distortion
    assert distortion.deviation is not None
    table = []
    for rows in zip(
        *(np.array_split(a, 3) for a in (distortion.offset, distortion.deviation, result.views)),
        strict=True,
    ):
        columns = zip(*(np.array_split(part, 3, axis=1) for part in rows), strict=True)
        table.append(
            [
                (
                    float(np.sqrt((offset**2).mean())),
                    float(np.sqrt((deviation**2).mean())),
                    float(np.median(views)),
                )
                for offset, deviation, views in columns
            ]
        )
    return table


def _images(
    images: Sequence[tuple[str, NDArray[np.float32], float, float, str]], columns: int
) -> str:
    """Pictures with a title, a range and a colour map each, side by side."""
    rows = -(-len(images) // columns)
    figure = Figure(figsize=(10, 3.6 * rows), layout='constrained')
    for place, (title, image, low, high, colours) in enumerate(images, 1):
        axes = figure.add_subplot(rows, columns, place)
        # No more pixels than the page shows.
        step = max(image.shape[1] // 320, 1)
        drawn = axes.imshow(image[::step, ::step], vmin=low, vmax=high, cmap=colours)
        axes.set_title(title, fontsize=10)
        axes.set_axis_off()
        figure.colorbar(drawn, ax=axes, shrink=0.8)
    return svg(figure)


def _profiles(offset: NDArray[np.float32]) -> str:
    """Mean of the field over rows and over columns."""
    figure = Figure(figsize=(10, 3.2), layout='constrained')
    left, right = figure.subplots(1, 2, sharey=True)
    left.plot(offset.mean(axis=0))
    left.set_xlabel('column, mean over the rows')
    left.set_ylabel('1/m')
    right.plot(offset.mean(axis=1))
    right.set_xlabel('row, mean over the columns')
    for axes in (left, right):
        axes.grid(alpha=0.3)
    return svg(figure)
