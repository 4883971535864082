"""Damage costs what is damaged: a frame, a chunk, the end; and small files cost little."""

import bz2
import os
import struct
import zlib

import cv2
import lz4.frame
import numpy as np
import pytest
import zstandard
from recordings import SUFFIXES, Recording, depth_images, record

from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.io.bag_formats import Lost, Record, unpack
from rangeseg_ros.io.bag_writer import DepthBagWriter
from rangeseg_ros.io.bags import DamagedBagError, DepthBag
from rangeseg_ros.io.recordings import BagError, unpacked

STORAGES = tuple(SUFFIXES)
START, STEP = 10**18, 33_333_333


def read(path, **options):
    """Numbers of the frames that can be read, by their stamps, and the bag."""
    numbers = []
    with DepthBag(path, **options) as bag:
        for frame in bag:
            try:
                frame.range_image()
            except ValueError as error:
                bag.lose(str(error))
            else:
                numbers.append((frame.stamp - START) // STEP)
    return numbers, bag


def with_bad_frame(path, bad, number=3, count=6, ros1=False):
    """Record frames, one of them spoilt by `bad(recording, stamp, image)`."""
    recording = Recording(ros1)
    for index, image in enumerate(depth_images(count)):
        stamp = START + index * STEP
        recording.add_camera(stamp)
        (bad if index == number else Recording.add_image)(recording, stamp, image)
    return recording.write(path)


def colour(recording, stamp, image):
    recording.add_image(stamp, np.zeros((48, 192), np.uint8), 'rgb8')


def short(recording, stamp, image):
    recording.add_image(stamp, image)
    recording.messages[-1][-1].data = recording.messages[-1][-1].data[:100]


def small(recording, stamp, image):
    recording.add_image(stamp, image[:20])


def bad_camera(recording, stamp, image):
    recording.messages.pop()
    recording.add_camera(stamp, focal=np.nan)
    recording.add_image(stamp, image)


@pytest.mark.parametrize('number', [0, 3, 5])
@pytest.mark.parametrize('bad', [colour, short, small, bad_camera])
@pytest.mark.parametrize('ros1', [False, True])
def test_one_bad_frame_costs_one_frame(tmp_path, bad, number, ros1):
    path = tmp_path / ('bag.bag' if ros1 else 'bag')
    with_bad_frame(path, bad, number, ros1=ros1)
    numbers, bag = read(path, depth_topic='/camera/depth/image_rect')
    assert numbers == [index for index in range(6) if index != number]
    assert bag.lost.total() == 1 and '1 of 6' in bag.loss()


def test_one_bad_png_costs_one_frame(tmp_path):
    recording = Recording()
    images = depth_images(4)
    for index, image in enumerate(images):
        recording.add_camera(START + index * STEP)
        recording.add_compressed(START + index * STEP, image)
    broken = recording.messages[3][-1]  # camera, image, camera, image
    broken.data = broken.data[:200]
    recording.write(tmp_path / 'bag')
    numbers, bag = read(tmp_path / 'bag')
    assert numbers == [0, 2, 3]
    assert bag.loss().endswith('compressed depth image holds no readable PNG')


def test_a_message_that_is_no_message_costs_one_frame(tmp_path):
    file = with_bad_frame(tmp_path / 'bag', Recording.add_image)
    data = bytearray(file.read_bytes())
    # The string of an encoding begins with its length.
    places = [i for i in range(len(data)) if data.startswith(b'16UC1', i)]
    data[places[2] - 4 : places[2]] = b'\xff' * 4
    file.write_bytes(data)
    numbers, bag = read(tmp_path / 'bag')
    assert numbers == [0, 1, 3, 4, 5]
    assert 'damaged message' in bag.loss()


def test_a_replay_leaves_out_a_bad_frame_and_says_so(tmp_path, run):
    with_bad_frame(tmp_path / 'bag', short, number=2, count=4)
    code, output, error = run('replay', tmp_path / 'bag', '--output', tmp_path / 'out')
    assert code == 1 and '3 frames' in output
    assert error.count('\n') == 1 and '1 of 4 frames left out' in error
    names = sorted(path.name for path in (tmp_path / 'out').glob('*_labels.png'))
    assert [int(name[:6]) for name in names] == [0, 1, 3]
    assert 'left out' in (tmp_path / 'out/report.html').read_text()
    code, output, error = run('replay', tmp_path / 'bag', '--output', tmp_path / 'out')
    assert code == 1 and 'done before' in output and 'left out' in error


def test_a_copy_leaves_out_a_bad_chunk(packed, run):
    (file,) = packed.glob('*.mcap')
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)
    out = packed.parent / 'out'
    code, _, error = run('replay', packed, '--output', out, '--copy')
    assert code == 1 and 'not copied' in error
    with DepthBag(out / 'bag') as bag:
        assert 6 <= len(list(bag)) < 8


