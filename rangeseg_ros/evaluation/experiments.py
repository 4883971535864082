"""The experiments of chapter 6 of the thesis, as tables.

Each experiment varies parameters over the images of one set and averages Hoover's counts. Lambda
is trained on training images only; where a set has none, every image is left out of its own
training.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from rangeseg_ros.core.config import Config
from rangeseg_ros.evaluation.datasets import Case
from rangeseg_ros.evaluation.figures import COUNTS, TOLERANCES
from rangeseg_ros.evaluation.hoover import classify
from rangeseg_ros.evaluation.measure import Measurement, Task
from rangeseg_ros.evaluation.published import AS_PUBLISHED, THESIS
from rangeseg_ros.tasks import run_all

K = TypeVar('K')
Row = dict[str, Any]
ByLambda = Mapping[float, Sequence[Measurement]]

DIRECTIONS: dict[str, dict[str, Any]] = {
    f'{count} {kind}': {'directions': kind, 'direction_count': count}
    for kind, counts in (('platonic', (17, 73, 305, 1249)), ('regular', (25, 225, 1225)))
    for count in counts
}
POSTPROCESSING = {
    'none': {'noise_regions': 'leave'},
    'merged': {'noise_regions': 'merge'},
    'identified': {'noise_regions': 'identify'},
}
WEIGHTS: dict[str, dict[str, Any]] = {
    '4-connectivity': {'jump_edges': 'none'},
    'jump edge disconnection': {},
    'distance weighting': {'jump_edges': 'none', 'weighting': 'distance'},
    'both': {'weighting': 'distance'},
}
# Without post-processing the best lambda lies far higher (thesis 6.5).
HIGH_LAMBDAS = (55.0, 100.0, 150.0, 200.0)


@dataclass(frozen=True)
class Bench:
    """Where and how experiments are run.

    Attributes
    ----------
    jobs : int or None
        Processes; None for one on each core.
    progress : callable
        Wraps an iterable, given also the number of its items, to show progress.
    """

    jobs: int | None
    progress: Callable[[Iterable[Measurement], int], Iterable[Measurement]]

    def run(
        self, configs: Mapping[K, Config], cases: Sequence[Case]
    ) -> dict[K, list[Measurement]]:
        """Measurements of every case with every config, by the config's key."""
        tasks = [Task(case, config) for config in configs.values() for case in cases]
        done = iter(self.progress(run_all(tasks, self.jobs), len(tasks)))
        return {key: [next(done) for _ in cases] for key in configs}

    def train(
        self, variants: Mapping[str, Config], lambdas: Sequence[float], cases: Sequence[Case]
    ) -> dict[str, dict[float, list[Measurement]]]:
        """Measurements of each variant with each lambda."""
        configs = {
            (name, value): replace(config, smoothness=value)
            for name, config in variants.items()
            for value in lambdas
        }
        found = self.run(configs, cases)
        return {name: {value: found[name, value] for value in lambdas} for name in variants}


def averages(measurements: Sequence[Measurement], tolerance: float) -> Row:
    """Means over the images of Hoover's counts."""
    counts = [classify(item.overlap, tolerance).counts() for item in measurements]
    return {key: float(np.mean([count[key] for count in counts])) for key in COUNTS}


def best_lambda(results: ByLambda) -> float:
    """The lambda with most correct regions at T = 0.8; the lowest of equals."""
    return max(sorted(results), key=lambda value: averages(results[value], 0.8)['correct'])


def left_out(results: ByLambda) -> list[Measurement]:
    """Each image's measurement with the lambda that is best on all other images."""
    count = len(next(iter(results.values())))
    chosen = []
    for image in range(count):
        others = {
            value: [item for k, item in enumerate(found) if k != image or count == 1]
            for value, found in results.items()
        }
        chosen.append(results[best_lambda(others)][image])
    return chosen


def vary(base: Config, variations: Mapping[str, Mapping[str, Any]]) -> dict[str, Config]:
    """`base` with each of the changes."""
    return {name: replace(base, **changes) for name, changes in variations.items()}


def direction_sets(base: Config, limit: int) -> dict[str, Config]:
    """`base` with each set of up to `limit` directions (table 6.1)."""
    return vary(base, {k: v for k, v in DIRECTIONS.items() if v['direction_count'] <= limit})


def by_lambda(results: Mapping[str, ByLambda]) -> list[Row]:
    """The counts at T = 0.8 for each series and lambda (figure 6.3)."""
    return [
        {'series': name, 'lambda': value} | averages(measurements, 0.8)
        for name, found in results.items()
        for value, measurements in found.items()
    ]


def by_tolerance(results: Mapping[str, ByLambda]) -> list[Row]:
    """The counts of each series at its best lambda, for each tolerance (figures 6.2, 6.4)."""
    best = {name: best_lambda(found) for name, found in results.items()}
    return [
        {'series': name, 'lambda': best[name], 'tolerance': tolerance}
        | averages(found[best[name]], tolerance)
        for name, found in results.items()
        for tolerance in TOLERANCES
    ]


def comparison(
    bench: Bench,
    training: Sequence[Case],
    test: Sequence[Case],
    variants: Mapping[str, Config],
    lambdas: Sequence[float],
) -> list[Row]:
    """Table B.1 and figure 6.5: variants with lambda trained, run on the test images.

    Without training images, lambda is chosen for every test image on all others. Method `planes`
    has no lambda and is not trained.
    """
    normals = {name: c for name, c in variants.items() if c.method == 'normals'}
    planes = {name: c for name, c in variants.items() if c.method != 'normals'}
    tested: dict[str, list[Measurement]] = bench.run(planes, test)
    results = bench.train(normals, lambdas, training or test)
    best = {name: best_lambda(found) for name, found in results.items()}
    if training:
        chosen = {name: replace(normals[name], smoothness=best[name]) for name in normals}
        tested |= bench.run(chosen, test)
    else:
        tested |= {name: left_out(found) for name, found in results.items()}
    return [
        {'series': name, 'lambda': best.get(name, ''), 'tolerance': tolerance}
        | averages(tested[name], tolerance)
        for name in variants
        for tolerance in TOLERANCES
    ]


def compared(sensor: str, params: Config | None = None) -> dict[str, Config]:
    """Variants to compare.

    The thesis's method as published, both methods with the defaults and, where given, with the
    parameters of a file.
    """
    ours = Config(method='normals')
    rows = {
        'normals as published, identified': THESIS,
        'normals as published, merged': replace(THESIS, noise_regions='merge'),
        'normals, our defaults': ours,
        'planes': replace(ours, method='planes'),
    }
    if params is not None:
        rows['normals, parameters given'] = replace(params, method='normals')
        rows['planes, parameters given'] = replace(params, method='planes')
    if sensor == 'abw':
        rows['normals as published, dithered'] = AS_PUBLISHED['abw']
        rows['normals, our defaults, dithered'] = replace(ours, dithering=0.001)
    return rows
