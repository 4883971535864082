"""Depth in the files, folders and with the intrinsics that people have."""

import json
import struct

import cv2
import numpy as np
import pytest
from processes import python

from rangeseg_ros import Camera, RangeImage
from rangeseg_ros.io.cameras import read_camera
from rangeseg_ros.io.depth_files import Intrinsics, files_in, read_frame, scale_of
from rangeseg_ros.io.files import FileError
from rangeseg_ros.io.images import write_image
from rangeseg_ros.io.pcd import read_pcd

CAMERA = Camera(64, 48, 60, 60, 31.5, 23.5)


@pytest.fixture
def depth():
    """Millimetres of a slanted wall with a hole."""
    v, u = np.indices(CAMERA.shape)
    depth = (1500 + 3 * u + 2 * v).astype(np.uint16)
    depth[:4, :4] = 0
    return depth


def write_ply(path, points, form='binary_little_endian', size=True):
    height, width = points.shape[:2]
    info = [f'obj_info num_cols {width}', f'obj_info num_rows {height}'] if size else []
    axes = [f'property float {axis}' for axis in 'xyz']
    head = ['ply', f'format {form} 1.0', *info, f'element vertex {width * height}', *axes]
    head += ['property uchar red', 'element face 0', 'property list uchar int vertex_indices']
    order = '>' if 'big' in form else '<'
    rows = np.full(height * width, 7, [('points', f'{order}f4', 3), ('red', 'u1')])
    rows['points'] = points.reshape(-1, 3)
    lines = (f'{x:.9g} {y:.9g} {z:.9g} {red}\n' for (x, y, z), red in rows)
    body = ''.join(lines).encode() if form == 'ascii' else rows.tobytes()
    path.write_bytes('\n'.join([*head, 'end_header', '']).encode() + body)


def write_exr(path, channels):
    exr = pytest.importorskip('OpenEXR')
    header = {'compression': exr.ZIP_COMPRESSION, 'type': exr.scanlineimage}
    channels = {name: values.astype('f4') for name, values in channels.items()}
    with exr.File(header, channels) as file:
        file.write(str(path))


KINDS = ['png', 'pgm', 'float.pfm', 'tiff', 'float.tiff', 'npy', 'int64.npy', 'npz']
KINDS += ['Z.exr', 'R,G,B,A.exr', 'A.Z,B.R.exr', 'L.Depth.Z,L.Normal.Z.exr']


@pytest.mark.parametrize('kind', KINDS)
def test_images(kind, depth, tmp_path):
    path = tmp_path / f'frame.{kind}'
    metres = depth.astype(np.float32) / 1000
    if kind.endswith('exr'):
        parts = kind[:-4].split(',')
        write_exr(path, {n: metres * (n not in ('A', 'B.R', 'L.Normal.Z')) for n in parts})
    elif kind == 'npz':
        np.savez_compressed(path, colour=np.zeros((48, 64, 3)), depth=metres)
    elif kind.endswith('npy'):
        np.save(path, depth.astype(np.int64) if 'int64' in kind else depth)
    else:
        assert cv2.imwrite(str(path), metres if 'float' in kind else depth)
    image = read_frame(path, Intrinsics(CAMERA))
    np.testing.assert_allclose(
        image.inverse, RangeImage.from_depth(depth, CAMERA).inverse, rtol=1e-6
    )


PLY = {'ply': 'binary_little_endian', 'big.ply': 'binary_big_endian', 'ascii.ply': 'ascii'}


@pytest.mark.parametrize('kind', ['pcd', 'unsized.pcd', *PLY, 'unsized.ply'])
def test_organised_clouds(kind, depth, tmp_path):
    points = RangeImage.from_depth(depth, CAMERA).points
    path = tmp_path / f'cloud.{kind}'
    if kind.endswith('pcd'):
        size = 'WIDTH 3072\nHEIGHT 1' if 'unsized' in kind else 'WIDTH 64\nHEIGHT 48'
        head = f'FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n{size}\n'
        head += 'POINTS 3072\nDATA binary\n'
        path.write_bytes(head.encode() + points.tobytes())
    else:
        write_ply(path, points, PLY.get(kind, 'ascii'), size='unsized' not in kind)
    image = read_frame(path, Intrinsics(CAMERA if 'unsized' in kind else None))
    np.testing.assert_allclose(image.points, points, atol=1e-5)
    halved = read_frame(path, Intrinsics(CAMERA), 0.5)
    np.testing.assert_allclose(halved.points, points / 2, atol=1e-5)


