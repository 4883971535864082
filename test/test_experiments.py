"""The experiments of the documents on a tiny set: tables, plots, choice of lambda."""

import csv
import importlib
import sys
from pathlib import Path

import numpy as np
import pytest
from corner_set import segcomp_set

from rangeseg_ros.core.config import Config
from rangeseg_ros.evaluation.measure import Measurement
from rangeseg_ros.evaluation.overlap import Overlap
from rangeseg_ros.io.params import read_config, read_params

ROOT = Path(__file__).parents[1]


@pytest.fixture
def experiments(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / 'docs'))
    return importlib.import_module('experiments')


@pytest.mark.parametrize(('name', 'count'), [('lambda', 3 * 3), ('comparison', 4 * 6 + 9)])
def test_tables_and_plots(experiments, tmp_path, monkeypatch, name, count):
    monkeypatch.setattr(experiments, 'LAMBDAS', (20.0, 85.0, 150.0))
    folder = segcomp_set(tmp_path / 'abw')
    words = [name, folder, '--output', tmp_path / 'out', '--jobs', 1]
    monkeypatch.setattr(sys, 'argv', ['experiments.py', *map(str, words)])
    experiments.main()
    with (tmp_path / f'out/{name}.csv').open(newline='') as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == count
    assert (tmp_path / f'out/{name}.png').stat().st_size > 10_000


def measurement(found):
    """One region of ten pixels, of which `found` were found."""
    truth = np.ones((1, 10), np.uint16)
    labels = truth.copy()
    labels[0, found:] = 0
    return Measurement('x', Overlap.between(truth, labels), [], {}, {}, {})


def test_lambda_with_most_correct_regions_wins_the_lowest_of_equals(experiments):
    good, bad = [measurement(9)], [measurement(5)]
    assert experiments.best_lambda({100.0: good, 50.0: good, 20.0: bad}) == 50.0
    assert experiments.best_lambda({100.0: good, 50.0: bad}) == 100.0
    row = experiments.averages([*good, *bad], 0.8)
    assert (row['regions'], row['correct'], row['missed']) == (1.0, 0.5, 0.5)


def test_each_image_is_left_out_of_its_own_training(experiments):
    """Two images disagree on the best lambda: each gets that of the other."""
    results = {20.0: [measurement(9), measurement(5)], 50.0: [measurement(5), measurement(9)]}
    assert experiments.left_out(results) == [results[50.0][0], results[20.0][1]]


@pytest.mark.parametrize(
    ('sensor', 'changes'),
    [
        ('perceptron', {}),
        ('abw', {'dithering': 0.001}),
        ('kinect', {'smoothness': 100.0, 'noise_regions': 'leave'}),
    ],
)
def test_parameter_files_hold_the_published_settings(sensor, changes):
    path = ROOT / 'params' / f'thesis_{sensor}.yaml'
    thesis = {'method': 'normals', 'normal_baseline': 1, 'jump_edges': 'sobel', 'min_pixels': 2}
    assert read_config(path) == Config(**{**thesis, 'smoothness': 55.0, **changes})
    # Whatever the defaults become.
    assert {*thesis, 'smoothness'} <= set(read_params(path))
