"""Repeat the experiments of chapter 6 of the thesis on a set of images with ground truth.

python docs/experiments.py EXPERIMENT DIR --output FOLDER [--params FILE] [--images N] [--jobs N]

directions      sets of directions (figure 6.2)
lambda          lambda, T = 0.8 (figure 6.3)
weights         neighbourhood weights of section 5.5 (figure 5.5)
comparison      ours on the test images, beside published results (figure 6.5, table B.1)

DIR is a folder that `rangeseg evaluate` knows. Lambda is trained on training images only; where a
set has none, every image is left out of its own training. Writes a table (CSV) and a plot (PNG).
"""

import argparse
import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rangeseg_ros import Config
from rangeseg_ros.cli.options import progress
from rangeseg_ros.evaluation.datasets import find_cases
from rangeseg_ros.evaluation.figures import COUNTS, TOLERANCES
from rangeseg_ros.evaluation.hoover import classify
from rangeseg_ros.evaluation.measure import Task
from rangeseg_ros.io.params import read_config
from rangeseg_ros.tasks import run_all

PARAMS = Path(__file__).parents[1] / 'params'
EXPERIMENTS = ('directions', 'lambda', 'weights', 'comparison')
DIRECTIONS = {f'{count} directions': {'direction_count': count} for count in (17, 73, 305, 1249)}
WEIGHTS = {'4-connectivity': {'jump_edges': 'none'}, 'jump edge disconnection': {}}
LAMBDAS = tuple(float(value) for value in range(20, 151, 10))
# Without post-processing the best lambda lies far higher (thesis 6.5).
HIGH_LAMBDAS = (55.0, 100.0, 150.0, 200.0)

# Table B.1: regions correct, of 14.8, on the real Perceptron test set; UBHam was tuned on it.
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
# At T = 0.8, of 15.2, on the 30 real ABW test images.
CORRECT_ABW = {'UE': 13.4, 'UFPR': 13.0, 'PEAC': 12.8, 'UB': 12.8, 'USF': 12.7}
CORRECT_ABW |= {'Holz et al.': 12.2, 'Oehler et al.': 11.1, 'OU': 9.8, 'WSU': 9.7}


def main():
    """Run one experiment and write what it gives."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('experiment', choices=EXPERIMENTS)
    parser.add_argument('folder', type=Path)
    parser.add_argument('--output', type=Path, required=True)
    parser.add_argument('--params', type=Path, default=PARAMS / 'thesis_perceptron.yaml')
    parser.add_argument('--images', type=int, help='only so many of each split')
    parser.add_argument('--jobs', type=int)
    given = parser.parse_args()
    cases = find_cases(given.folder)
    training, test = (
        [case for case in cases if case.split in (name, '')][: given.images]
        for name in ('train', 'test')
    )
    base = read_config(given.params, method='normals')

    def run(configs, images):
        """Measurements of every image with every config, by the config's key."""
        tasks = [Task(case, config) for config in configs.values() for case in images]
        done = iter(progress(run_all(tasks, given.jobs), len(tasks), 'image'))
        return {key: [next(done) for _ in images] for key in configs}

    rows = rows_of(given.experiment, base, training, test, run)
    given.output.mkdir(parents=True, exist_ok=True)
    path = given.output / f'{given.experiment}.csv'
    with path.open('w', newline='') as file:
        table = csv.DictWriter(file, dict.fromkeys(key for row in rows for key in row))
        table.writeheader()
        table.writerows(rows)
    against = 'lambda' if given.experiment == 'lambda' else 'tolerance'
    plot(path.with_suffix('.png'), rows, f'{given.experiment}: {given.folder.name}', against)


def rows_of(name, base, training, test, run):
    """Table of an experiment, one row for each series and tolerance or lambda."""
    if name == 'comparison':
        return comparison(base, training, test, run) + published(test[0].sensor)
    if name == 'directions':
        sets = variations(base, DIRECTIONS)
        return by_tolerance(train(run, sets, HIGH_LAMBDAS, training or test))
    changes = WEIGHTS if name == 'weights' else {'as published': {}}
    found = train(run, variations(base, changes), LAMBDAS, training or test)
    return by_lambda(found) if name == 'lambda' else by_tolerance(found)


