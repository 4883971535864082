"""Recordings in, depth frames out: every format, topics, cameras, clouds."""

import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml
from message_classes import cloud
from recordings import SUFFIXES, Recording, depth_images, record

from rangeseg_ros.core.sensing.camera import Camera, CameraWarning
from rangeseg_ros.io.bag_writer import DepthBagWriter
from rangeseg_ros.io.bags import DepthBag
from rangeseg_ros.io.cameras import read_camera, write_camera
from rangeseg_ros.io.recordings import BagError
from rangeseg_ros.messages.make import CLOUD

STORAGES = tuple(SUFFIXES)


def read(path, **topics):
    with DepthBag(path, **topics) as bag:
        return list(bag)


@pytest.mark.parametrize('compressed', [False, True])
@pytest.mark.parametrize('storage', STORAGES)
def test_every_format_gives_the_frames(tmp_path, storage, compressed):
    images = depth_images(5)
    path = tmp_path / f'bag{SUFFIXES[storage]}'
    file = record(path, storage, images, compressed)
    for source in {path, file}:
        with DepthBag(source) as bag:
            assert len(bag) == 5
            assert bag.camera_topic == '/camera/depth/camera_info'
            frames = list(bag)
        assert [frame.stamp for frame in frames] == [10**18 + i * 33_333_333 for i in range(5)]
        assert {frame.frame_id for frame in frames} == {'optical'}
        assert {frame.camera for frame in frames} == {Camera(64, 48, 50.0, 50.0, 31.5, 23.5)}
        np.testing.assert_array_equal([frame.depth for frame in frames], images)


def test_parts_of_a_recording_are_read_in_order(tmp_path):
    images = depth_images(12)
    (tmp_path / 'bag').mkdir()
    for index, image in enumerate(images):
        part = record(tmp_path / 'part', 'mcap', image[None])
        part.rename(tmp_path / 'bag' / f'bag_{index}.mcap')
        shutil.rmtree(tmp_path / 'part')
    np.testing.assert_array_equal([f.depth for f in read(tmp_path / 'bag')], images)


def test_depth_is_found_by_name_among_other_images(tmp_path):
    recording = Recording()
    recording.add_image(1, np.zeros((48, 192), np.uint8), 'rgb8', '/camera/color/image_raw')
    recording.add_image(1, depth_images(1)[0], 'mono16', '/camera/infra/image_raw')
    recording.add_camera(1, topic='/camera/color/camera_info')
    recording.add_camera(1, topic='/camera/infra/camera_info')
    recording.add_camera(1, topic='/camera/depth/camera_info')
    recording.add_compressed(2, depth_images(1)[0])
    recording.add_image(2, depth_images(1)[0])
    recording.write(tmp_path / 'bag')
    with DepthBag(tmp_path / 'bag') as bag:
        assert bag.depth_topic == '/camera/depth/image_rect'
        assert bag.camera_topic == '/camera/depth/camera_info'
    with DepthBag(tmp_path / 'bag', '/camera/depth/image_rect/compressedDepth') as bag:
        assert bag.camera_topic == '/camera/depth/camera_info'


def test_depth_is_found_by_encoding_where_no_name_tells(tmp_path):
    recording = Recording()
    recording.add_image(1, np.zeros((48, 192), np.uint8), 'rgb8', '/a/image')
    recording.add_image(1, np.ones((48, 64), np.float32), '32FC1', '/b/image')
    recording.add_camera(1, topic='/camera_info')
    recording.write(tmp_path / 'bag')
    with DepthBag(tmp_path / 'bag') as bag:
        assert (bag.depth_topic, bag.camera_topic) == ('/b/image', '/camera_info')


D = np.array([-0.2, 0.05, 0, 0, 0])


def one_image(path, name, raw=False, **camera):
    """Camera of a bag of one image, whose topic has this name."""
    recording = Recording(ros1=path.suffix == '.bag')
    recording.add_camera(1, **camera)
    recording.add_image(2, depth_images(1)[0], topic=f'/camera/depth/{name}')
    recording.write(path)
    with DepthBag(path, raw=raw) as bag:
        (frame,) = bag
    return frame.camera


