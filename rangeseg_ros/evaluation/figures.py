"""From overlaps to the figures that are published: per tolerance, over all images."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rangeseg_ros.evaluation.hoover import Classification, classify
from rangeseg_ros.evaluation.measure import Measurement
from rangeseg_ros.evaluation.overlap import overlap_figures
from rangeseg_ros.evaluation.plane_errors import angle_errors, plane_errors

TOLERANCES = (0.51, 0.6, 0.7, 0.8, 0.9, 0.95)
COUNTS = ('regions', 'correct', 'over', 'under', 'missed', 'noise')

_ERRORS = {
    'angle_mean': ('angle deg', 1.0),
    'angle_std': ('+- deg', 1.0),
    'normal_median': ('normal deg', 1.0),
    'offset_median': ('offset mm', 1000.0),
}


def evaluation_figures(
    measurements: Sequence[Measurement], tolerances: Sequence[float]
) -> dict[str, Any]:
    """Figures of one or more images.

    `images`, their number; `tolerances`, for each tolerance the sums of the counts over the
    images, `mean_iou` and `pixel_accuracy` over all their regions and pixels (which do not depend
    on the tolerance), where angles are known `angle_mean` and `angle_std`, degrees, of an image's
    errors, averaged over the images, and where planes are, of those of all correct regions,
    `normal_median`, `normal_worst`, degrees, and `offset_median`, `offset_worst`, metres;
    `precision` and `recall` at intersection over union 0.8; `per_image`, the same for each image
    but errors of planes; `milliseconds`, median time of a segmentation where known.
    """
    figures = {'images': len(measurements), **_figures(measurements, tolerances)}
    figures['per_image'] = {item.name: _figures([item], tolerances) for item in measurements}
    for tolerance in tolerances:
        figures['tolerances'][f'{tolerance:g}'].update(_plane_figures(measurements, tolerance))
    if times := [sum(item.timings.values()) for item in measurements if item.timings]:
        figures['milliseconds'] = float(np.median(times))
    return figures


def _plane_figures(measurements: Sequence[Measurement], tolerance: float) -> dict[str, float]:
    """Over the correct regions of all images whose planes are known."""
    of_images = []
    for item in measurements:
        matches = classify(item.overlap, tolerance).matches
        of_images.append(plane_errors(item.true_planes, item.found_planes, matches))
    errors = np.vstack(of_images)
    if not len(errors):
        return {}
    names = ('normal_median', 'normal_worst', 'offset_median', 'offset_worst')
    values = np.stack([np.median(errors, axis=0), errors.max(axis=0)], axis=1)
    return dict(zip(names, values.ravel().tolist(), strict=True))


def _angle_figures(
    images: Sequence[Measurement], classes: Sequence[Classification]
) -> dict[str, float]:
    """Averages over the images whose angles are known."""
    moments = []
    for image, of_image in zip(images, classes, strict=True):
        normals = {label: plane[:3] for label, plane in image.found_planes.items()}
        if normals:
            errors = angle_errors(image.angles, normals, of_image.matches)
            moments += [(errors.mean(), errors.std())] if errors.size else []
    if not moments:
        return {}
    mean, std = np.mean(moments, axis=0)
    return {'angle_mean': float(mean), 'angle_std': float(std)}


def _figures(images: Sequence[Measurement], tolerances: Sequence[float]) -> dict[str, Any]:
    shared = overlap_figures([image.overlap for image in images])
    table: dict[str, dict[str, float]] = {}
    for tolerance in tolerances:
        classes = [classify(image.overlap, tolerance) for image in images]
        counts = [of_image.counts() for of_image in classes]
        table[f'{tolerance:g}'] = {
            **{key: sum(count[key] for count in counts) for key in COUNTS},
            'mean_iou': shared['mean_iou'],
            'pixel_accuracy': shared['pixel_accuracy'],
            **_angle_figures(images, classes),
        }
    return {'tolerances': table, 'precision': shared['precision'], 'recall': shared['recall']}


def table(figures: Mapping[str, Any]) -> str:
    """Text table of `evaluation_figures`, one row per tolerance.

    Counts are averages per image; of the errors of angles and planes, those that are known.
    """
    tolerances = figures['tolerances']
    known = [key for key in _ERRORS if any(key in row for row in tolerances.values())]
    rows = [['tolerance', *COUNTS, 'mean IoU', 'pixels', *(_ERRORS[key][0] for key in known)]]
    for tolerance, row in tolerances.items():
        averages = [f'{row[key] / figures["images"]:.2f}' for key in COUNTS]
        shares = [f'{row[key]:.3f}' for key in ('mean_iou', 'pixel_accuracy')]
        errors = [f'{row.get(key, math.nan) * _ERRORS[key][1]:.2f}' for key in known]
        rows.append([tolerance, *averages, *shares, *errors])
    return '\n'.join(''.join(f'{cell:>11}' for cell in row) for row in rows)
