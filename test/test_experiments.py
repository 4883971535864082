"""The experiments on a tiny set: tables, plots, choice of lambda."""

import csv
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from corner_set import CAMERA, depth_and_truth, segcomp_set

from rangeseg_ros.cli.main import main
from rangeseg_ros.core.config import Config
from rangeseg_ros.evaluation import experiments, plots, published
from rangeseg_ros.evaluation.measure import Measurement
from rangeseg_ros.evaluation.overlap import Overlap
from rangeseg_ros.io.cameras import write_camera
from rangeseg_ros.io.params import read_config, read_params


@pytest.fixture
def folder(tmp_path):
    """Two depth images of a corner."""
    depth, truth = depth_and_truth()
    for name, shift in (('a', 0), ('b', 100)):
        for kind, image in (('depth', depth + np.uint16(shift) * (depth > 0)), ('truth', truth)):
            (tmp_path / 'set' / kind).mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(
                str(tmp_path / 'set' / kind / f'{name}.png'), image.astype(np.uint16)
            )
    write_camera(tmp_path / 'set' / 'camera.yaml', CAMERA)
    return tmp_path / 'set'


def run(monkeypatch, *args):
    monkeypatch.setattr(sys, 'argv', ['rangeseg', 'experiment', *map(str, args), '--jobs', '1'])
    with pytest.raises(SystemExit) as end:
        main()
    return end.value.code or 0


def rows(path):
    with path.open(newline='') as file:
        return list(csv.DictReader(file))


def picture(path):
    image = cv2.imread(str(path))
    assert image is not None and len(np.unique(image.reshape(-1, 3), axis=0)) > 10
    return image


def test_lambda_is_trained(folder, tmp_path, monkeypatch):
    output, params = tmp_path / 'out', tmp_path / 'params.yaml'
    args = ('lambda', folder, '--output', output, '--step', '65', '--train', params)
    assert run(monkeypatch, *args) == 0
    table = rows(output / 'lambda.csv')
    assert [(r['series'], r['lambda']) for r in table] == [
        (series, value)
        for series in ('none', 'merged', 'identified')
        for value in ('20', '85', '150')
    ]
    assert all(r['regions'] == '2' for r in table)
    picture(output / 'lambda.png')
    config = read_config(params)
    assert config.method == 'normals' and config.normal_baseline == 1
    assert config.smoothness in (20.0, 85.0, 150.0)


def test_trained_parameters_leave_open_what_the_given_ones_do(folder, tmp_path, monkeypatch):
    given, params = tmp_path / 'given.yaml', tmp_path / 'params.yaml'
    given.write_text('normal_baseline: 2\n')
    args = ('lambda', folder, '--output', tmp_path / 'out', '--step', '130', '--params', given)
    assert run(monkeypatch, *args, '--train', params) == 0
    assert set(read_params(params)) <= {'normal_baseline', 'smoothness'}
    assert read_params(params)['normal_baseline'] == 2


@pytest.mark.parametrize(
    ('name', 'more', 'series'),
    [
        ('directions', ('--limit', '25'), {'17 platonic', '25 regular'}),
        ('postprocessing', ('--step', '130'), set(experiments.POSTPROCESSING)),
        ('weights', ('--step', '130'), set(experiments.WEIGHTS)),
        ('comparison', ('--step', '130', '--real'), set(experiments.compared(''))),
    ],
)
def test_tables_by_tolerance(folder, tmp_path, monkeypatch, name, more, series):
    args = (name, folder, '--output', tmp_path, '--images', '1', *more)
    assert run(monkeypatch, *args) == 0
    table = rows(tmp_path / f'{name}.csv')
    assert {r['series'] for r in table} == series
    assert [r['tolerance'] for r in table[:6]] == ['0.51', '0.6', '0.7', '0.8', '0.9', '0.95']
    assert len(table) == 6 * len(series)
    if name == 'comparison':
        assert {r['source'] for r in table} == {'real set set'}
        assert {r['lambda'] for r in table if r['series'] == 'planes'} == {''}
    picture(tmp_path / f'{name}.png')


def test_published_rows_are_named_and_drawn(tmp_path):
    ours = {'series': 'planes', 'source': 'simulated set x', 'tolerance': 0.8}
    table = [ours | {'regions': 14.0, 'correct': 12.0}, *published.published_rows('perc')]
    assert {r['source'] for r in table[1:]} == {'real Perceptron test set, published'}
    assert len(table) == 1 + 6 * len(published.CORRECT_PERCEPTRON)
    plots.plot_correct(tmp_path / 'x.png', table, 'x', 'tolerance')
    picture(tmp_path / 'x.png')


def test_sets_without_the_split_are_refused(tmp_path, monkeypatch, capsys):
    abw = segcomp_set(tmp_path / 'abw')
    assert run(monkeypatch, 'lambda', abw, '--output', tmp_path / 'out') == 2
    assert 'no train images' in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()


def measurement(found):
    """One region of ten pixels, of which `found` were found."""
    truth = np.ones((1, 10), np.uint16)
    labels = truth.copy()
    labels[0, found:] = 0
    return Measurement('x', Overlap.between(truth, labels), [], {}, {}, 0.0, {})


def test_lambda_with_most_correct_regions_wins_the_lowest_of_equals():
    good, bad = [measurement(9)], [measurement(5)]
    assert experiments.best_lambda({100.0: good, 50.0: good, 20.0: bad}) == 50.0
    assert experiments.best_lambda({100.0: good, 50.0: bad}) == 100.0


def test_averages_are_over_images():
    row = experiments.averages([measurement(9), measurement(5)], 0.8)
    assert (row['regions'], row['correct'], row['missed']) == (1.0, 0.5, 0.5)


def test_published_rows_are_those_of_the_thesis():
    assert published.CORRECT_PERCEPTRON['thesis, identified'] == (11.6, 11.5, 11.2, 10.3, 7.1, 3.6)
    settings = Config(
        method='normals', normal_baseline=1, jump_edges='sobel', smoothness=55.0, min_pixels=2
    )
    assert settings == published.THESIS


@pytest.mark.parametrize('sensor', published.AS_PUBLISHED)
def test_parameter_files_hold_the_published_settings(sensor):
    path = Path(__file__).parents[1] / 'params' / f'thesis_{sensor}.yaml'
    assert read_config(path) == published.AS_PUBLISHED[sensor]
    # Whatever the defaults become.
    given = set(read_params(path))
    assert {'method', 'smoothness', 'jump_edges', 'normal_baseline', 'min_pixels'} <= given


def test_each_image_is_left_out_of_its_own_training():
    """Two images disagree on the best lambda: each gets that of the other."""
    results = {20.0: [measurement(9), measurement(5)], 50.0: [measurement(5), measurement(9)]}
    chosen = experiments.left_out(results)
    assert chosen == [results[50.0][0], results[20.0][1]]
