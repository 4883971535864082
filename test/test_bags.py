"""Recordings in, depth frames out: every format, topics, cameras, clouds."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from message_classes import cloud
from recordings import DEPTH, INFO, SUFFIXES, Recording, depth_images, record, stamp_of

from rangeseg_ros.core.sensing.camera import Camera, CameraWarning
from rangeseg_ros.io.bag_writer import DepthBagWriter
from rangeseg_ros.io.bags import DepthBag
from rangeseg_ros.io.cameras import read_camera, write_camera
from rangeseg_ros.io.images import read_labels
from rangeseg_ros.io.recordings import BagError
from rangeseg_ros.messages.cameras import raw_by_name
from rangeseg_ros.messages.make import CLOUD

CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)


@pytest.mark.parametrize('compressed', [False, True])
@pytest.mark.parametrize('storage', SUFFIXES)
def test_every_format_gives_the_frames(tmp_path, storage, compressed):
    images = depth_images(5)
    path = tmp_path / f'bag{SUFFIXES[storage]}'
    file = record(path, storage, images, compressed)
    for source in {path, file}:
        with DepthBag(source) as bag:
            assert len(bag) == 5 and bag.camera_topic == INFO
            frames = list(bag)
        assert [frame.stamp for frame in frames] == [*map(stamp_of, range(5))]
        assert {frame.frame_id for frame in frames} == {'optical'}
        assert {frame.camera for frame in frames} == {CAMERA}
        np.testing.assert_array_equal([frame.depth for frame in frames], images)


def test_parts_of_a_recording_are_read_in_order(tmp_path):
    images = depth_images(12)
    (tmp_path / 'bag').mkdir()
    for index, image in enumerate(images):
        part = record(tmp_path / f'part{index}', 'mcap', image[None])
        part.rename(tmp_path / f'bag/bag_{index}.mcap')
    with DepthBag(tmp_path / 'bag') as bag:
        np.testing.assert_array_equal([frame.depth for frame in bag], images)


def test_depth_is_found_by_name_or_else_by_encoding(tmp_path):
    recording = Recording()
    recording.add_image(1, np.zeros((48, 192), np.uint8), 'rgb8', '/camera/color/image_raw')
    recording.add_image(1, depth_images(1)[0], 'mono16', '/camera/infra/image_raw')
    for name in ('color', 'infra', 'depth'):
        recording.add_camera(1, topic=f'/camera/{name}/camera_info')
    recording.add_compressed(2, depth_images(1)[0])
    recording.add_image(2, depth_images(1)[0])
    recording.write(tmp_path / 'bag')
    with DepthBag(tmp_path / 'bag') as bag:
        assert (bag.depth_topic, bag.camera_topic) == (DEPTH, INFO)
    with DepthBag(tmp_path / 'bag', f'{DEPTH}/compressedDepth') as bag:
        assert bag.camera_topic == INFO
    recording = Recording()
    recording.add_image(1, np.zeros((48, 192), np.uint8), 'rgb8', '/a/image')
    recording.add_image(1, np.ones((48, 64), np.float32), '32FC1', '/b/image')
    recording.add_camera(1, topic='/camera_info')
    recording.write(tmp_path / 'unnamed')
    with DepthBag(tmp_path / 'unnamed') as bag:
        assert (bag.depth_topic, bag.camera_topic) == ('/b/image', '/camera_info')


def test_images_are_raw_or_rectified_by_name():
    assert raw_by_name('/camera/depth/image_raw') is True
    assert raw_by_name('/depth/Image_RAW/compressedDepth') is True
    assert raw_by_name('/raw/image_rect_raw') is False
    assert raw_by_name('/depth/image_rect/compressed') is False
    assert raw_by_name('/rect/depth_raw/image') is None


@pytest.mark.parametrize('name', ['bag', 'ros1.bag'])
def test_raw_images_have_their_lens(tmp_path, name):
    d = np.array([-0.2, 0.05, 0, 0, 0])
    lens = replace(CAMERA, distortion_model='plumb_bob', d=tuple(d))
    recording = Recording(ros1=name.endswith('.bag'))
    recording.add_camera(1, d=d)
    for topic in (DEPTH, '/camera/depth/image_raw'):
        recording.add_image(2, depth_images(1)[0], topic=topic)
    recording.write(tmp_path / name)
    with pytest.warns(CameraWarning, match='D beside P'), DepthBag(tmp_path / name, DEPTH) as bag:
        assert [frame.camera for frame in bag] == [CAMERA]
    for topic, raw in (('/camera/depth/image_raw', False), (DEPTH, True)):
        with DepthBag(tmp_path / name, topic, raw=raw) as bag:
            assert [frame.camera for frame in bag] == [lens]


def test_camera_changes_on_the_way(tmp_path):
    recording = Recording()
    images = depth_images(3)
    recording.add_image(1, images[0])  # before any camera_info: the first one counts
    recording.add_camera(2, focal=50.0)
    recording.add_image(3, images[1])
    recording.add_camera(4, focal=60.0)
    recording.add_image(5, images[2])
    recording.write(tmp_path / 'bag')
    with DepthBag(tmp_path / 'bag') as bag:
        assert [frame.camera.fx for frame in bag] == [50.0, 50.0, 60.0]


def test_errors_list_the_topics_and_encodings_or_say_that_it_is_no_bag(tmp_path):
    recording = Recording()
    recording.add_camera(1, topic='/left/camera_info')
    recording.add_camera(1, topic='/right/camera_info')
    recording.write(tmp_path / 'cameras')
    recording.add_image(1, depth_images(1)[0])
    recording.write(tmp_path / 'both')
    for name, rows, kind, encoding in (('colour', 48, 'u1', '8UC1'), ('small', 20, 'u2', '16UC1')):
        recording = Recording()
        recording.add_camera(1)
        recording.add_image(1, np.zeros((rows, 64), kind), encoding)
        recording.write(tmp_path / name)
    for name, topics, message in (
        ('cameras', (), r'no depth image; topics: /left/camera_info \[sensor_msgs'),
        ('both', (), r'no camera_info for .*/right/camera_info'),
        ('both', ('/nowhere',), r'no depth image on /nowhere; topics: /camera'),
        ('both', (None, '/nowhere'), r'no camera_info on /nowhere; topics: /camera'),
        ('colour', (), r'no depth image \(/camera/depth/image_rect: 8UC1\)'),
        ('small', (), 'depth image is 64x20, its camera 64x48'),
    ):
        with pytest.raises(BagError, match=message):
            DepthBag(tmp_path / name, *topics)
    with pytest.raises(BagError, match='No such file'):
        DepthBag(tmp_path / 'missing')
    for name in ('text.bag', 'text.mcap', 'text.db3', 'text.txt'):
        for content in ('no bag\n' * 30, ''):
            (tmp_path / name).write_text(content)
            with pytest.raises(BagError, match=f'{name}: not a readable bag'):
                DepthBag(tmp_path / name)
    (tmp_path / 'empty').mkdir()
    with pytest.raises(BagError, match=r'not a readable bag: the folder has no metadata\.yaml'):
        DepthBag(tmp_path / 'empty')


@pytest.mark.parametrize('lens', [{}, {'distortion_model': 'equidistant', 'skew': 2.0}])
@pytest.mark.parametrize('dtype', [np.uint16, np.float32])
def test_what_is_packed_comes_back_with_its_lens(tmp_path, dtype, lens):
    camera = Camera(64, 48, 51.0, 52.0, 30.0, 20.0, **lens)
    images = depth_images(4).astype(dtype)
    if dtype == np.float32:
        images[0, 0, :3] = np.nan, np.inf, -1
    with DepthBagWriter(tmp_path / 'bag', camera, 'eye') as bag:
        for index, image in enumerate(images):
            bag.write(image, 5 + index * 10**9)
    with DepthBag(tmp_path / 'bag') as bag:
        assert bag.depth_topic == ('/depth/image_raw' if lens else '/depth/image_rect')
        frames = list(bag)
    assert [frame.stamp for frame in frames] == [5 + index * 10**9 for index in range(4)]
    assert {(frame.frame_id, frame.camera) for frame in frames} == {('eye', camera)}
    np.testing.assert_array_equal([frame.depth for frame in frames], images)
    assert frames[0].depth.dtype == dtype
    write_camera(tmp_path / 'camera.yaml', camera)
    assert read_camera(tmp_path / 'camera.yaml') == camera
    told = yaml.safe_load((tmp_path / 'camera.yaml').read_text())
    assert told['rectification_matrix']['data'] == np.eye(3).ravel().tolist()


def test_writer_leaves_nothing_half_written(tmp_path):
    (image,) = depth_images(1)
    writer = DepthBagWriter(tmp_path / 'bag', CAMERA)
    with pytest.raises(BagError, match='uint16 or float32'), writer as bag:
        bag.write(image, 1)
        bag.write(image[:10], 2)
    assert list(tmp_path.iterdir()) == []
    with DepthBagWriter(tmp_path / 'bag', CAMERA) as bag:
        bag.write(image, 1)
        for stamp in (2**31 * 10**9, -(2**31) * 10**9 - 1):  # which ROS 2 cannot tell
            with pytest.raises(BagError, match='stamp'):
                bag.write(image, stamp)
    with pytest.raises(BagError, match='exists already'), DepthBagWriter(tmp_path / 'bag', CAMERA):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ['bag']


def test_clouds_without_images_are_of_one_topic_or_of_the_one_that_is_named(tmp_path, run):
    recording = Recording()
    for metres, topic in ((1, '/a'), (2, '/b')):
        message = cloud((metres * CAMERA.rays).astype('<f4'))
        recording.messages.append((metres, topic, CLOUD, message))
        recording.write(tmp_path / f'clouds{metres}')
    recording.add_camera(3)
    recording.add_image(3, depth_images(1)[0])
    recording.write(tmp_path / 'images')
    with DepthBag(tmp_path / 'clouds1') as bag:
        assert next(iter(bag)).range_image().points[0, 0] == pytest.approx(CAMERA.rays[0, 0])
    with pytest.raises(BagError, match='several topics of point clouds: /a, /b'):
        DepthBag(tmp_path / 'clouds2')
    for name in ('clouds2', 'images'):
        with DepthBag(tmp_path / name, '/b') as bag:
            assert next(iter(bag)).range_image().points[0, 0, 2] == pytest.approx(2)
    with DepthBag(tmp_path / 'images') as bag:
        assert next(iter(bag)).camera is not None
    code, output, error = run('replay', tmp_path / 'clouds1', '--output', tmp_path / 'out')
    assert (code, error) == (0, '') and '1 frames' in output
    (labels,) = (tmp_path / 'out').glob('*_labels.png')
    assert (read_labels(labels) == 1).all()


def test_images_without_camera_info_take_a_file(tmp_path, run):
    recording = Recording()
    for topic in ('/other', '/third'):  # before the image
        recording.add_camera(10**18, focal=60.0, topic=topic)
    recording.add_image(10**18, depth_images(1)[0])
    recording.write(tmp_path / 'bag')
    file = tmp_path / 'camera.yaml'
    write_camera(file, CAMERA)
    replay = 'replay', tmp_path / 'bag', '--output', tmp_path / 'out'
    code, _, error = run(*replay)
    assert code == 2 and 'replay takes --camera' in error
    # The file counts, also where there is another camera_info.
    with DepthBag(tmp_path / 'bag', None, '/other', camera=read_camera(file)) as bag:
        assert [frame.camera.fx for frame in bag] == [50.0]
    assert 'image_rect\n' in run(*replay, '--camera', file)[1]
    assert (tmp_path / 'out/planes.csv').exists()
