"""Images, cameras, parameters and tables: what is read back, and refused in one line."""

import json
import os
import resource
from dataclasses import fields, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from planes_of_labels import stated_plane
from replays import rows_of

from rangeseg_ros import CameraError, Config, ConfigError
from rangeseg_ros.cli.errors import one_line
from rangeseg_ros.cli.options import write_json
from rangeseg_ros.io.cameras import read_camera
from rangeseg_ros.io.files import FileError
from rangeseg_ros.io.images import read_depth, read_labels, write_image
from rangeseg_ros.io.params import NODE_ONLY, read_config, read_params
from rangeseg_ros.io.tables import columns, open_table, values
from rangeseg_ros.io.yaml_files import read_yaml


def test_what_is_no_depth_image_is_named(tmp_path):
    cv2.imwrite(str(tmp_path / 'colour.png'), np.zeros((4, 5, 3), np.uint16))
    cv2.imwrite(str(tmp_path / 'a.bmp'), np.ones((8, 8), np.uint8))
    for number, content in enumerate((b'', b'no image', b'\x89PNG\r\n\x1a\n')):
        (tmp_path / f'{number}.png').write_bytes(content)
    told = dict.fromkeys(('a.bmp', '0.png', '1.png', '2.png'), 'no readable PNG, PGM, PFM, or')
    told |= {'colour.png': '.* one channel, not 3', 'none.png': 'No such file'}
    for name, message in {**told, '': 'Is a directory'}.items():
        with pytest.raises(FileError, match=f'^{tmp_path / name}: {message}'):
            read_depth(tmp_path / name)


def test_labels_are_written_and_read_back_and_pictures_are_rgb(tmp_path):
    labels = np.array([[0, 1], [300, 65535]], np.uint16)
    write_image(tmp_path / 'folder/labels.png', labels)
    np.testing.assert_array_equal(read_labels(tmp_path / 'folder/labels.png'), labels)
    write_image(tmp_path / 'red.png', np.full((2, 2, 3), (255, 0, 0), np.uint8))
    assert cv2.imread(str(tmp_path / 'red.png'))[0, 0].tolist() == [0, 0, 255]
    write_image(tmp_path / 'floats.tiff', np.zeros((2, 2), np.float32))
    for name, kind in (('red.png', '3 of uint8'), ('floats.tiff', '1 of float32')):
        with pytest.raises(FileError, match=f'label image must have one channel .* not {kind}'):
            read_labels(tmp_path / name)


def test_where_there_is_no_room_the_file_is_named_and_stays_as_it_was(tmp_path):
    path, (soft, hard) = tmp_path / 'picture.png', resource.getrlimit(resource.RLIMIT_FSIZE)
    path.write_text('old')
    noise = np.random.default_rng(0).integers(0, 255, (200, 200), np.uint8)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        with pytest.raises(OSError, match='too large') as caught:
            write_image(path, noise)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert one_line(caught.value) == f'{path}: File too large'
    assert path.read_text() == 'old' and list(tmp_path.iterdir()) == [path]


def test_what_is_no_camera_is_named(tmp_path):
    path = tmp_path / 'camera.yaml'
    with pytest.raises(FileError, match=f'{path}: No such file'):
        read_camera(path)
    path.write_text('- 1')
    with pytest.raises(CameraError, match=f'{path}: not a camera calibration'):
        read_camera(path)


def test_flat_and_ros_parameter_files_say_the_same(tmp_path):
    path = tmp_path / 'params.yaml'
    for content in (
        'smoothness: 12.5',
        'segment_planes: {ros__parameters: {smoothness: 12.5}}',
        '/*: {ros__parameters: {smoothness: 12.5}}',
        '/robot/*: {ros__parameters: {smoothness: 12.5}}',
        'robot: {segment_planes: {ros__parameters: {smoothness: 12.5}}}',
        '/robot: {front: {segment_planes: {ros__parameters: {smoothness: 12.5}}}}',
        '/**/segment_planes: {ros__parameters: {smoothness: 12.5}}',
        '/**: {ros__parameters: {smoothness: 1.0}}\n'
        'other_node: {ros__parameters: {nonsense: 3}}\n'
        '/robot/segment_planes: {ros__parameters: {smoothness: 12.5}}',
    ):
        path.write_text(content)
        assert read_config(path) == Config(smoothness=12.5)
    path.write_text('')
    assert read_config(path) == read_config(None) == Config()
    assert read_config(path, smoothness=3.0) == Config(smoothness=3.0)
    assert [read_config(path) for path in Path(__file__).parents[1].glob('params/*.yaml')]


