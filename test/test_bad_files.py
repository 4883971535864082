"""Files that are too large, too deep, endless, or not what they look like: one line each."""

import os
import struct
import zlib

import cv2
import numpy as np
import pytest

from rangeseg_ros import Camera, Config, ConfigError
from rangeseg_ros.cli.errors import one_line
from rangeseg_ros.io.cameras import write_camera
from rangeseg_ros.io.images import ImageFileError, read_depth, write_image
from rangeseg_ros.io.params import read_config
from rangeseg_ros.io.pcd import PcdError, read_pcd
from rangeseg_ros.io.yaml_files import YamlError, read_yaml

BOMB = 'a: &a [1,1,1,1,1,1,1,1,1,1]\n' + ''.join(
    f'{new}: &{new} [{",".join([f"*{old}"] * 10)}]\n'
    for old, new in zip('abcdefg', 'bcdefgh', strict=True)
)


@pytest.mark.parametrize(
    ('content', 'message'),
    [
        ('data: &d [*d, *d]', 'nested too deeply'),
        ('[' * 20000, 'nested too deeply'),
        (BOMB, 'too large'),
        ('a: ' + 'x' * 2**21, 'too large'),
        ('a: 2001-99-99', 'not a YAML file'),
        ('a: \x00', 'not a YAML file'),
    ],
)
def test_yaml_that_would_take_for_ever(tmp_path, content, message):
    path = tmp_path / 'file.yaml'
    path.write_text(content)
    with pytest.raises(YamlError, match=message) as caught:
        read_yaml(path)
    assert str(path) in str(caught.value) and '\n' not in str(caught.value)


def test_aliases_may_be_used(tmp_path):
    (tmp_path / 'file.yaml').write_text('a: &a [1, 2]\nb: *a')
    assert read_yaml(tmp_path / 'file.yaml') == {'a': [1, 2], 'b': [1, 2]}


def test_pipes_are_not_waited_for(tmp_path, monkeypatch, run):
    monkeypatch.chdir(tmp_path)
    os.mkfifo('pipe')
    write_camera(tmp_path / 'camera.yaml', Camera(4, 3, 5.0, 5.0, 1.5, 1.0))
    for image, camera in (('pipe', 'camera.yaml'), ('camera.yaml', 'pipe'), ('x', '/dev/zero')):
        (tmp_path / 'x').touch()
        code, _, error = run('segment', image, '--camera', camera, '--output', 'out')
        assert code == 2 and 'not a regular file' in error and error.count('\n') == 1
    for read in (read_yaml, read_depth):
        with pytest.raises(ValueError, match='not a regular file'):
            read(tmp_path / 'pipe')


@pytest.mark.parametrize(
    'content',
    [
        '/*: {ros__parameters: {min_pixels: 7}}',
        '/robot/*: {ros__parameters: {min_pixels: 7}}',
        'robot: {segment_planes: {ros__parameters: {min_pixels: 7}}}',
        '/robot: {front: {segment_planes: {ros__parameters: {min_pixels: 7}}}, other: '
        '{ros__parameters: {x: 1}}}',
        '/**/segment_planes: {ros__parameters: {min_pixels: 7}}',
    ],
)
def test_sections_of_any_namespace(tmp_path, content):
    (tmp_path / 'file.yaml').write_text(content)
    assert read_config(tmp_path / 'file.yaml') == Config(min_pixels=7)


def test_a_shared_file_may_name_parameters_of_other_nodes(tmp_path):
    path = tmp_path / 'file.yaml'
    path.write_text('/**: {ros__parameters: {min_pixels: 7, exposure: 3, use_sim_time: true}}')
    with pytest.warns(UserWarning, match='left out exposure'):
        assert read_config(path) == Config(min_pixels=7)


@pytest.mark.parametrize(
    ('content', 'message'),
    [
        ('segment_planes: {ros__parameters: [1, 2]}', 'no mapping'),
        ('segment_planes: {ros__parameters: "ab"}', 'no mapping'),
        ('segment_planes: 3\nother: {ros__parameters: {}}', 'no section'),
        ('min_pixels: 3\nsegment_planes: {ros__parameters: {}}', 'no section'),
        ('noise: 1' + '0' * 400, 'noise must be in'),
        ('min_pixels: 1' + '0' * 400, 'min_pixels must be in'),
    ],
)
def test_bad_sections_and_numbers(tmp_path, content, message):
    path = tmp_path / 'file.yaml'
    path.write_text(content)
    with pytest.raises(ConfigError, match=message) as caught:
        read_config(path)
    assert str(path) in str(caught.value) and len(str(caught.value)) < 200 + len(str(path))


def test_numbers_of_numpy_are_taken():
    config = Config(noise=np.float32(0.5), min_pixels=np.int64(7), exact=np.bool_(True))
    assert config == Config(noise=0.5, min_pixels=7, exact=True)
    kinds = [type(getattr(config, name)) for name in ('noise', 'min_pixels', 'exact')]
    assert kinds == [float, int, bool]
    with pytest.raises(ConfigError, match='type int'):
        Config(min_pixels=np.float64(7.0))


