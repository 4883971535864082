"""Show how reliable `Plane.probability` is: the share of planes among regions that are said to be.

python docs/reliability.py [--output PICTURE] FOLDER...    folders that rangeseg evaluate reads

A region is a plane where one annotated plane covers 80 % of its judged pixels, and none where as
many are judged not planar; others, and those of fewer than 300 pixels of VGA, do not count. `left
out`: after the logistic regression of `core/by_planes/posterior.py` on frames of other cameras.
"""

import argparse
from pathlib import Path

import matplotlib as mpl
import numpy as np
from scipy.optimize import minimize

from rangeseg_ros import Config, Segmenter
from rangeseg_ros.core.regions import least_pixels
from rangeseg_ros.evaluation.datasets import Case, find_cases

SHARE, BINS, CERTAIN, DRAWS = 0.8, 10, 1e-4, 200


def regions_of(case: Case) -> list[tuple[str, float, bool]]:
    """Camera and probability of regions of an image, and whether they are planes."""
    sample = case.load()
    result = Segmenter(Config(plane_probability=0.0)).segment(sample.image)
    truth, least = sample.truth, least_pixels(0, result.labels.shape)
    judged = truth.labels > 0 if truth.judged is None else truth.judged
    camera, found = repr(sample.image.camera or case.image), []
    for plane in result.planes:
        region = result.labels == plane.label
        count = np.bincount(truth.labels[region & judged], minlength=2)
        if count.sum() < max(least, region.sum() / 2):
            continue
        shares = count / count.sum()
        if max(shares[0], shares[1:].max()) >= SHARE:
            found.append((camera, plane.probability, bool(shares[0] < SHARE)))
    return found


def fitted(probability: np.ndarray, planes: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Probabilities `at` some after the logistic regression of planes on the log-odds."""

    def log_odds(values: np.ndarray) -> np.ndarray:
        values = values.clip(CERTAIN, 1 - CERTAIN)
        return np.log(values / (1 - values))

    def loss(line: np.ndarray) -> float:
        odds = line[0] + line[1] * log_odds(probability)
        return float((np.logaddexp(0, odds) - planes * odds).sum())

    line = minimize(loss, (0.0, 1.0)).x
    return np.asarray(1 / (1 + np.exp(-line[0] - line[1] * log_odds(at))))


def table(probability: np.ndarray, planes: np.ndarray) -> list[tuple[float, float, int]]:
    """Mean probability, share of planes and number of regions in each tenth."""
    tenth = np.minimum(probability * BINS, BINS - 1).astype(int)
    groups = [tenth == k for k in range(BINS) if (tenth == k).any()]
    return [(probability[g].mean(), planes[g].mean(), int(g.sum())) for g in groups]


def error(rows: list[tuple[float, float, int]]) -> float:
    """Expected calibration error."""
    return sum(n * abs(said - true) for said, true, n in rows) / sum(n for *_, n in rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('folders', nargs='+', type=Path, metavar='FOLDER')
    parser.add_argument('--output', type=Path, metavar='PICTURE')
    arguments = parser.parse_args()
    cases = [case for folder in arguments.folders for case in find_cases(folder, 1)]
    rows = [row for case in cases for row in regions_of(case)]
    camera, probability, planes = (np.array(column) for column in zip(*rows, strict=True))
    left_out = np.empty(len(rows))
    for name in np.unique(camera):
        own = camera == name
        left_out[own] = fitted(probability[~own], planes[~own], probability[own])
    print('said  planes  regions')
    for said, true, count in table(probability, planes):
        print(f'{said:.2f}  {true:6.2f}  {count:7d}')
    for name, values in (('as published', probability), ('left out', left_out)):
        print(f'expected calibration error, {name}: {error(table(values, planes)):.3f}')
    draw = np.random.default_rng(0)
    drawn = [error(table(left_out, draw.random(len(rows)) < left_out)) for _ in range(DRAWS)]
    print(f'of as many whose probabilities are right: {np.mean(drawn):.3f}')
    if arguments.output:
        mpl.use('Agg')
        from matplotlib import pyplot

        figure, axes = pyplot.subplots(figsize=(4, 4), layout='constrained')
        axes.plot((0, 1), (0, 1), color='grey', linewidth=1)
        for name, values in (('as published', probability), ('left out', left_out)):
            axes.plot(
                *zip(*[row[:2] for row in table(values, planes)], strict=True), 'o-', label=name
            )
        axes.set(xlabel='probability', ylabel='share of planes')
        axes.legend()
        figure.savefig(arguments.output, dpi=80)


if __name__ == '__main__':
    main()
