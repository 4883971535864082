"""What the thesis and others have published: parameters, regions found."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from rangeseg_ros.core.config import Config
from rangeseg_ros.evaluation.figures import TOLERANCES

THESIS = Config(
    method='normals',
    normals='cross_product',
    normal_baseline=1,
    jump_edges='sobel',
    directions='platonic',
    direction_count=305,
    smoothness=55.0,
    weighting='uniform',
    noise_regions='identify',
    # Pixels on jump edges are disconnected one by one and form no regions (white in figure 5.6).
    min_pixels=2,
)
"""The parameters of the thesis (6.6)."""

AS_PUBLISHED = {
    'perceptron': THESIS,
    # sigma = 1, in the unit of the images (6.7.1).
    'abw': replace(THESIS, dithering=0.001),
    # No post-processing (6.7.2).
    'kinect': replace(THESIS, smoothness=100.0, noise_regions='leave'),
}
"""The same for each sensor; `params/thesis_<sensor>.yaml` say it to the other commands."""

CORRECT_PERCEPTRON = {
    'WSU': (5.8, 6.1, 6.5, 5.9, 4.1, 2.5),
    'USF': (10.8, 10.7, 9.8, 9.0, 4.8, 1.5),
    'UB': (11.1, 11.1, 10.6, 9.6, 7.0, 3.7),
    'UE': (11.0, 11.0, 10.6, 10.0, 7.6, 3.7),
    'EG': (11.8, 11.6, 11.4, 10.7, 7.4, 3.8),
    'RCA': (10.1, 10.3, 10.3, 9.6, 6.7, 3.2),
    'UBHam': (11.1, 11.9, 11.6, 11.2, 8.4, 4.6),
    'UFPR': (12.6, 12.6, 12.1, 11.0, 8.1, 4.6),
    'UFPR/OSU': (12.1, 12.1, 11.9, 10.8, 7.7, 4.8),
    'thesis, identified': (11.6, 11.5, 11.2, 10.3, 7.1, 3.6),
    'thesis, merged': (11.1, 11.0, 11.0, 10.3, 8.0, 4.9),
}
"""Table B.1: regions correct, of 14.8, on the real Perceptron test set; UBHam was tuned on it."""

CORRECT_ABW = {
    'UE': 13.4,
    'UFPR': 13.0,
    'PEAC': 12.8,
    'UB': 12.8,
    'USF': 12.7,
    'Holz et al.': 12.2,
    'Oehler et al.': 11.1,
    'OU': 9.8,
    'WSU': 9.7,
}
"""Regions correct at T = 0.8, of 15.2, on the 30 real ABW test images."""


def published_rows(sensor: str) -> list[dict[str, Any]]:
    """Published rows of the test set of a sensor: table B.1, or `CORRECT_ABW`."""
    if sensor == 'abw':
        return [
            {'series': name, 'source': 'real ABW test set, published', 'tolerance': 0.8}
            | {'regions': 15.2, 'correct': correct}
            for name, correct in CORRECT_ABW.items()
        ]
    if sensor != 'perc':
        return []
    return [
        {'series': name, 'source': 'real Perceptron test set, published', 'tolerance': tolerance}
        | {'regions': 14.8, 'correct': correct}
        for name, row in CORRECT_PERCEPTRON.items()
        for tolerance, correct in zip(TOLERANCES, row, strict=True)
    ]
