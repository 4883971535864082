"""How far constants may move: changed copies of the package, and what is made of the figures."""

import subprocess
import sys

import pytest
from click.testing import CliRunner

from rangeseg_ros.cli.experiment import command
from rangeseg_ros.evaluation import sensitivity
from rangeseg_ros.evaluation.sensitivity import Constant, Trial, find_constants, ranges

CONSTANTS = {str(constant): constant for constant in find_constants()}


def value_in(folder, constant):
    """Value that the copy of the package in `folder` has."""
    module = f'rangeseg_ros.core.{constant.module.replace("/", ".")}'
    code = f'import {module} as module; print(module.{constant.name}, module.__file__)'
    done = subprocess.run(
        [sys.executable, '-c', code],
        cwd=folder,
        env={'PYTHONPATH': f'{folder}:{":".join(sys.path)}'},
        capture_output=True,
        text=True,
    )
    value, file = done.stdout.split()
    assert file.startswith(str(folder)), done.stderr
    return float(value)


@pytest.mark.parametrize(
    'name', ['tracking/tracker.PERSISTENCE', 'tracking/tracker._UNSEEN_OVERLAP']
)
def test_one_constant_of_a_copy_is_changed(name, tmp_path):
    constant = CONSTANTS[name]
    sensitivity.write_changed([constant], 0.5, tmp_path)
    assert value_in(tmp_path, constant) == constant.value / 2
    sources = [path.relative_to(sensitivity.PACKAGE) for path in sensitivity.PACKAGE.rglob('*.py')]
    changed = [
        path
        for path in sources
        if (tmp_path / 'rangeseg_ros' / path).read_bytes()
        != (sensitivity.PACKAGE / path).read_bytes()
    ]
    assert [path.as_posix() for path in changed] == ['core/tracking/tracker.py']


@pytest.mark.parametrize(
    ('names', 'changed'),
    [('Y', 'X, Y = 3, 4.5\nZ = 2\n'), ('XYZ', 'X, Y = 6, 4.5\nZ = 4\n')],
)
def test_only_the_expressions_asked_for_are_changed(names, changed, tmp_path, monkeypatch):
    package = tmp_path / 'package'
    (package / 'core').mkdir(parents=True)
    (package / 'core' / 'a.py').write_text('X, Y = 3, 1.5**2\nZ = 2\n')
    monkeypatch.setattr(sensitivity, 'PACKAGE', package)
    values = {'X': 3, 'Y': 2.25, 'Z': 2}
    constants = [Constant('a', name, values[name], '') for name in names]
    sensitivity.write_changed(constants, 2, tmp_path / 'copy')
    assert (tmp_path / 'copy/package/core/a.py').read_text() == changed


def test_ranges_end_at_the_first_factor_that_costs_too_much(tmp_path):
    a, b = Constant('m', 'A', 1.0, '1.0'), Constant('m', 'B', 2, '2')
    ious = {
        a: {1: 0.9, 0.5: 0.898, 0.25: 0.95, 2: 0.5, 4: 0.9},
        b: {1: 0.9, 0.5: None, 2: 0.9, 0.25: 0.9, 4: 0.9},
    }
    trials = [
        Trial((constant,), factor, (tmp_path,), (), tmp_path)
        for constant, by_factor in ious.items()
        for factor in by_factor
    ]
    results = [
        iou and {'rooms': 0.9, 'frames': iou}
        for by_factor in ious.values()
        for iou in by_factor.values()
    ]
    rows = ranges(trials, results)
    assert [(row['constant'], row['low'], row['high']) for row in rows] == [
        ('m.B', 1, 4),
        ('m.A', 0.25, 1),
    ]
    assert [row['loss'] for row in rows] == pytest.approx([1.0, 0.4])
    assert [row['set'] for row in rows] == ['', 'frames']


def test_command_resumes(tmp_path, monkeypatch):
    measured = []

    def measure(trial):
        measured.append((trial.constants, trial.factor))
        if len(measured) == 4:
            raise OSError('the disk is full')
        return {'set': 0.9 if trial.factor < 2 else 0.8}

    monkeypatch.setattr(Trial, '_measure', measure)
    (tmp_path / 'set').mkdir()
    table = tmp_path / 'method.md'
    table.write_text(
        '| module | name | value | kind | reason |\n'
        '| `tracking/tracker` | `PERSISTENCE` | 0.5 | d | tried |\n'
        '| `calibration/sightings` | `_RIM` | 2 | d | tried |\n'
        '| `fitting/cells` | `MAX_CELLS` | 100 | c | memory |\n'
    )
    arguments = ['sensitivity', tmp_path / 'set', '--output', tmp_path / 'out', '--table', table]
    arguments += ['--factor', 0.5, '--factor', 2, '--jobs', 1]
    assert CliRunner().invoke(command, [*map(str, arguments)]).exception
    done = CliRunner().invoke(command, [*map(str, arguments)])
    assert done.exit_code == 0, done.output
    assert 'tracking/tracker.PERSISTENCE: 0.5 to 1 times 0.5' in done.output
    rows = (tmp_path / 'out/sensitivity.csv').read_text().splitlines()
    assert len(rows) == 3 and rows[0].startswith('constant,value,low,high,loss')
    # Unchanged once for both, every factor once for each, and the one that failed again.
    assert len(measured) == 1 + 4 + 1 and measured[3] == measured[4]
    done = CliRunner().invoke(command, [*map(str, arguments), '--together'])
    assert (
        'calibration/sightings._RIM, tracking/tracker.PERSISTENCE: 0.5 to 1 times 2, 0.5'
        in done.output
    )
    assert len(measured) == 6 + 2 and all(len(constants) == 2 for constants, _ in measured[6:])
    unknown = CliRunner().invoke(command, [*map(str, arguments[:4]), '--constant', 'a._B'])
    assert unknown.exit_code == 1 and 'no constant a._B' in unknown.output


@pytest.mark.parametrize(
    ('program', 'found'),
    [
        (
            'import json\n'
            'from rangeseg_ros.core.tracking.tracker import PERSISTENCE\n'
            "print(json.dumps({'gate': PERSISTENCE}))",
            {'gate': CONSTANTS['tracking/tracker.PERSISTENCE'].value / 2},
        ),
        ('print("no figures")', None),
        ('raise SystemExit(1)', None),
    ],
)
def test_script_measures_the_changed_package(program, found, tmp_path):
    script = tmp_path / 'figures.py'
    script.write_text(program)
    trial = Trial(
        (CONSTANTS['tracking/tracker.PERSISTENCE'],), 0.5, (), (), tmp_path / 'cache', script
    )
    assert trial.run() == found
    # Another program is another trial.
    script.write_text('print("{}")')
    assert trial.run() == {}


def test_command_needs_something_to_measure(tmp_path):
    done = CliRunner().invoke(command, ['sensitivity', '--output', str(tmp_path)])
    assert done.exit_code == 2 and '--script' in done.output
