"""The launch file and the RViz configuration: they name what the node has."""

import os
import runpy
import sys
from operator import itemgetter
from pathlib import Path
from unittest.mock import MagicMock

import pytest
import yaml

from rangeseg_ros.messages.outputs import OUTPUTS

ROOT = Path(__file__).parents[1]
LAUNCH_FILE = ROOT / 'launch/segment_planes.launch.py'
RVIZ_FILE = ROOT / 'rviz/segment_planes.rviz'


def displays():
    config = yaml.safe_load(RVIZ_FILE.read_text())
    return [d for d in config['Visualization Manager']['Displays'] if 'Topic' in d]


def test_rviz_shows_topics_of_the_node_by_displays_of_their_types():
    assert len(displays()) >= 4
    for display in displays():
        namespace, _, name = display['Topic']['Value'].rpartition('/')
        assert namespace == '/segment_planes'
        # Those of images, of markers and of clouds have the names of the messages.
        assert display['Class'] == f'rviz_default_plugins/{OUTPUTS[name].kind.rpartition("/")[2]}'
        # As the node offers it: reliable, nothing kept for late listeners.
        assert display['Topic']['Reliability Policy'] == 'Reliable'
        assert display['Topic']['Durability Policy'] == 'Volatile'


@pytest.fixture
def launched(monkeypatch):
    """Settings of the nodes that the launch file starts; of launch, which has no wheel, mocks."""
    launch, launch_ros = MagicMock(), MagicMock()
    for name, module in (('launch', launch), ('launch_ros', launch_ros)):
        monkeypatch.setitem(sys.modules, name, module)
        for part in ('actions', 'substitutions'):
            monkeypatch.setitem(sys.modules, f'{name}.{part}', getattr(module, part))
    launch.substitutions.LaunchConfiguration = lambda name: MagicMock(perform=itemgetter(name))
    # Here no folder is installed, and no profile set.
    launch.substitutions.PathJoinSubstitution = lambda parts: str(ROOT.joinpath(*parts[1:]))
    launch.substitutions.EnvironmentVariable = lambda name, default_value: default_value
    runpy.run_path(os.fspath(LAUNCH_FILE))['generate_launch_description']()
    arguments = launch.actions.DeclareLaunchArgument.call_args_list
    declared = {argument.args[0]: argument.kwargs for argument in arguments}
    ((described,), _) = launch.LaunchDescription.call_args
    assert len(described) == len(declared) + 1  # the function that makes the nodes

    def launched_with(**given):
        assert set(given) <= set(declared)
        values = {name: argument['default_value'] for name, argument in declared.items()} | given
        for name, argument in declared.items():
            choices = argument['choices']
            assert argument['description'] and (choices is None or values[name] in choices)
        launch_ros.actions.Node.reset_mock()
        launch.actions.OpaqueFunction.call_args.kwargs['function'](values)
        return [call.kwargs for call in launch_ros.actions.Node.call_args_list]

    return launched_with


def test_rviz_is_remapped_to_the_node_wherever_it_is(launched):
    (node,) = launched()
    assert node['executable'] == 'segment_planes'
    node, rviz = launched(rviz='true', namespace='robot', name='planes')
    assert (node['namespace'], node['name']) == ('robot', 'planes')
    shown = {display['Topic']['Value'] for display in displays()}
    assert dict(rviz['remappings']) == {
        topic: topic.replace('/segment_planes', '/robot/planes') for topic in shown
    }


def test_a_switch_is_true_or_false(launched):
    (node,) = launched(use_imu='True', use_sim_time='false')
    assert node['parameters'][-1] == {'use_imu': True, 'use_sim_time': False}
    for switch in ('use_imu', 'use_sim_time', 'rviz'):
        with pytest.raises(AssertionError, match='ture'):
            launched(**{switch: 'ture'})


@pytest.mark.ros
def test_the_node_starts_with_what_the_launch_file_gives_it(launched, tmp_path, monkeypatch):
    pytest.importorskip('rclpy')
    from ros_bench import Bench

    extra = tmp_path / 'extra.yaml'
    extra.write_text('/**:\n  ros__parameters:\n    min_pixels: 77\n')
    topics = {'depth': 'camera/depth/image_rect', 'imu': 'camera/imu', 'use_imu': 'true'}
    names = {'namespace': 'robot', 'name': 'planes', 'extra_params_file': os.fspath(extra)}
    (node,) = launched(**topics, **names, log_level='debug')
    # As launch_ros puts it together.
    arguments = [*node['ros_arguments'], '-r', f'__node:={node["name"]}']
    for source, target in node['remappings']:
        arguments += ['-r', f'{source}:={target}']
    *files, given = node['parameters']
    files.append(tmp_path / 'given.yaml')
    files[-1].write_text(yaml.safe_dump({'/**': {'ros__parameters': given}}))
    for file in files:
        arguments += ['--params-file', os.fspath(file)]
    ((variable, profile),) = node['additional_env'].items()
    assert Path(profile).exists()
    monkeypatch.setenv(variable, profile)
    with Bench(*arguments, namespace=node['namespace'], name=node['name']) as bench:
        bench.until(lambda: 'will subscribe' in bench.log())
    log = bench.log()
    assert '/robot/camera/depth/image_rect and /robot/camera/depth/camera_info' in log
    assert '/robot/camera/imu' in log and 'unknown' not in log


def test_launch_itself_takes_the_file():
    pytest.importorskip('launch_ros')
    from launch import LaunchContext
    from launch.actions import DeclareLaunchArgument
    from launch.launch_description_sources import get_launch_description_from_python_launch_file

    entities = get_launch_description_from_python_launch_file(os.fspath(LAUNCH_FILE)).entities
    context = LaunchContext()
    for entity in entities:
        if isinstance(entity, DeclareLaunchArgument):
            entity.execute(context)
    context.launch_configurations.update(rviz='true', name='planes')
    nodes = entities[-1].execute(context)
    assert [node.node_executable for node in nodes] == ['segment_planes', 'rviz2']