@pytest.mark.parametrize('path', ['bag', 'ros1.bag'])
def test_images_are_raw_or_rectified_by_name(tmp_path, path):
    pinhole = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
    lens = replace(pinhole, distortion_model='plumb_bob', d=tuple(D))
    path = tmp_path / path
    with pytest.warns(CameraWarning, match='D beside P'):
        assert one_image(path.with_stem('a'), 'image_rect_raw', d=D) == pinhole
    with pytest.warns(CameraWarning, match='D beside P'):
        assert one_image(path.with_stem('b'), 'image', d=D) == pinhole
    assert one_image(path.with_stem('c'), 'image_raw', d=D) == lens
    assert one_image(path.with_stem('d'), 'image_rect', raw=True, d=D) == lens
    assert one_image(path.with_stem('e'), 'image', d=D, p=np.zeros(12)) == lens
    assert one_image(path.with_stem('f'), 'image_raw') == pinhole
    with pytest.raises(BagError, match='unknown distortion model'):
        one_image(path.with_stem('g'), 'image_raw', model='fov', d=D)


@pytest.mark.parametrize('lens', [{}, {'distortion_model': 'equidistant', 'skew': 2.0}])
def test_what_is_packed_comes_back_with_its_lens(tmp_path, lens):
    camera = Camera(64, 48, 50.0, 50.0, 31.5, 23.5, **lens)
    with DepthBagWriter(tmp_path / 'bag', camera) as bag:
        bag.write(depth_images(1)[0], 10**9)
    with DepthBag(tmp_path / 'bag') as bag:
        assert bag.depth_topic == ('/depth/image_raw' if lens else '/depth/image_rect')
        assert [frame.camera for frame in bag] == [camera]
    write_camera(tmp_path / 'camera.yaml', camera)
    assert read_camera(tmp_path / 'camera.yaml') == camera
    told = yaml.safe_load((tmp_path / 'camera.yaml').read_text())
    assert told['rectification_matrix']['data'] == np.eye(3).ravel().tolist()


def test_camera_changes_on_the_way(tmp_path):
    recording = Recording()
    images = depth_images(3)
    recording.add_image(1, images[0])  # before any camera_info: the first one counts
    recording.add_camera(2, focal=50.0)
    recording.add_image(3, images[1])
    recording.add_camera(4, focal=60.0)
    recording.add_image(5, images[2])
    recording.write(tmp_path / 'bag')
    assert [frame.camera.fx for frame in read(tmp_path / 'bag')] == [50.0, 50.0, 60.0]


def test_errors_list_the_topics_and_encodings(tmp_path):
    recording = Recording()
    recording.add_camera(1, topic='/left/camera_info')
    recording.add_camera(1, topic='/right/camera_info')
    recording.write(tmp_path / 'cameras')
    with pytest.raises(BagError, match=r'no depth image; topics: /left/camera_info \[sensor_msgs'):
        DepthBag(tmp_path / 'cameras')
    recording.add_image(1, depth_images(1)[0])
    recording.write(tmp_path / 'both')
    with pytest.raises(BagError, match=r'no camera_info for .*/right/camera_info'):
        DepthBag(tmp_path / 'both')
    with pytest.raises(BagError, match=r'no depth image on /nowhere; topics: /camera'):
        DepthBag(tmp_path / 'both', '/nowhere')
    with pytest.raises(BagError, match=r'no camera_info on /nowhere; topics: /camera'):
        DepthBag(tmp_path / 'both', None, '/nowhere')
    colour = Recording()
    colour.add_camera(1)
    colour.add_image(1, np.zeros((48, 64), np.uint8), '8UC1')
    colour.write(tmp_path / 'colour')
    with pytest.raises(BagError, match=r'no depth image \(/camera/depth/image_rect: 8UC1\)'):
        DepthBag(tmp_path / 'colour')


def test_what_is_no_bag(tmp_path):
    with pytest.raises(BagError, match='No such file'):
        DepthBag(tmp_path / 'missing')
    for name in ('text.bag', 'text.mcap', 'text.db3', 'text.txt'):
        (tmp_path / name).write_text('no bag\n' * 30)
        with pytest.raises(BagError, match=f'{name}: not a readable bag'):
            DepthBag(tmp_path / name)
        (tmp_path / name).write_text('')
        with pytest.raises(BagError, match=f'{name}: not a readable bag'):
            DepthBag(tmp_path / name)
    (tmp_path / 'empty').mkdir()
    with pytest.raises(BagError, match=r'not a readable bag: the folder has no metadata\.yaml'):
        DepthBag(tmp_path / 'empty')