def variations(base, changes):
    """`base` with each of the changes."""
    return {name: replace(base, **change) for name, change in changes.items()}


def train(run, configs, lambdas, cases):
    """Measurements of each config with each lambda."""
    every = {
        (name, value): replace(config, smoothness=value)
        for name, config in configs.items()
        for value in lambdas
    }
    found = run(every, cases)
    return {name: {value: found[name, value] for value in lambdas} for name in configs}


def averages(measurements, tolerance):
    """Means over the images of Hoover's counts."""
    counts = [classify(item.overlap, tolerance).counts() for item in measurements]
    return {key: float(np.mean([count[key] for count in counts])) for key in COUNTS}


def best_lambda(results):
    """The lambda with most correct regions at T = 0.8; the lowest of equals."""
    return max(sorted(results), key=lambda value: averages(results[value], 0.8)['correct'])


def left_out(results):
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


def by_lambda(results):
    """The counts at T = 0.8 for each series and lambda."""
    return [
        {'series': name, 'lambda': value} | averages(measurements, 0.8)
        for name, found in results.items()
        for value, measurements in found.items()
    ]


def by_tolerance(results):
    """The counts of each series at its best lambda, for each tolerance."""
    best = {name: best_lambda(found) for name, found in results.items()}
    return [
        {'series': name, 'lambda': best[name], 'tolerance': tolerance}
        | averages(found[best[name]], tolerance)
        for name, found in results.items()
        for tolerance in TOLERANCES
    ]


def comparison(base, training, test, run):
    """Method `normals` with lambda trained, and method `planes`, on the test images."""
    normals = {'normals as published': base, 'normals, defaults': Config(method='normals')}
    tested = run({'planes, defaults': Config()}, test)
    results = train(run, normals, LAMBDAS, training or test)
    best = {name: best_lambda(found) for name, found in results.items()}
    if training:
        tested |= run({n: replace(c, smoothness=best[n]) for n, c in normals.items()}, test)
    else:
        tested |= {name: left_out(found) for name, found in results.items()}
    return [
        {'series': name, 'lambda': best.get(name, ''), 'tolerance': tolerance}
        | averages(measurements, tolerance)
        for name, measurements in tested.items()
        for tolerance in TOLERANCES
    ]


def published(sensor):
    """Published rows of the test set of a sensor."""
    rows = {'abw': [(name, 0.8, 15.2, correct) for name, correct in CORRECT_ABW.items()]}
    rows['perc'] = [
        (name, tolerance, 14.8, correct)
        for name, row in CORRECT_PERCEPTRON.items()
        for tolerance, correct in zip(TOLERANCES, row, strict=True)
    ]
    return [
        {
            'series': f'{name}, published',
            'tolerance': tolerance,
            'regions': count,
            'correct': found,
        }
        for name, tolerance, count, found in rows.get(sensor, [])
    ]


def plot(path, rows, title, against):
    """Correct regions against a column, a line for each series; published ones dotted."""
    figure = Figure(figsize=(9.5, 5.5), layout='constrained')
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=10)
    axes = figure.subplots()
    for name in dict.fromkeys(row['series'] for row in rows):
        part = [row for row in rows if row['series'] == name]
        style = ':x' if name.endswith('published') else '-o'
        axes.plot([row[against] for row in part], [r['correct'] for r in part], style, label=name)
    axes.axhline(rows[0]['regions'], color='grey', linestyle='--', label='regions in the set')
    axes.set(xlabel=against, ylabel='correct regions per image')
    axes.grid(alpha=0.3)
    figure.legend(fontsize=8, loc='outside right upper')
    figure.savefig(path, dpi=110)


if __name__ == '__main__':
    main()
