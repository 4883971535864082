"""The command `rangeseg simulate`: what it writes, and that it writes it whole."""

import csv

import cv2
import numpy as np
import pytest

from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.io.bags import DepthBag
from rangeseg_ros.io.cameras import read_camera
from rangeseg_ros.io.images import read_depth, read_labels
from rangeseg_ros.simulation.kinect import simulate_kinect
from rangeseg_ros.simulation.scenes import curved_scene
from rangeseg_ros.simulation.sensors.kinect import kinect_camera
from rangeseg_ros.simulation.sensors.stereo import RealSense
from rangeseg_ros.simulation.terrain.frame import simulate_terrain
from rangeseg_ros.simulation.terrain.kinds import terrain_scene

SMALL = ['--width', '160', '--height', '120']


def test_kinect_folder_holds_the_scenes(tmp_path, run):
    output = tmp_path / 'rooms'
    words = '--scenes', 2, '--frames', 2, '--seed', 7, '--scene', 'curved', '--sensor-seed', 3
    code, _, error = run('simulate', 'kinect', *words, *SMALL, '--output', output)
    assert code == 0, error
    assert [path.name for path in tmp_path.iterdir()] == ['rooms']
    names = ['000007_000000', '000007_000001', '000008_000000', '000008_000001']
    for kind in ('depth', 'truth'):
        assert sorted(path.stem for path in (output / kind).iterdir()) == names

    camera = read_camera(output / 'camera.yaml')
    expected = simulate_kinect(curved_scene(8, 2), camera, frame=1, seed=8, sensor_seed=3)
    assert camera == kinect_camera(160, 120)
    assert np.array_equal(read_depth(output / 'depth' / f'{names[3]}.png'), expected.depth)
    truth = read_labels(output / 'truth' / f'{names[3]}.png')
    assert np.array_equal(truth, expected.labels)

    with (output / 'planes.csv').open() as file:
        rows = [row for row in csv.DictReader(file) if row['image'] == names[3]]
    assert len(rows) == len(expected.planes)
    for row, plane in zip(rows, expected.planes, strict=True):
        assert [int(row['label']), int(row['face'])] == [plane.label, plane.face]
        assert int(row['count']) == (truth == plane.label).sum()
        normal = [float(row[f'normal_{axis}']) for axis in 'xyz']
        assert normal == pytest.approx(plane.normal, abs=1e-8)
        assert float(row['distance']) == pytest.approx(plane.distance, abs=1e-7)

    with DepthBag(output / 'bag') as bag:
        frames = list(bag)
    assert len(frames) == 4
    assert np.array_equal(frames[3].depth, expected.depth)
    assert frames[3].stamp - frames[0].stamp == 100_000_000


def test_noise_free_png_is_rounded_and_bag_exact(tmp_path, run):
    output = tmp_path / 'rooms'
    code, _, error = run(
        'simulate', 'kinect', '--scenes', 1, '--noise', 'none', *SMALL, '--output', output
    )
    assert code == 0, error
    depth = cv2.imread(str(output / 'depth' / '000000.png'), cv2.IMREAD_UNCHANGED)
    assert depth.dtype == np.uint16
    with DepthBag(output / 'bag') as bag:
        (frame,) = bag
    assert frame.depth.dtype == np.float32
    assert np.abs(1000 * frame.depth - depth).max() <= 0.501


def test_nothing_is_overwritten_or_left_half_written(tmp_path, monkeypatch, refused):
    (tmp_path / 'rooms').mkdir()
    (tmp_path / 'rooms/precious').touch()
    assert 'exists already' in refused('simulate', 'kinect', '--output', tmp_path / 'rooms')

    def fail(*_arguments, **_options):
        raise OSError('disk full')

    monkeypatch.setattr('rangeseg_ros.cli.simulate.write_image', fail)
    words = 'simulate', 'kinect', '--scenes', 1, *SMALL, '--output', tmp_path / 'other'
    assert 'disk full' in refused(*words)
    assert [path.name for path in tmp_path.iterdir()] == ['rooms']


@pytest.mark.parametrize(
    ('option', 'value'),
    [('--noise', 'loud'), ('--scenes', 0), ('--seed', -1), ('--width', 1), ('--scene', 'desert')],
)
def test_bad_option(tmp_path, option, value, refused):
    error = refused('simulate', 'kinect', option, value, '--output', tmp_path / 'rooms')
    assert option in error and str(value) in error
    assert not any(tmp_path.iterdir())


def test_terrain_is_seen_by_an_image_of_any_size(tmp_path, run):
    output = tmp_path / 'terrain'
    words = '--sensor', 'realsense', '--scenes', 1, '--seed', 5, '--kind', 'curb'
    code, _, error = run('simulate', 'terrain', *words, *SMALL, '--output', output)
    assert code == 0, error
    camera = read_camera(output / 'camera.yaml')
    # 90 degrees wide, as the sensor's own images.
    assert camera == Camera(160, 120, 80.0, 80.0, 79.5, 59.5)
    expected = simulate_terrain(terrain_scene('curb', 5), RealSense(5), camera, seed=5)
    assert np.array_equal(read_depth(output / 'depth' / '000005.png'), expected.depth)
    truth = cv2.imread(str(output / 'truth' / '000005.png'), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(truth, expected.terrain)