@pytest.mark.parametrize('dtype', [np.uint16, np.float32])
def test_writer_and_reader_agree(tmp_path, dtype):
    camera = Camera(64, 48, 51.0, 52.0, 30.0, 20.0)
    images = depth_images(4).astype(dtype)
    if dtype == np.float32:
        images[0, 0, :3] = np.nan, np.inf, -1
    with DepthBagWriter(tmp_path / 'bag', camera, 'eye') as bag:
        for index, image in enumerate(images):
            bag.write(image, 5 + index * 10**9)
    frames = read(tmp_path / 'bag')
    assert [frame.stamp for frame in frames] == [5 + index * 10**9 for index in range(4)]
    assert {(frame.frame_id, frame.camera) for frame in frames} == {('eye', camera)}
    np.testing.assert_array_equal([frame.depth for frame in frames], images)
    assert frames[0].depth.dtype == dtype


def test_writer_leaves_nothing_half_written(tmp_path):
    camera = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
    with (
        pytest.raises(BagError, match='uint16 or float32'),
        DepthBagWriter(tmp_path / 'bag', camera) as bag,
    ):
        bag.write(depth_images(1)[0], 1)
        bag.write(depth_images(1)[0][:10], 2)
    assert list(tmp_path.iterdir()) == []
    with DepthBagWriter(tmp_path / 'bag', camera) as bag:
        bag.write(depth_images(1)[0], 1)
    with pytest.raises(BagError, match='exists already'), DepthBagWriter(tmp_path / 'bag', camera):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ['bag']


def test_clouds_are_taken_where_there_are_no_images_and_one_topic_or_the_one_that_is_named(
    tmp_path,
):
    recording = Recording()
    for number, topics in enumerate(('/a', '/a /b', '/a /b image')):
        for n, topic in enumerate(topics.split()):
            if topic == 'image':
                recording.add_image(10 + n, depth_images(1)[0])
                recording.add_camera(10 + n)
            else:
                message = cloud(np.full((3, 4, 3), 1 + n, '<f4'))
                recording.messages.append((10 + n, topic, CLOUD, message))
        recording.write(tmp_path / f'{number}')
        recording.messages.clear()
    with DepthBag(tmp_path / '0') as bag:
        assert next(iter(bag)).range_image().points[0, 0] == pytest.approx([1, 1, 1])
    with pytest.raises(BagError, match='several topics of point clouds: /a, /b'):
        DepthBag(tmp_path / '1')
    for number in '12':
        with DepthBag(tmp_path / number, '/b') as bag:
            assert next(iter(bag)).range_image().points[0, 0] == pytest.approx([2, 2, 2])
    with DepthBag(tmp_path / '2') as bag:
        assert next(iter(bag)).camera is not None


def test_images_without_camera_info_take_a_file(tmp_path, run):
    recording = Recording()
    recording.add_image(10**18, depth_images(1)[0])
    for topic in ('/other', '/third'):
        recording.add_camera(10**18, focal=60.0, topic=topic)
    recording.messages.reverse()  # before the image
    recording.write(tmp_path / 'bag')
    file = tmp_path / 'camera.yaml'
    write_camera(file, Camera(64, 48, 50.0, 50.0, 31.5, 23.5))
    replay = 'replay', tmp_path / 'bag', '--output', tmp_path / 'out'
    code, _, error = run(*replay)
    assert code == 2 and 'replay takes --camera' in error
    # The file counts, also where there is another camera_info.
    with DepthBag(tmp_path / 'bag', None, '/other', camera=read_camera(file)) as bag:
        assert [frame.camera.fx for frame in bag] == [50.0]
    assert 'image_rect\n' in run(*replay, '--camera', file)[1]
    assert (tmp_path / 'out/planes.csv').exists()


def test_clouds_are_replayed(tmp_path, run):
    recording, camera = Recording(), Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
    message = cloud((2 * camera.rays).astype('<f4'))
    recording.messages.append((10**18, '/points', CLOUD, message))
    recording.write(tmp_path / 'bag')
    code, output, error = run('replay', tmp_path / 'bag', '--output', tmp_path / 'out')
    assert (code, error) == (0, '') and '1 frames' in output
    (labels,) = (tmp_path / 'out').glob('*_labels.png')
    assert (cv2.imread(str(labels), cv2.IMREAD_UNCHANGED) == 1).all()
