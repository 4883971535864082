"""One place for parameters: defaults, types, ranges."""

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rangeseg_ros import Config
from rangeseg_ros.cli import evaluate, mount, replay
from rangeseg_ros.core.options import ConfigError

FIELDS = {f.name: f for f in fields(Config)}
VALUES = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5))


def test_every_default_lies_in_its_range_and_every_parameter_is_described():
    Config()
    for f in FIELDS.values():
        assert len(f.metadata['description']) > 5
        free = f.type in ('bool', 'str')  # or the name of a frame or a file
        assert f.metadata['choices'] or f.metadata['low'] is not None or free


@pytest.mark.parametrize('command', [evaluate.command, mount.command, replay.command])
def test_options_of_commands_are_as_their_parameters(command):
    named = [option for option in command.params if option.name in FIELDS]
    assert named
    for option in named:
        f = FIELDS[option.name]
        assert option.is_flag == (type(f.default) is bool)
        assert tuple(getattr(option.type, 'choices', ())) == f.metadata['choices']


def test_integers_and_numbers_of_numpy_are_taken():
    mapping = {'smoothness': 10, 'noise': np.float32(0.5), 'min_pixels': np.int64(7)}
    config = Config.from_mapping({**mapping, 'exact': np.bool_(True)})
    assert config == Config(smoothness=10.0, noise=0.5, min_pixels=7, exact=True)
    names = 'smoothness', 'noise', 'min_pixels', 'exact'
    assert [type(getattr(config, name)) for name in names] == [float, float, int, bool]


@pytest.mark.parametrize(
    ('values', 'words'),
    [
        ({'smothness': 1.0}, ['smothness', 'smoothness']),
        ({'smoothness': -1.0}, ['smoothness', '0', '10000']),
        ({'smoothness': float('nan')}, ['smoothness']),
        ({'smoothness': 'high'}, ['smoothness', 'float']),
        ({'min_pixels': 2.5}, ['min_pixels', 'int']),
        ({'min_pixels': np.float64(7.0)}, ['min_pixels', 'type int']),
        ({'min_pixels': True}, ['min_pixels', 'int']),
        ({'exact': 1}, ['exact', 'bool']),
        ({'method': 'magic'}, ['method', 'planes', 'normals']),
        ({'direction_count': 300}, ['direction_count', '305']),
        ({'work_budget': 0.95, 'method': 'normals'}, ['work_budget']),
    ],
)
def test_refusals_name_the_parameter_and_what_it_takes(values, words):
    with pytest.raises(ConfigError) as refusal:
        Config.from_mapping(values)
    message = str(refusal.value)
    assert '\n' not in message and [word for word in words if word not in message] == []


@given(st.dictionaries(st.sampled_from(sorted(FIELDS)), VALUES, max_size=3))
def test_any_mapping_gives_a_valid_config_or_a_config_error(mapping):
    try:
        config = Config.from_mapping(mapping)
    except ConfigError:
        return
    for name, f in FIELDS.items():
        value, low = getattr(config, name), f.metadata['low']
        assert type(value) is type(f.default)
        most = 1 if 'share' in f.metadata['description'] else np.inf
        assert low is None or low <= value <= f.metadata['high'] <= most


def test_former_names_are_taken_with_a_warning():
    with pytest.warns(FutureWarning, match='warm_start is not read any more'):
        assert Config.from_mapping({'warm_start': True}) == Config()
    with pytest.warns(FutureWarning, match='up_noise is called up_sd now: up_sd: 2.0'):
        assert Config.from_mapping({'up_noise': 2.0}).up_sd == 2.0
    with pytest.warns(FutureWarning), pytest.raises(ConfigError, match='up_sd'):
        Config.from_mapping({'up_noise': 'long'})
    with pytest.warns(FutureWarning):
        assert Config.from_mapping({'up_noise': 2.0, 'up_sd': 1.0}).up_sd == 1.0
