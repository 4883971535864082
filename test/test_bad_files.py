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
from rangeseg_ros.io.files import FileError
from rangeseg_ros.io.images import read_depth, write_image
from rangeseg_ros.io.params import read_config
from rangeseg_ros.io.yaml_files import read_yaml


def grown(part, whole):
    """A small file whose aliases stand for millions of nodes."""
    lines = [f'a{k}: &a{k} ' + whole.format(9 * part.format(f'*a{k - 1}')) for k in range(1, 9)]
    return '\n'.join(['a0: &a0 {y: 1}', *lines])


def test_aliases_are_read(tmp_path):
    path = tmp_path / 'file.yaml'
    path.write_text('a: &a {x: 1, y: 2}\nb: {<<: *a, y: 3}\nc: [*a, *a]')
    a = {'x': 1, 'y': 2}
    assert read_yaml(path) == {'a': a, 'b': {'x': 1, 'y': 3}, 'c': [a, a]}


@pytest.mark.parametrize(
    ('content', 'message'),
    [
        ('[' * 20000, 'nested too deeply'),
        ('a: ' + 'x' * 2**21, 'too large'),
        ('a: 2001-99-99', 'not a YAML file'),
        ('a: \x00', 'not a YAML file'),
        (grown('{}, ', '{{x: [{}]}}'), 'too often'),
        (grown('{}, ', '{{<<: [{}]}}'), 'too often'),
        (
            f'a: &a {{{"".join(f"{k}: 1, " for k in range(3000))}}}\nb: [{"*a, " * 9000}]',
            'too often',
        ),
    ],
)
def test_yaml_that_would_take_for_ever(tmp_path, content, message):
    path = tmp_path / 'file.yaml'
    path.write_text(content)
    with pytest.raises(FileError, match=message) as caught:
        read_yaml(path)
    assert str(path) in str(caught.value) and '\n' not in str(caught.value)


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


def test_a_shared_file_may_name_parameters_of_other_nodes(tmp_path):
    path = tmp_path / 'file.yaml'
    path.write_text('/**: {ros__parameters: {min_pixels: 7, exposure: 3, use_sim_time: true}}')
    with pytest.warns(UserWarning, match='left out exposure'):
        assert read_config(path) == Config(min_pixels=7)


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
    (tmp_path / 'large.png').write_bytes(png(9000, 9000, zlib.compress(bytes(10**6))))
    cv2.imwrite(str(tmp_path / 'large.tiff'), np.zeros((300, 400), np.uint16))
    monkeypatch.setattr(cv2, 'imdecode', None)
    for name, size in (('large.png', '9000x9000'), ('large.tiff', '400x300')):
        with pytest.raises(FileError, match=f'is {size}, its camera 64x48'):
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
        with pytest.raises(FileError):
            read_depth(tmp_path / 'b.png')
    assert capfd.readouterr().err == ''


def test_of_several_pages_the_first_is_read_with_a_word(tmp_path):
    pages = [np.full((3, 4), number, np.uint16) for number in (1, 2, 3)]
    cv2.imwritemulti(str(tmp_path / 'a.tiff'), pages)
    with pytest.warns(UserWarning, match='first of 3 pages'):
        image = read_depth(tmp_path / 'a.tiff')
    assert (image == 1).all()


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