def test_bags_without_any_good_frame_are_refused(tmp_path):
    recording = Recording()
    recording.add_camera(1)
    small(recording, 2, depth_images(1)[0])
    recording.write(tmp_path / 'bag')
    with pytest.raises(BagError, match='64x20'):
        DepthBag(tmp_path / 'bag')


@pytest.fixture
def packed(tmp_path):
    """A bag with checksums, of 8 frames in 4 or 8 chunks."""
    camera = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)
    with DepthBagWriter(tmp_path / 'bag', camera) as bag:
        for index, image in enumerate(depth_images(8, 480, 640)):
            bag.write(image, START + index * STEP)
    return tmp_path / 'bag'


def test_every_flipped_bit_of_a_chunk_is_noticed_and_costs_the_chunk(packed):
    (file,) = packed.glob('*.mcap')
    whole = file.read_bytes()
    chunks, position = [], 8
    while position < len(whole) - 8:  # between the two magics
        opcode, size = struct.unpack_from('<BQ', whole, position)
        if opcode == 6:
            chunks.append((position + 9, size))
        position += 9 + size
    assert len(chunks) >= 4
    random = np.random.default_rng(0)
    frames = set()
    for start, size in chunks:
        place = start + int(random.integers(100, size))
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(random.integers(8))
        file.write_bytes(damaged)
        numbers, bag = read(packed)
        lost = set(range(8)) - set(numbers)
        assert 1 <= len(lost) <= 2 and bag.lost.total() == len(lost)
        assert 'damaged chunk' in bag.loss()
        frames |= lost
    assert frames == set(range(8))


def test_a_bad_chunk_of_ros1_costs_the_chunk(tmp_path):
    path = tmp_path / 'a.bag'
    recording = Recording(ros1=True)
    for index, image in enumerate(depth_images(8, 480, 640)):
        recording.add_camera(START + index * STEP, 640, 480)
        recording.add_image(START + index * STEP, image)
    recording.write(path, compression='BZ2')
    assert read(path)[0] == list(range(8))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 16
    path.write_bytes(data)
    numbers, bag = read(path)
    assert 5 <= len(numbers) < 8 and bag.lost.total() == 8 - len(numbers)


