"""Recordings that are damaged, or hold frames that are none: what is lost, and what is said."""

import os
import struct
from unittest import mock

import cv2
import numpy as np
import pytest
from recordings import DEPTH, SUFFIXES, Recording, depth_images, record, stamp_of

from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.io.bag_writer import DepthBagWriter
from rangeseg_ros.io.bags import DamagedBagError, DepthBag
from rangeseg_ros.io.recordings import BagError


@pytest.mark.parametrize('share', [0.3, 0.5, 0.9])
def test_a_recording_without_its_end_gives_the_frames_before(tmp_path, share):
    images = depth_images(40, 240, 320)
    path = tmp_path / 'bag'
    file = record(path, 'mcap', images)
    os.truncate(file, int(file.stat().st_size * share))
    frames = []
    with DepthBag(path) as bag:
        count = len(bag)
        said = f'damaged after {count} frames: without its end: '
        with pytest.raises(DamagedBagError, match=said):
            frames.extend(bag)
    assert len(frames) == count
    # What was cut through is lost: an image, or the chunk of at most 1 MB that it is in.
    assert 40 * share - 9 <= count <= 40 * share
    np.testing.assert_array_equal([frame.depth for frame in frames], images[:count])


@pytest.mark.parametrize('storage', tuple(SUFFIXES))
def test_damage_in_the_middle_never_escapes_as_another_error(tmp_path, storage):
    file = record(tmp_path / f'bag{SUFFIXES[storage]}', storage, depth_images(20))
    whole = file.read_bytes()
    noise = np.random.default_rng(1)
    for _ in range(60):
        start, length = int(noise.integers(len(whole))), int(noise.integers(1, 2000))
        garbage = noise.integers(0, 256, length, np.uint8).tobytes()
        file.write_bytes((whole[:start] + garbage + whole[start + length :])[: len(whole)])
        try:
            with DepthBag(file) as bag:
                frames = list(bag)
        except BagError as error:
            assert str(file) in str(error)
        else:
            assert len(frames) <= 20


