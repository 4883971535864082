"""From overlaps to the figures that are published: per tolerance, over all images."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from rangeseg_ros.evaluation.hoover import Overlap, classify, overlap_figures

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