def test_parameters_of_the_node_alone_and_of_others_do_no_harm(tmp_path):
    path = tmp_path / 'params.yaml'
    others = {'use_sim_time': True, 'stall_timeout': 3.0}
    others['qos_overrides./depth/image_rect.subscription.depth'] = 1
    others['qos_overrides'] = {'/depth/image_rect': {'subscription': {'depth': 1}}}
    parameters = {'ros__parameters': {'smoothness': 12.5, **others}}
    path.write_text(yaml.safe_dump({'segment_planes': parameters}))
    assert read_config(path) == Config(smoothness=12.5)
    path.write_text('/**: {ros__parameters: {min_pixels: 7, exposure: 3, use_sim_time: true}}')
    with pytest.warns(UserWarning, match="unknown parameter 'exposure' .of another node"):
        assert read_config(path) == Config(min_pixels=7)
    pytest.importorskip('rclpy')
    from rangeseg_ros.ros.parameters import NodeConfig

    names = {field.name for field in fields(NodeConfig)} - {f.name for f in fields(Config)}
    assert names <= NODE_ONLY


def grown(part, whole):
    """A small file whose aliases stand for millions of nodes."""
    lines = [f'a{k}: &a{k} ' + whole.format(9 * part.format(f'*a{k - 1}')) for k in range(1, 9)]
    return '\n'.join(['a0: &a0 {y: 1}', *lines])


# Nine thousand times three thousand.
WIDE = f'a: &a {{{"".join(f"{k}: 1, " for k in range(3000))}}}\nb: [{"*a, " * 9000}]'


@pytest.mark.parametrize(
    ('content', 'message'),
    [
        ('- 1', 'not a mapping'),
        ('a: [', 'not a YAML file'),
        ('smoothnes: 3', "unknown parameter 'smoothnes'; is 'smoothness' meant"),
        ('segment_planes: {ros__parameters: {smoothnes: 3}}', "unknown parameter 'smoothnes'"),
        ('3: 4', 'unknown parameter 3'),
        ('node: {ros__parameters: {smoothness: 1.0}}', 'no ros__parameters of segment_planes'),
        ('segment_planes: {ros__parameters: [1, 2]}', 'no mapping'),
        ('min_pixels: 3\nsegment_planes: {ros__parameters: {}}', 'has no ros__parameters'),
        ('noise: 1' + '0' * 400, 'noise must be in'),
        ('min_pixels: 1' + '0' * 400, 'min_pixels must be in'),
        ('[' * 20000, 'nested too deeply'),
        ('a: ' + 'x' * 2**17, 'too large'),
        ('a: 2001-99-99', 'not a YAML file'),
        ('a: \x00', 'not a YAML file'),
        # They would take for ever.
        (grown('{}, ', '{{x: [{}]}}'), 'too often'),
        (grown('{}, ', '{{<<: [{}]}}'), 'too often'),
        (WIDE, 'too often'),
    ],
)
def test_bad_parameter_files_are_named(tmp_path, content, message):
    path = tmp_path / 'params.yaml'
    path.write_text(content)
    with pytest.raises((ConfigError, FileError), match=message) as caught:
        read_config(path)
    told = str(caught.value)
    assert str(path) in told and len(told) < 200 + len(str(path)) and '\n' not in told
    with pytest.raises(FileError, match='No such file'):
        read_params(tmp_path / 'none.yaml')


