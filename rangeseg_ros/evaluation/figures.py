"""From overlaps to the figures that are published: per tolerance, over all images."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rangeseg_ros.evaluation.hoover import (
    Overlap,
    angle_errors,
    classify,
    overlap_figures,
    plane_errors,
)
from rangeseg_ros.evaluation.measure import Measurement

TOLERANCES = (0.51, 0.6, 0.7, 0.8, 0.9, 0.95)
COUNTS = ('regions', 'correct', 'over', 'under', 'missed', 'noise')


def compared(overlaps: Mapping[str, Overlap], tolerances: Sequence[float]) -> dict[str, Any]:
    """Figures of one or more images.

    Returns
    -------
    dict
        `images`, their number; `tolerances`, for each tolerance the sums of the counts over the
        images, with `mean_iou` and `pixel_accuracy` over all their regions and pixels (which do
        not depend on the tolerance); `precision` and `recall` at intersection over union 0.8;
        `per_image`, the same for each image.
    """
    figures = _figures(list(overlaps.values()), tolerances)
    single = {name: _figures([overlap], tolerances) for name, overlap in overlaps.items()}
    return {'images': len(overlaps), **figures, 'per_image': single}


def evaluated(measurements: Sequence[Measurement], tolerances: Sequence[float]) -> dict[str, Any]:
    """Figures of `compared`, and the errors of angles and planes where the truth knows them.

    Returns
    -------
    dict
        As `compared`, and for each tolerance `angle_mean` and `angle_std`, degrees, mean and
        standard deviation of an image's angle errors averaged over the images, and of the planes
        of all correct regions `normal_median`, `normal_worst`, degrees, and `offset_median`,
        `offset_worst`, metres; NaN where there is nothing to measure. `milliseconds`: median
        time of a segmentation.
    """
    figures = compared({item.name: item.overlap for item in measurements}, tolerances)
    for tolerance in tolerances:
        figures['tolerances'][f'{tolerance:g}'].update(_geometry(measurements, tolerance))
    figures['milliseconds'] = float(np.median([sum(m.timings.values()) for m in measurements]))
    return figures


def _geometry(measurements: Sequence[Measurement], tolerance: float) -> dict[str, float]:
    angles, planes = [], [np.zeros((0, 2))]
    for item in measurements:
        matches = classify(item.overlap, tolerance).matches
        normals = {label: plane[:3] for label, plane in item.found_planes.items()}
        errors = angle_errors(item.angles, normals, matches)
        if errors.size:
            angles.append((errors.mean(), errors.std()))
        planes.append(plane_errors(item.true_planes, item.found_planes, matches))
    mean, std = np.mean(angles, axis=0) if angles else (math.nan, math.nan)
    pooled = np.vstack(planes)
    if not len(pooled):
        pooled = np.full((1, 2), math.nan)
    median, worst = np.median(pooled, axis=0), pooled.max(axis=0)
    return {
        'angle_mean': float(mean),
        'angle_std': float(std),
        'normal_median': float(median[0]),
        'normal_worst': float(worst[0]),
        'offset_median': float(median[1]),
        'offset_worst': float(worst[1]),
    }


def _figures(overlaps: Sequence[Overlap], tolerances: Sequence[float]) -> dict[str, Any]:
    shared = overlap_figures(overlaps)
    table: dict[str, dict[str, float]] = {}
    for tolerance in tolerances:
        counts = [classify(overlap, tolerance).counts() for overlap in overlaps]
        table[f'{tolerance:g}'] = {
            **{key: sum(count[key] for count in counts) for key in COUNTS},
            'mean_iou': shared['mean_iou'],
            'pixel_accuracy': shared['pixel_accuracy'],
        }
    return {'tolerances': table, 'precision': shared['precision'], 'recall': shared['recall']}


def as_json(value: Any) -> Any:
    """`value` with None in the place of NaN, which JSON does not know."""
    if isinstance(value, Mapping):
        return {key: as_json(item) for key, item in value.items()}
    if isinstance(value, float) and math.isnan(value):
        return None
    return value


def table(figures: Mapping[str, Any]) -> str:
    """Text table of `compared`: averages per image of the counts, one row per tolerance."""
    head = ['tolerance', *COUNTS, 'mean IoU', 'pixels']
    rows = [head]
    for tolerance, row in figures['tolerances'].items():
        averages = [f'{row[key] / figures["images"]:.2f}' for key in COUNTS]
        rows.append(
            [tolerance, *averages, f'{row["mean_iou"]:.3f}', f'{row["pixel_accuracy"]:.3f}']
        )
    return '\n'.join(''.join(f'{cell:>10}' for cell in row) for row in rows)
