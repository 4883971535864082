"""From a recording with tf to the map of planes: every format, poses in files, the command."""

from types import SimpleNamespace

import numpy as np
import pytest
from recordings import EARLY_TF, SUFFIXES, TF, Recording
from replays import rows_of
from scipy.spatial.transform import Rotation

from rangeseg_ros import Camera
from rangeseg_ros.core.mapping.transforms import TransformError
from rangeseg_ros.io.cameras import write_camera
from rangeseg_ros.io.files import FileError
from rangeseg_ros.io.images import write_image
from rangeseg_ros.io.poses import match_poses
from rangeseg_ros.io.tables import parts_value
from rangeseg_ros.io.transforms import RecordedTransforms
from rangeseg_ros.simulation.scenes import OPTICAL_IN_BODY

FRAMES, STEP, WALL, ABOVE = 6, 0.05, 2.0, 1.0
CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
# Optical axes, 35 degrees down, in a frame with x forward and z up.
OPTICAL = Rotation.from_euler('y', 35, degrees=True) * Rotation.from_matrix(OPTICAL_IN_BODY)


def depth(k):
    """Of a wall at x = WALL and the ground at z = 0, STEP nearer to the wall every time."""
    ahead, _, up = np.moveaxis(CAMERA.rays @ OPTICAL.as_matrix().T, -1, 0)
    return np.round(1000 / np.maximum(-up / ABOVE, ahead / (WALL - STEP * k))).astype(np.uint16)


@pytest.mark.parametrize(
    ('storage', 'kind'), [('mcap', TF), ('sqlite3', TF), ('rosbag1', TF), ('rosbag1', EARLY_TF)]
)
def test_tf_of_any_recording_places_the_planes(tmp_path, run, storage, kind):
    recording = Recording(ros1=storage == 'rosbag1')
    mount = 'base_link', 'optical', OPTICAL.as_quat(), (0, 0, ABOVE)
    recording.add_transform(10**18, *mount, kind, static=True)
    for k in range(FRAMES):
        stamp = 10**18 + k * 10**8
        recording.add_camera(stamp)
        recording.add_image(stamp, depth(k))
        # Between samples, so that they are interpolated.
        for after in (-20_000_000, 20_000_000):
            place = (0, 0, 0, 1), (STEP * (k + after * 1e-8), 0, 0)
            recording.add_transform(stamp + after, 'odom', 'base_link', *place, kind)
    recording.messages.sort(key=lambda message: message[0])
    path, out, params = (tmp_path / name for name in (f'a{SUFFIXES[storage]}', 'out', 'p.yaml'))
    recording.write(path, storage)
    params.write_text('min_pixels: 300\ngravity_frame: odom\n')
    options = '--fixed-frame', 'odom', '--params', params, '--output', out
    code, told, error = run('replay', path, *options)
    assert (code, error) == (0, '')
    # No note of frames whose place is not known.
    assert told.splitlines()[1:] == [f'{out}: {FRAMES} frames, 2 planes in the map']
    rows = sorted(rows_of(out / 'map.csv'), key=lambda row: row['role'])
    assert [row['role'] for row in rows] == ['floor', 'wall']
    for row, equation in zip(rows, ((0, 0, 1, 0), (-1, 0, 0, WALL)), strict=True):
        names = 'normal_x', 'normal_y', 'normal_z', 'distance'
        assert [float(row[name]) for name in names] == pytest.approx(equation, abs=0.02)
        assert int(row['observations']) == FRAMES
        parts = [part.split('|') for part in row['parts'].split('||')]
        assert parts[0] == [row['hull'], *filter(None, row['holes'].split('|'))]
        assert int(row['last_stamp']) - int(row['first_stamp']) == (FRAMES - 1) * 10**8
    assert (out / 'map.ply').read_bytes().startswith(b'ply')


FRAME = 'camera_depth_optical_frame'