def numbers_of(path, **options):
    """Numbers of the frames that can be read, by their stamps, and the bag."""
    numbers = []
    with DepthBag(path, **options) as bag:
        for frame in bag:
            try:
                frame.range_image()
            except ValueError as error:
                bag.lose(str(error))
            else:
                numbers.append((frame.stamp - stamp_of(0)) // (stamp_of(1) - stamp_of(0)))
    return numbers, bag


CAMERA, IMAGE = -2, -1
"""Messages of the last frame of a recording."""
SHORT = IMAGE, 'data', np.zeros(100, np.uint8)


def with_bad_frame(path, bad, number=3, count=6):
    """Record frames, one of them spoilt: (message, field, value)."""
    message, *change = bad
    recording = Recording(ros1=path.suffix == '.bag')
    for index, image in enumerate(depth_images(count)):
        recording.add_camera(stamp_of(index))
        recording.add_image(stamp_of(index), image)
        if index == number:
            setattr(recording.messages[message][-1], *change)
    recording.write(path)


@pytest.mark.parametrize('number', [0, 3, 5])
@pytest.mark.parametrize(
    'bad', [(IMAGE, 'encoding', 'rgb8'), SHORT, (IMAGE, 'height', 20), (CAMERA, 'width', 0)]
)
@pytest.mark.parametrize('name', ['bag', 'ros1.bag'])
def test_one_bad_frame_costs_one_frame(tmp_path, bad, number, name):
    with_bad_frame(tmp_path / name, bad, number)
    numbers, bag = numbers_of(tmp_path / name, depth_topic=DEPTH)
    assert numbers == [index for index in range(6) if index != number]
    assert bag.lost.total() == 1 and '1 of 6' in bag.loss() and 'other reasons' not in bag.loss()


def test_a_message_that_is_no_message_costs_one_frame(tmp_path):
    file = record(tmp_path / 'bag', 'mcap', depth_images(6))
    data = bytearray(file.read_bytes())
    # The string of an encoding begins with its length.
    places = [i for i in range(len(data)) if data.startswith(b'16UC1', i)]
    data[places[2] - 4 : places[2]] = b'\xff' * 4
    file.write_bytes(data)
    numbers, bag = numbers_of(tmp_path / 'bag')
    assert numbers == [0, 1, 3, 4, 5] and 'damaged message' in bag.loss()


def test_a_replay_leaves_out_a_bad_frame_and_says_so(tmp_path, run):
    with_bad_frame(tmp_path / 'bag', SHORT, number=2, count=4)
    code, output, error = run('replay', tmp_path / 'bag', '--output', tmp_path / 'out')
    assert code == 1 and '3 frames' in output
    assert error.count('\n') == 2 and '1 of 4 frames left out' in error
    assert '3 frames: Neighbouring pixels have nothing in common' in error
    names = sorted(path.name for path in (tmp_path / 'out').glob('*_labels.png'))
    assert [int(name[:6]) for name in names] == [0, 1, 3]
    assert 'left out' in (tmp_path / 'out/report.html').read_text()
    code, output, error = run('replay', tmp_path / 'bag', '--output', tmp_path / 'out')
    assert code == 1 and 'done before' in output and 'left out' in error


def records(data):
    """Places and kinds of the records of an mcap file."""
    place = 8
    while place < len(data) - 8:
        yield place, data[place]
        place += 9 + struct.unpack_from('<Q', data, place + 1)[0]


def test_an_index_is_not_needed_and_a_damaged_chunk_costs_the_chunk(tmp_path, run):
    camera = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)
    with DepthBagWriter(tmp_path / 'bag', camera) as bag:  # with checksums
        for index, image in enumerate(depth_images(8, 480, 640)):
            bag.write(image, stamp_of(index))
    (file,) = tmp_path.glob('bag/*.mcap')
    assert numbers_of(tmp_path / 'bag')[0] == list(range(8))
    data = bytearray(file.read_bytes())
    end = next(place for place, kind in records(data) if kind in (2, 15))  # of the data, or all
    file.write_bytes(data[:end] + struct.pack('<BQQQI', 2, 20, 0, 0, 0) + data[-8:])
    numbers, bag = numbers_of(file)
    assert numbers == list(range(8)) and not bag.loss()
    # The begin of the compressed content of the third chunk.
    content = [place for place, kind in records(data) if kind == 6][2] + 49
    data[content : content + 1000] = bytes(1000)
    file.write_bytes(data)
    numbers, bag = numbers_of(tmp_path / 'bag')
    assert 6 <= len(numbers) < 8 and numbers[-1] == 7
    assert bag.lost.total() == 8 - len(numbers) and 'damaged chunk' in bag.loss()
    code, _, error = run('replay', tmp_path / 'bag', '--output', tmp_path / 'out', '--copy')
    assert code == 1 and 'not copied' in error
    assert numbers_of(tmp_path / 'out/bag')[0] == numbers


def test_a_stamp_that_ros_2_cannot_tell_costs_the_frame(tmp_path):
    recording = Recording()
    for nanosec in (0, 10**9, 2**32 - 1):
        recording.add_camera(stamp_of(0))
        recording.add_image(stamp_of(0), depth_images(1)[0])
        stamp = recording.messages[-1][-1].header.stamp
        stamp.sec, stamp.nanosec = 2**31 - 1, nanosec
    recording.write(tmp_path / 'bag')
    numbers, bag = numbers_of(tmp_path / 'bag')
    assert len(numbers) == 1
    beyond = f'stamp of {2**31} s is beyond the range of ROS 2'
    assert bag.loss().endswith(f'2 of 3 frames left out: {beyond}, and 1 other reasons')


def test_sizes_are_checked_before_pngs_are_decoded(tmp_path):
    recording = Recording()
    recording.add_camera(1)
    recording.add_compressed(1, depth_images(1)[0])
    recording.add_compressed(2, np.zeros((3000, 3000), np.uint16))
    recording.write(tmp_path / 'bag')
    with mock.patch.object(cv2, 'imdecode', wraps=cv2.imdecode) as decode:
        _, bag = numbers_of(tmp_path / 'bag')
    assert 'depth image is 3000x3000, its camera_info 64x48' in bag.loss()
    assert len({len(call.args[0]) for call in decode.call_args_list}) == 1
