"""Files and geometry of the segcomp sets: round trips, malformed files, the published formulas."""

import numpy as np
import pytest
from dataset_files import raster

from rangeseg_ros import segcomp
from rangeseg_ros.segcomp import SegcompError


def perceptron_bytes(values):
    """A Perceptron image: ten lines, two bytes, and the values (512, 512), big-endian."""
    words = (2, 2, 3, 3, 3, 3, 4, 4, 3, 5)
    lines = b''.join(b' '.join([b'x'] * count) + b'\n' for count in words)
    return lines + bytes(2) + values.astype('>u4').tobytes()


BLANK = np.zeros((2, 2), np.uint8)
PERCEPTRON = perceptron_bytes(np.zeros((512, 512), np.uint32))
# Rows and columns of some pixels.
R, C = np.array([(0, 1), (511, 511), (0, 511), (100, 402), (255, 255)]).T


@pytest.mark.parametrize('label', range(13))
def test_labels_of_a_raster(tmp_path, label):
    path = tmp_path / 'a.ms-seg'
    path.write_bytes(raster(np.array([[0, label, 12]], np.uint8)))
    if 4 <= label <= 9:
        with pytest.raises(SegcompError, match=f'a.ms-seg: label {label}'):
            segcomp.read_segmentation(path)
    else:
        assert segcomp.read_segmentation(path).tolist() == [[0, max(label - 9, 0), 3]]


def test_normals_and_angles(tmp_path):
    (tmp_path / 'a.ms-nor').write_text('2\n10 0 0.6 -0.8\n12 1 0 0\n')
    (tmp_path / 'a.gt-ang').write_text('2\n10 11 90\n10 14 37.25\n')
    read = segcomp.read_normals(tmp_path / 'a.ms-nor')
    assert [(n, *normal) for n, normal in read.items()] == [(1, 0, 0.6, -0.8), (3, 1, 0, 0)]
    assert segcomp.read_angles(tmp_path / 'a.gt-ang') == [(1, 2, 90.0), (1, 5, 37.25)]


def test_perceptron_values_are_the_lower_12_bits(tmp_path):
    values = np.random.default_rng(1).integers(0, 2**32, (512, 512), np.uint32)
    (tmp_path / 'perc.test.0').write_bytes(perceptron_bytes(values))
    assert np.array_equal(segcomp.read_perceptron(tmp_path / 'perc.test.0'), values & 4095)


@pytest.mark.parametrize(
    ('read', 'data', 'fault'),
    [
        (segcomp.read_raster, b'', 'magic'),
        (segcomp.read_raster, raster(BLANK, magic=0x956AA659), 'magic'),
        (segcomp.read_raster, raster(BLANK)[:20], 'header has 20 of 32'),
        (segcomp.read_raster, raster(BLANK, depth=1), '1 bits'),
        (segcomp.read_raster, raster(BLANK, kind=2), 'type 2'),
        (segcomp.read_raster, raster(BLANK, width=0), 'size 0x2'),
        (segcomp.read_raster, raster(BLANK)[:-1], '3 of 4 pixels'),
        (segcomp.read_raster, raster(BLANK, colours=3), '1 of 4 pixels'),
        (segcomp.read_perceptron, PERCEPTRON[:-1], 'truncated'),
        (segcomp.read_perceptron, PERCEPTRON[:34], 'header line 7 must have 4 words'),
        (segcomp.read_perceptron, PERCEPTRON + b'x', 'oversized'),
        (segcomp.read_perceptron, b'extra ' + PERCEPTRON, 'header line 1 must have 2 words'),
        (segcomp.read_perceptron, b'', 'header line 1'),
        (segcomp.read_angles, b'', 'count'),
        (segcomp.read_angles, b'two\n', 'count'),
        (segcomp.read_normals, b'\xff\n', 'count'),
        (segcomp.read_angles, b'2 3\n', 'count'),
        (segcomp.read_angles, b'2\n10 11 90\n', '1 lines where the first announces 2'),
        *(
            (segcomp.read_angles, f'1\n{entry}\n'.encode(), 'malformed entry 1')
            for entry in ('10 11', '10 11.5 90', '10 11 ninety', '10 11 nan', '10 11 90 4')
        ),
        (segcomp.read_angles, b'1\n' + b'9' * 400 + b' 11 90\n', 'malformed entry 1'),
    ],
    ids=range(24),
)
def test_malformed_files(tmp_path, read, data, fault):
    path = tmp_path / 'bad'
    path.write_bytes(data)
    with pytest.raises(SegcompError, match=fault) as error:
        read(path)
    assert str(path) in str(error.value) and '\n' not in str(error.value)


@pytest.mark.parametrize(
    ('number', 'split', 'constants'),
    [
        (0, 'test', (785.410786, 0.773545, -1610.981722)),
        (29, 'test', (785.410786, 0.773545, -1610.981722)),
        (1, 'test', (771.016866, 0.791686, -1586.072821)),
        (0, 'train', (771.016866, 0.791686, -1586.072821)),
    ],
)
def test_abw_points_are_the_published_ones(number, split, constants):
    calibration = segcomp.abw_calibration(number, split)
    (offset, scale, f), aspect = constants, 1.4508
    v = np.array([1, 30, 130, 201, 255])
    x = (C - 255) * (v / scale + offset) / abs(f)
    y = (255 - R) / aspect * (v / scale + offset) / abs(f)
    z = (255 - v) / scale
    # The published z counts from range value 255 towards the sensor, whose centre is where
    # x = y = 0 for all pixels, so where v / scale + offset = 0.
    centre = 255 / scale + offset
    points = 1000 * calibration.camera.rays[R, C].astype(float) * calibration.depth(v)[:, None]
    assert points == pytest.approx(np.stack([x, -y, centre - z], axis=1), rel=1e-6)
    assert np.isnan(calibration.depth(0))


def test_perceptron_points_are_the_published_ones():
    values = np.random.default_rng(3).integers(0, 4096, (512, 512))
    h1, h2, delta, r0 = 3.0, 5.5, 0.20236, 830.3
    alpha, beta = np.radians(51.65 * (255.5 - C) / 512), np.radians(36.73 * (255.5 - R) / 512)
    dz = -h1 * (1 - np.cos(alpha)) / np.tan(np.pi / 4)
    dy = dz * np.tan(np.pi / 4 + beta / 2)
    dx = (h2 + dy) * np.tan(alpha)
    r1 = (dz - h2) / delta
    r3 = (values[R, C] + r0 - r1) * delta - np.sqrt(dx**2 + (h2 + dy) ** 2)
    x = dx + r3 * np.sin(alpha)
    y = dy + r3 * np.cos(alpha) * np.sin(beta)
    z = dz + r3 * np.cos(alpha) * np.cos(beta)
    found = 100 * segcomp.perceptron_points(values)[R, C]
    assert found == pytest.approx(np.stack([-x, -y, z], axis=1))