@pytest.fixture
def pack(tmp_path, run):
    """Pack images with the poses in a folder: the bag, and what is said."""
    camera, images, poses = (tmp_path / name for name in ('camera.yaml', 'images', 'poses'))
    poses.mkdir()
    write_camera(camera, CAMERA)
    for k in range(FRAMES):
        write_image(images / f'frame-{k:06d}.depth.png', depth(k))

    def run_command(*options):
        files = '--camera', camera, '--poses', poses, '--output', tmp_path / 'bag'
        code, output, error = run('pack', images, *files, *options)
        assert code == 0, error
        return tmp_path / 'bag', output

    return run_command


def some_pose(k):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.3 * k, 0.1, -0.7]).as_matrix()
    pose[:3, 3] = k, -1, 0.5
    return pose


def test_poses_become_transforms_at_the_stamps_of_their_images(tmp_path, pack):
    for k in range(5):
        path = tmp_path / f'poses/frame-{k}.pose.txt'
        np.savetxt(path, some_pose(k), delimiter=', ' if k % 2 else ' ')
    bag, output = pack('--rate', '10')
    told = '5 poses, 1 without: no pose for frame-000005.depth.png'
    assert output.splitlines()[-2:] == [f'{bag}: 6 images', told]
    with RecordedTransforms(bag, timeout=0.0) as transforms:
        for k in range(5):
            stamp = 10**9 + k * 10**8
            found = transforms.lookup('world', FRAME, stamp, stamp)
            np.testing.assert_allclose(found.rotation, some_pose(k)[:3, :3], atol=1e-9)
            np.testing.assert_allclose(found.shift, some_pose(k)[:3, 3], atol=1e-9)
            # Not known before it was recorded.
            with pytest.raises(TransformError, match='that late'):
                transforms.lookup('world', FRAME, stamp + 5 * 10**7, stamp)


def test_what_is_missing_or_no_pose_is_counted_and_said(tmp_path, pack):
    values = [some_pose(k) for k in range(6)]
    values[1][0, 0] = np.nan
    values[2][:3, :3] *= 1.5
    values[3][:3, 0] *= -1
    for k in (0, 1, 2, 3):
        np.savetxt(tmp_path / f'poses/{k}.txt', values[k])
    (tmp_path / 'poses/4.txt').write_text('1 2 three')
    bag, output = pack()
    assert '1 poses, 5 without: 1.txt: values are not finite, and 4 more' in output
    with RecordedTransforms(bag, timeout=1.0) as transforms:
        transforms.lookup('world', FRAME, 10**9, 10**9)
        with pytest.raises(TransformError):
            transforms.lookup('world', FRAME, 2 * 10**9, 2 * 10**9)


def test_poses_are_found_by_stem_or_else_by_number(tmp_path):
    for name in ('a1.txt', 'b2.pose.txt', 'pose_0003.txt', 'notes.md'):
        (tmp_path / name).write_text('')
    images = [tmp_path / name for name in ('a1.png', 'b2.png', 'frame3.depth.tiff', 'frame4.png')]
    found = match_poses(images, tmp_path)
    names = 'a1.txt', 'b2.pose.txt', 'pose_0003.txt'
    assert found == {i: tmp_path / name for i, name in zip(images[:3], names, strict=True)}
    (tmp_path / 'other-3.txt').write_text('')
    with pytest.raises(FileError, match=r'may belong to other-3.txt or pose_0003.txt'):
        match_poses(images, tmp_path)
    with pytest.raises(FileError, match=r'no \.txt files'):
        match_poses(images, tmp_path / 'nowhere')


def test_all_parts_of_a_plane_are_in_its_row():
    hull, hole, other = (np.full((2, 3), k) for k in (1, 2, 3.5))
    plane = SimpleNamespace(outline=SimpleNamespace(parts=[[hull, hole], [other]]))
    assert parts_value(plane) == '1 1 1;1 1 1|2 2 2;2 2 2||3.5 3.5 3.5;3.5 3.5 3.5'