def test_whole_frames_of_a_chunk_that_is_cut_through_are_read(tmp_path):
    file = record(tmp_path / 'bag', 'mcap', depth_images(20))  # one chunk
    data = file.read_bytes()
    for share in (0.3, 0.6):
        file.write_bytes(data[: int(share * len(data))])
        numbers = []
        with DepthBag(file) as bag, pytest.raises(DamagedBagError, match='within a record'):
            for frame in bag:
                numbers.append((frame.stamp - START) // STEP)
        assert numbers == list(range(len(numbers))) and len(numbers) >= 20 * share - 2


@pytest.mark.parametrize('compression', ['', 'zstd', 'bz2', 'lz4'])
def test_chunks_give_no_more_than_they_declare(compression):
    content = bytes(50_000_000)
    packed = {
        '': bytes,
        'zstd': zstandard.compress,
        'bz2': bz2.compress,
        'lz4': lz4.frame.compress,
    }[compression](content)
    assert unpack(compression, packed, len(content), zlib.crc32(content)) == (content, '')
    given, problem = unpack(compression, packed, 1000)
    assert (given, problem) == (bytes(1000), 'it is not as large as it declares')
    given, problem = unpack(compression, packed[: len(packed) // 2], len(content))
    assert len(given) < len(content) and problem
    assert 'checksum' in unpack(compression, packed, len(content), 1)[1]


def bomb(compression, count=48):
    """Record of an mcap chunk that holds messages without content, 64 MB of them `count` times."""
    empty = struct.pack('<BQHIQQ', 5, 22, 0, 0, 0, 0)
    part = empty * (2**26 // len(empty))
    if compression == 'zstd':
        compressor = zstandard.ZstdCompressor().compressobj()
        data = b''.join(compressor.compress(part) for _ in range(count)) + compressor.flush()
    else:
        with lz4.frame.LZ4FrameCompressor() as compressor:
            pieces = [compressor.begin(), *(compressor.compress(part) for _ in range(count))]
            data = b''.join(pieces) + compressor.flush()
    name = struct.pack('<I', len(compression)) + compression.encode()
    record = struct.pack('<QQQI', 0, 0, count * len(part), 0) + name
    return struct.pack('<BQ', 6, len(record) + 8 + len(data)) + record, data


def without_index(whole):
    """An mcap whose footer says that there is no index."""
    place = 8
    while whole[place] not in (2, 15):  # footer, or the end of the data
        place += 9 + struct.unpack_from('<Q', whole, place + 1)[0]
    return whole[:place] + struct.pack('<BQQQI', 2, 20, 0, 0, 0) + whole[-8:]


def test_an_mcap_without_an_index_is_read_to_its_end(packed):
    (file,) = packed.glob('*.mcap')
    file.write_bytes(without_index(file.read_bytes()))
    numbers, bag = read(file)
    assert numbers == list(range(8)) and not bag.loss()


@pytest.mark.parametrize('compression', ['zstd', 'lz4'])
@pytest.mark.parametrize('index', ['damaged', 'missing'])
def test_chunks_that_declare_far_more_than_they_store_are_not_unpacked(packed, compression, index):
    """The front of 3 GB, for which every message of each pass would take minutes."""
    (file,) = packed.glob('*.mcap')
    whole = file.read_bytes()
    front, data = bomb(compression)
    position = 8 + 9 + struct.unpack_from('<Q', whole, 9)[0]  # behind the header
    tail = whole[position:-8] if index == 'damaged' else without_index(whole)[position:]
    file.write_bytes(whole[:position] + front + struct.pack('<Q', len(data)) + data + tail)
    with DepthBag(file) as bag, pytest.raises(DamagedBagError, match='compressed bytes declare'):
        assert len(list(bag)) == 8


def test_messages_that_declare_far_more_than_they_store_are_lost():
    packed = zstandard.compress(bytes(2**27))
    lost = unpacked(Record('topic', 'type', 1, packed))
    assert isinstance(lost, Lost) and 'compressed bytes declare' in lost.reason


@pytest.mark.parametrize('name', ['data', 'metadata.yaml'])
def test_a_pipe_in_a_bag_is_not_waited_for(packed, name, run):
    (file,) = packed.glob('*.mcap')
    path = file if name == 'data' else packed / name
    path.unlink()
    os.mkfifo(path)
    for bag in {packed, path if name == 'data' else packed}:
        code, _, error = run('replay', bag, '--output', packed.parent / 'out')
        assert code and 'not a regular file' in error and error.count('\n') == 1


def test_metadata_that_would_take_for_ever(packed, run):
    (packed / 'metadata.yaml').write_text('[' + '1, ' * 2_000_000 + '1]')
    code, _, error = run('replay', packed, '--output', packed.parent / 'out')
    assert code and 'metadata.yaml: too large' in error and error.count('\n') == 1


def test_a_stamp_that_ros_2_cannot_tell_costs_the_frame(tmp_path, run):
    recording = Recording()
    for nanosec in (0, 10**9, 2**32 - 1):
        recording.add_camera(START)
        recording.add_image(START, depth_images(1)[0])
        stamp = recording.messages[-1][-1].header.stamp
        stamp.sec, stamp.nanosec = 2**31 - 1, nanosec
    recording.write(tmp_path / 'bag')
    code, output, error = run('replay', tmp_path / 'bag', '--output', tmp_path / 'out')
    assert code == 1 and '1 frames' in output
    assert '2 of 3 frames left out: stamp of 2147483648 s' in error and error.count('\n') == 1


def test_a_stamp_that_ros_2_cannot_tell_is_not_written(tmp_path):
    camera = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
    with DepthBagWriter(tmp_path / 'bag', camera) as bag:
        for stamp in (2**31 * 10**9, -(2**31) * 10**9 - 1):
            with pytest.raises(BagError, match='stamp'):
                bag.write(depth_images(1)[0], stamp)


def test_sizes_are_checked_before_pngs_are_decoded(tmp_path, monkeypatch):
    recording = Recording()
    image = depth_images(1)[0]
    recording.add_camera(1)
    recording.add_compressed(1, image)
    recording.add_compressed(2, np.zeros((3000, 3000), np.uint16))
    recording.write(tmp_path / 'bag')
    decoded = []
    imdecode = cv2.imdecode
    monkeypatch.setattr(
        cv2, 'imdecode', lambda data, flags: decoded.append(len(data)) or imdecode(data, flags)
    )
    _, bag = read(tmp_path / 'bag')
    assert 'depth image is 3000x3000, its camera_info 64x48' in bag.loss()
    assert len(set(decoded)) == 1
