"""The command `rangeseg calibrate`: what it writes, refuses, and keeps when interrupted."""

import numpy as np
import pytest
import yaml
from calibration_frames import CAMERA, frames, rms, true_map
from message_classes import cloud
from rosbags.typesys import Stores

from rangeseg_ros import Config, RangeImage
from rangeseg_ros.core.calibration.sightings import find_sightings
from rangeseg_ros.io.bag_writer import BagWriter, DepthBagWriter
from rangeseg_ros.io.cameras import write_camera
from rangeseg_ros.io.distortion import read_distortion
from rangeseg_ros.io.images import write_image
from rangeseg_ros.io.message_types import CLOUD, message_types


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Depth images of a distorted sensor, with gaps in their numbers, and the same as a bag."""
    path = tmp_path_factory.mktemp('recording')
    (path / 'depth').mkdir()
    write_camera(path / 'camera.yaml', CAMERA)
    with DepthBagWriter(path / 'bag', CAMERA) as bag:
        for number, (_, image) in enumerate(frames(22, true_map(0.004), noise=0.0006)):
            depth = np.rint(1000 / image.inverse).astype(np.uint16)
            write_image(path / 'depth' / f'frame-{3 * number:06d}.depth.png', depth)
            bag.write(depth, 10**9 + number * 10**8)
    return path


def test_command_writes_map_parameters_and_report(folder, tmp_path, run):
    output, params = tmp_path / 'map.tiff', tmp_path / 'sensor.yaml'
    camera = ['--camera', folder / 'camera.yaml', '--jobs', 1]
    code, said, error = run(
        'calibrate', folder / 'depth', *camera, '--output', output, '--params', params
    )
    assert code == 0, error
    assert 'less' in said
    distortion = read_distortion(output)
    assert distortion.camera == CAMERA
    assert rms(distortion.offset - true_map(0.004)) < 0.4 * rms(true_map(0.004))
    values = yaml.safe_load(params.read_text())
    assert values['distortion_map'] == str(output)
    assert Config(**values).distortion_map == str(output)
    page = (tmp_path / 'map_report.html').read_text()
    assert 'before' in page and page.count('data:image/svg') >= 3
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        'map.tiff', 'map_report.html', 'sensor.yaml',
    ]  # fmt: skip

    # The same from a bag, in place of the one before.
    code, _, error = run('calibrate', folder / 'bag', '--output', output, '--jobs', 1)
    assert code == 0, error
    assert read_distortion(output).offset == pytest.approx(distortion.offset, abs=1e-6)


def test_bags_of_clouds_give_the_map_that_images_give(tmp_path, run):
    images = [image for _, image in frames(22, true_map(0.004), noise=0.0006)]
    store = message_types(Stores.ROS2_JAZZY)
    (tmp_path / 'depth').mkdir()
    write_camera(tmp_path / 'camera.yaml', CAMERA)
    with BagWriter(tmp_path / 'bag') as bag:
        topic = bag.add_connection('/points', CLOUD, typestore=store)
        for number, image in enumerate(images):
            points = np.asarray(image.points, '<f4')
            bag.write(topic, number, store.serialize_cdr(cloud(points), CLOUD))
            depth = np.ascontiguousarray(points[..., 2])
            write_image(tmp_path / 'depth' / f'{number:02d}.tiff', depth)
    code, _, error = run(
        'calibrate', tmp_path / 'bag', '--output', tmp_path / 'clouds.tiff', '--jobs', 1
    )
    assert code == 0, error
    camera = ['--camera', tmp_path / 'camera.yaml', '--jobs', 1]
    code, _, error = run(
        'calibrate', tmp_path / 'depth', *camera, '--output', tmp_path / 'images.tiff'
    )
    assert code == 0, error
    one, other = (read_distortion(tmp_path / f'{name}.tiff') for name in ('clouds', 'images'))
    # Points tell the camera that took them.
    np.testing.assert_allclose(one.camera.matrix, CAMERA.matrix, atol=2e-3)
    assert one.offset.shape == CAMERA.shape
    assert rms(one.offset - true_map(0.004)) < 0.4 * rms(true_map(0.004))
    assert rms(one.offset - other.offset) < 0.2 * rms(true_map(0.004))
    corrected = one.corrected(RangeImage.from_points(points))
    assert rms(1 / corrected.points[..., 2] - (1 / points[..., 2] - one.offset)) < 1e-5


def test_interrupted_run_goes_on_where_it_was(folder, tmp_path, monkeypatch, run):
    output = tmp_path / 'map.tiff'
    arguments = [folder / 'depth', '--camera', folder / 'camera.yaml', '--output', output]
    segmented = []
    real = find_sightings

    def counting(labels, image):
        segmented.append(1)
        if len(segmented) == 15:
            raise KeyboardInterrupt
        return real(labels, image)

    monkeypatch.setattr('rangeseg_ros.batch.calibration.find_sightings', counting)
    assert run('calibrate', *arguments, '--jobs', 1)[0] == 130
    assert not output.exists()
    code, _, error = run('calibrate', *arguments, '--jobs', 1)
    assert code == 0, error
    # Of the first part of ten frames nothing is done again.
    assert len(segmented) == 15 + 12
    assert not list(tmp_path.glob('.*'))


@pytest.mark.parametrize(
    ('kind', 'words'),
    [
        ('no camera', 'needs --camera'),
        ('empty', 'neither a bag nor a folder of depth images'),
        ('foreign output', 'exists already, and is no distortion map'),
        ('foreign params', 'exists already, not overwritten'),
        ('few', 'too few planes'),
    ],
)
def test_bad_input_ends_in_one_line_and_writes_nothing(folder, tmp_path, kind, words, run):
    output, params = tmp_path / 'map.tiff', tmp_path / 'sensor.yaml'
    recording, camera = folder / 'depth', ['--camera', folder / 'camera.yaml']
    if kind == 'no camera':
        camera = []
    elif kind in ('empty', 'few'):
        recording = tmp_path / 'other'
        recording.mkdir()
    if kind == 'few':
        write_image(recording / 'a.png', np.full(CAMERA.shape, 1000, np.uint16))
    elif kind == 'foreign output':
        output.write_text('precious')
    elif kind == 'foreign params':
        params.write_text('noise: 0.1\n')
    before = {path: path.read_text() for path in (output, params) if path.exists()}
    code, _, error = run(
        'calibrate', recording, *camera, '--output', output, '--params', params, '--jobs', 1
    )
    assert code == 2 and words in error and error.count('\n') == 1
    assert {path: path.read_text() for path in (output, params) if path.exists()} == before