def test_what_is_none_is_refused_in_one_line(depth, tmp_path):
    write_ply(tmp_path / 'sized.ply', RangeImage.from_depth(depth, CAMERA).points)
    sized = (tmp_path / 'sized.ply').read_bytes()
    head = 'ply\nformat ascii 1.0\nelement vertex 1\nproperty {} x\nend_header\n'
    for name, content, words in (
        ('cut.ply', sized[:5000], 'truncated'),
        # Both sizes are needed.
        ('cols.ply', sized.replace(b'obj_info num_cols ', b'x '), 'not one for each pixel'),
        ('rows.ply', sized.replace(b'obj_info num_rows ', b'x '), 'not one for each pixel'),
        ('text.ply', b'hello end_header', 'not a PLY file'),
        ('huge.ply', sized.replace(b'vertex ', b'vertex 9999999999999999999'), 'truncated'),
        ('faces.ply', sized.replace(b'element', b'element face 0\nelement', 1), 'no vertices at'),
        ('list.ply', head.format('list uchar int').encode(), 'vertices with lists'),
        ('kind.ply', head.format('float99').encode(), 'vertices with lists'),
        ('text.npy', b'hello', 'not a readable file of NumPy'),
        ('text.npz', b'hello', 'not a readable file of NumPy'),
        ('cut.npy', b"\x93NUMPY\x01\x00\x0c\x00{'descr': (((", 'not a readable file of NumPy'),
        ('record.bag', b'hello', 'rangeseg replay'),
        ('empty.npz', {}, 'not a readable file of NumPy'),
        ('first.npz', {'Depth': np.ones(5), 'colour': np.ones((4, 5))}, r'\(5,\) float64'),
        ('text2.npy', np.array([['a']]), 'integers or floats, not <U1'),
        ('colour.npy', np.ones((4, 5, 3), np.uint8), r'points \(H, W, 3\), \(4, 5, 3\) uint8'),
        ('row.npy', np.ones(5), r'no depth \(H, W\) nor points'),
        ('points.npy', np.ones((5, 3)), '5 points, not one for each pixel'),
    ):
        if isinstance(content, bytes):
            (tmp_path / name).write_bytes(content)
        elif isinstance(content, dict):
            np.savez(tmp_path / name, **content)
        else:
            np.save(tmp_path / name, content)
        with pytest.raises(ValueError, match=words):
            read_frame(tmp_path / name, Intrinsics(fov=60))
    with pytest.raises(ValueError, match='No such file'):
        read_frame(tmp_path / 'missing.ply', Intrinsics(fov=60))


def test_a_picture_in_exr_is_no_depth(depth, tmp_path):
    write_exr(tmp_path / 'colour.exr', {name: k * depth for k, name in enumerate('RGB')})
    with pytest.raises(ValueError, match=r'which is depth\? Its channels: '):
        read_frame(tmp_path / 'colour.exr', Intrinsics(CAMERA))


def test_folders(depth, tmp_path):
    tum, mixed, empty = (tmp_path / name for name in ('tum', 'mixed', 'empty'))
    empty.mkdir()
    for name in ('2.png', '1.png'):
        write_image(tum / 'depth' / name, depth)
        (tum / 'depth' / f'._{name}').write_bytes(b'of the Finder')
        write_image(tum / 'rgb' / name, np.zeros((48, 64, 3), np.uint8))
    (tum / 'depth.txt').write_text('# timestamp filename\n')
    assert files_in(tum) == [tum / 'depth/1.png', tum / 'depth/2.png']
    assert scale_of(tum) == pytest.approx(0.0002) and scale_of(mixed) is None
    for name in ('frame-0.depth.png', 'frame-0.color.png'):
        write_image(mixed / name, depth)
    assert files_in(mixed) == [mixed / 'frame-0.depth.png']
    assert files_in(mixed / 'frame-0.color.png') == [mixed / 'frame-0.color.png']
    with pytest.raises(ValueError, match='no depth images'):
        files_in(empty)


def test_intrinsics_of_open3d(tmp_path):
    k = [60, 0, 0, 0, 61, 0, 31.5, 23.5, 1]  # by columns
    flat = {'width': 64, 'height': 48, 'intrinsic_matrix': k}
    for content in (flat, {'class_name': 'PinholeCameraParameters', 'intrinsic': flat}):
        (tmp_path / 'camera.json').write_text(json.dumps(content, indent='\t'))
        assert read_camera(tmp_path / 'camera.json') == Camera(64, 48, 60, 61, 31.5, 23.5)
    huge = flat | {'intrinsic_matrix': [10**400, *k[1:]]}
    for content, words in ((huge, 'too large'), ({'intrinsic_matrix': k}, 'width')):
        (tmp_path / 'camera.json').write_text(json.dumps(content))
        with pytest.raises(ValueError, match=f'Open3D: .*{words}'):
            read_camera(tmp_path / 'camera.json')


def test_intrinsics_of_numbers():
    for focal in ((60, None, None, None), (None, 60, None, None)):
        assert Intrinsics(focal=focal).of((48, 64)) == CAMERA
    assert Intrinsics(focal=(60, 61, 0.0, 1)).of((48, 64)) == Camera(64, 48, 60, 61, 0, 1)
    for fov in (0.5, 90):
        focal = Intrinsics(fov=fov).of((48, 64)).fx
        assert focal == pytest.approx(32 / np.tan(np.radians(fov / 2)))
    with pytest.raises(ValueError, match='between 0 and 180'):
        Intrinsics(fov=0).of((48, 64))
    with pytest.raises(ValueError, match='--camera FILE, --fov DEGREES'):
        Intrinsics().of((48, 64))