def png(width, height, data, bits=16):
    def part(name, content):
        crc = struct.pack('>I', zlib.crc32(name + content))
        return struct.pack('>I', len(content)) + name + content + crc

    header = struct.pack('>IIBBBBB', width, height, bits, 0, 0, 0, 0)
    return b'\x89PNG\r\n\x1a\n' + part(b'IHDR', header) + part(b'IDAT', data) + part(b'IEND', b'')


def test_sizes_are_checked_before_images_are_decoded(tmp_path, monkeypatch):
    (tmp_path / 'large.png').write_bytes(png(20000, 20000, zlib.compress(bytes(8 * 10**6))))
    cv2.imwrite(str(tmp_path / 'large.tiff'), np.zeros((300, 400), np.uint16))
    monkeypatch.setattr(cv2, 'imdecode', None)
    for name, size in (('large.png', '20000x20000'), ('large.tiff', '400x300')):
        with pytest.raises(ImageFileError, match=f'is {size}, its camera 64x48'):
            read_depth(tmp_path / name, (48, 64))


def test_damaged_images_are_one_line(tmp_path, capfd):
    write_image(
        tmp_path / 'a.png', np.random.default_rng(0).integers(0, 9999, (48, 64)).astype('u2')
    )
    whole = (tmp_path / 'a.png').read_bytes()
    random = np.random.default_rng(1)
    for number in range(60):
        data = bytearray(whole)
        data[random.integers(len(data))] ^= 1 << int(random.integers(8))
        (tmp_path / 'b.png').write_bytes(
            data if number % 2 else data[: random.integers(len(data))]
        )
        with pytest.raises(ImageFileError):
            read_depth(tmp_path / 'b.png')
    assert capfd.readouterr().err == ''


@pytest.mark.parametrize('suffix', ['.bmp', '.pfm'])
def test_other_formats_are_refused(tmp_path, suffix):
    kind = np.float32 if suffix == '.pfm' else np.uint8
    image = np.ones((8, 8), kind)
    cv2.imwrite(str(tmp_path / f'a{suffix}'), image)
    with pytest.raises(ImageFileError, match='PNG or TIFF'):
        read_depth(tmp_path / f'a{suffix}')


def test_of_several_pages_the_first_is_read_with_a_word(tmp_path):
    pages = [np.full((3, 4), number, np.uint16) for number in (1, 2, 3)]
    cv2.imwritemulti(str(tmp_path / 'a.tiff'), pages)
    with pytest.warns(UserWarning, match='first of 3 pages'):
        image = read_depth(tmp_path / 'a.tiff')
    assert (image == 1).all()


@pytest.mark.parametrize(
    'change',
    [
        ('WIDTH 2', 'WIDTH 1000000000', 'HEIGHT 1', 'HEIGHT 1000000'),
        ('COUNT 1 1 1', 'COUNT 1 1 99999999999'),
        ('COUNT 1 1 1', 'COUNT 1 1 ' + '9' * 5000),
    ],
)
def test_clouds_that_promise_too_much(tmp_path, change):
    text = (
        'FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2\nHEIGHT 1\nDATA ascii\n'
        '1 2 3\n4 5 6\n'
    )
    path = tmp_path / 'a.pcd'
    path.write_text(text)
    assert read_pcd(path)['x'].tolist() == [[1, 4]]
    for old, new in zip(change[::2], change[1::2], strict=True):
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)
    with pytest.raises(PcdError) as caught:
        read_pcd(path)
    assert str(path) in str(caught.value)


def test_options_take_no_nan(tmp_path, monkeypatch, run):
    monkeypatch.chdir(tmp_path)
    write_camera(tmp_path / 'camera.yaml', Camera(64, 48, 50.0, 50.0, 31.5, 23.5))
    for name in '12':
        write_image(tmp_path / 'depth' / f'{name}.png', np.ones((48, 64), np.uint16))
    for option, values in (
        ('--depth-scale', ('nan', 'inf', '1e300', '0')),
        ('--rate', ('nan', 'inf', '1e-12', '0', '1e300')),
    ):
        for value in values:
            arguments = ('--camera', 'camera.yaml', '--output', 'bag', option, value)
            code, _, error = run('pack', 'depth', *arguments)
            assert code == 2 and error.count('\n') == 1 and not (tmp_path / 'bag').exists()


def test_errors_are_one_line_of_printable_characters():
    assert one_line(ValueError('a\nb\x00\x1b[31m')) == 'a\\nb\\x00\\x1b[31m'
    assert one_line(MemoryError()) == 'not enough memory'
    assert one_line(FileNotFoundError(2, 'No such file', 'x')) == 'x: No such file'
