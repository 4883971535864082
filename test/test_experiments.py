"""The experiments of the documents on a tiny set: tables, plots, choice of lambda."""

import csv
import importlib
import sys
from pathlib import Path

import pytest
from corner_set import segcomp_set

from rangeseg_ros.core.config import Config
from rangeseg_ros.io.params import read_config, read_params

ROOT = Path(__file__).parents[1]


@pytest.fixture
def experiments(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / 'docs'))
    return importlib.import_module('experiments')


@pytest.mark.parametrize(('name', 'count'), [('lambda', 2 * 3), ('comparison', 3 * 6 + 9)])
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