@pytest.mark.parametrize(
    ('words', 'told'),
    [
        ([], 'Segment depth images into planes'),
        (['help'], 'Segment depth images into planes'),
        (['segmnt'], "no command 'segmnt': is 'segment' meant?"),
        (['xyzzy'], 'rangeseg --help'),
        (['segment', __file__, '--camra', 'x', '--output', 'y'], "'--camera'"),
        (['segment', __file__, '--fov', '50', '--fx', '3', '--output', 'y'], 'one of --camera'),
        (['segment', __file__, '--fov', '50', '--camera', __file__, '--output', 'y'], 'one of'),
        (['segment', __file__, '--cx', '3', '--output', 'y'], 'need --fx'),
        (['segment', __file__, '--fov', 'nan', '--output', 'y'], 'not finite'),
    ],
)
def test_help_and_suggestions(words, told, run):
    code, output, error = run(*words)
    asked = words in ([], ['help'])
    assert told in (output if asked else error)
    assert (code, error.count('\n')) == ((0, 0) if asked else (2, 1))


def test_a_missing_extra_is_one_line():
    code = (
        'import sys; sys.modules["rosbags"] = None; from rangeseg_ros.cli.main import main; main()'
    )
    ended = python(code, 'replay', 'x', '--output', 'y')
    assert (ended.returncode, ended.stdout, ended.stderr.count('\n')) == (2, '', 1)
    assert "pip install 'rangeseg_ros[bags]'" in ended.stderr


HEADER = '# .PCD v0.7\nVERSION 0.7\nFIELDS x label normal\nSIZE 4 2 8\nTYPE F U F\nCOUNT 1 1 3\n'
HEADER += 'WIDTH 3\nHEIGHT 2\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 6\nDATA {}\n'
RECORDS = np.zeros((2, 3), [('x', '<f4'), ('label', '<u2'), ('normal', '<f8', (3,))])
RECORDS['x'] = [[0.5, np.nan, 2], [3, 4, 5]]
RECORDS['label'] = [[0, 1, 65535], [3, 4, 5]]
RECORDS['normal'] = np.arange(18).reshape(2, 3, 3)


def encoded(kind):
    head = HEADER.format(kind).encode()
    if kind == 'ascii':
        rows = (f'{x} {label} {" ".join(map(str, normal))}' for x, label, normal in RECORDS.flat)
        return head + '\n'.join(rows).encode()
    if kind == 'binary':
        return head + RECORDS.tobytes()
    raw = b''.join(RECORDS[name].tobytes() for name in RECORDS.dtype.names)
    # LZF of incompressible data: runs of at most 32 literal bytes.
    runs = (raw[i : i + 32] for i in range(0, len(raw), 32))
    packed = b''.join(bytes([len(run) - 1]) + run for run in runs)
    return head + struct.pack('<II', len(packed), len(raw)) + packed


@pytest.mark.parametrize('kind', ['ascii', 'binary', 'binary_compressed'])
def test_encodings(tmp_path, kind):
    path = tmp_path / 'a.pcd'
    path.write_bytes(encoded(kind))
    values = read_pcd(path, 'label', 'x')
    np.testing.assert_array_equal(values, np.stack([RECORDS['label'], RECORDS['x']], axis=2))
    with pytest.raises(FileError, match='no field y, z in it'):
        read_pcd(path, *'xyz')


BINARY = encoded('binary')


@pytest.mark.parametrize(
    ('data', 'fault'),
    [
        (b'', 'not a readable'),
        (BINARY.replace(b'FIELDS', b'FEELDS'), 'not a readable'),
        (BINARY.replace(b'COUNT 1 1 3', b'COUNT 1 3'), 'not a readable'),
        (BINARY.replace(b'DATA binary', b'DATA zipped'), 'not a readable'),
        (BINARY.replace(b'WIDTH 3', b'WIDTH 0'), '6 points where 0x2'),
        (BINARY.replace(b'WIDTH 3', b'WIDTH 10000000000'), '6 points where 1'),
        (BINARY[:-1], 'not a readable'),
        (encoded('ascii')[:-4], 'not a readable'),
        (encoded('binary_compressed')[:-5], 'not a readable'),
    ],
)
def test_malformed(tmp_path, data, fault):
    path = tmp_path / 'bad.pcd'
    path.write_bytes(data)
    # The folder has the name of the test: words of it prove nothing.
    with pytest.raises(FileError, match=rf'^{path}: .*{fault}') as error:
        read_pcd(path, 'x')
    assert '\n' not in str(error.value)