def test_plane_table(tmp_path):
    path = tmp_path / 'planes.csv'
    with open_table(path, ['frame', *columns()]) as append:
        assert path.read_text() == ','.join(['frame', *columns()]) + '\n'
        append([0, *values(plane)] for plane in (stated_plane(1), stated_plane(2)))
        append([])
        append([[2, *values(replace(stated_plane(1), distance=1 / 3))]])
        rows = rows_of(path)  # on disk before the table is closed
    assert [(row['frame'], row['label']) for row in rows] == [('0', '1'), ('0', '2'), ('2', '1')]
    assert [float(rows[0][f'normal_{axis}']) for axis in 'xyz'] == [0.0, 0.0, -1.0]
    assert float(rows[0]['covariance_yd']) == 7.0  # normal_y with distance
    assert float(rows[2]['distance']) == pytest.approx(1 / 3, rel=1e-8)
    assert rows[0]['hull'] == '-1 -1 2;-1 1 2;1 1 2;1 -1 2'
    assert all(None not in row and None not in row.values() for row in rows)
    # No array is written as numpy prints it.
    assert not any('[' in value for row in rows for value in row.values())


def test_aliases_are_read(tmp_path):
    path = tmp_path / 'file.yaml'
    path.write_text('a: &a {x: 1, y: 2}\nb: {<<: *a, y: 3}\nc: [*a, *a]')
    a = {'x': 1, 'y': 2}
    assert read_yaml(path) == {'a': a, 'b': {'x': 1, 'y': 3}, 'c': [a, a]}


def test_pipes_are_not_waited_for(folder, refused):
    os.mkfifo('pipe')
    seen = 'depth/2.png'
    for image, camera in (('pipe', 'camera.yaml'), (seen, 'pipe'), (seen, '/dev/zero')):
        error = refused('segment', image, '--camera', camera, '--output', 'out')
        assert 'not a regular file' in error


def test_sizes_are_checked_before_images_are_decoded(tmp_path, monkeypatch):
    for name in ('large.png', 'large.tiff'):
        write_image(tmp_path / name, np.zeros((300, 400), np.uint16))
    monkeypatch.setattr(cv2, 'imdecode', None)
    for name, (height, width) in (('large.png', (300, 64)), ('large.tiff', (48, 400))):
        with pytest.raises(FileError, match=f'is 400x300, its camera {width}x{height}'):
            read_depth(tmp_path / name, (height, width))


def test_damaged_images_are_one_line(tmp_path, capfd):
    random = np.random.default_rng(1)
    whole = cv2.imencode('.png', random.integers(0, 9999, (48, 64), np.uint16))[1].tobytes()
    for number in range(60):
        data = bytearray(whole)
        if number % 2:
            data[random.integers(len(data))] ^= 1 << int(random.integers(8))
        else:
            del data[random.integers(len(data)) :]
        (tmp_path / 'b.png').write_bytes(data)
        with pytest.raises(FileError):
            read_depth(tmp_path / 'b.png')
    assert capfd.readouterr().err == ''


def test_of_several_pages_the_first_is_read_with_a_word(tmp_path):
    pages = [np.full((3, 4), number, np.uint16) for number in (1, 2, 3)]
    cv2.imwritemulti(str(tmp_path / 'a.tiff'), pages)
    with pytest.warns(UserWarning, match='first of 3 pages'):
        assert (read_depth(tmp_path / 'a.tiff') == 1).all()


def test_errors_are_one_line_of_printable_characters():
    assert one_line(ValueError('a\nb\x00\x1b[31m')) == 'a\\nb\\x00\\x1b[31m'
    assert one_line(MemoryError()) == 'not enough memory'
    assert one_line(FileNotFoundError(2, 'No such file', 'x')) == 'x: No such file'


def test_figures_are_json_as_they_are_and_nan_is_null(tmp_path):
    figures = {'a': 0.25, 'b': {'c': np.nan, 'd': 3}, 'e': [np.inf, 'x', np.nan], 'f': None}
    write_json(tmp_path / 'a.json', figures)
    told = json.loads((tmp_path / 'a.json').read_text())
    assert told == {'a': 0.25, 'b': {'c': None, 'd': 3}, 'e': [None, 'x', None], 'f': None}
