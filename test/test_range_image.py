"""Depth images and organised clouds become rays, inverse range and validity."""

import numpy as np
import pytest

from rangeseg_ros import Camera, RangeImage
from rangeseg_ros.core.sensing.range_image import RangeImageError, UnitWarning

CAMERA = Camera(4, 3, 2.0, 3.0, 1.5, 1.0)


def test_what_is_no_measurement():
    depth = np.array([[0, -1, np.nan, np.inf], [-np.inf, 1, 2, 3], [1e-30, 1e30, 4, 5]])
    image, known = RangeImage.from_depth(depth, CAMERA), np.abs(depth - 3) <= 2
    np.testing.assert_array_equal(image.valid, known)
    assert np.isnan(image.points[~known]).all() and np.isfinite(image.inverse).all()
    points = CAMERA.rays[known] * depth[known, None]
    np.testing.assert_allclose(image.points[known], points, rtol=1e-6)
    # Wider integers may be farther than those of 16 bits.
    depth = np.array([[-5, 65535, 200000]], np.int32)
    inverse = RangeImage.from_depth(depth, Camera(3, 1, 300, 300, 1, 0), 0.0001).inverse
    np.testing.assert_allclose(inverse, [[0, 0, 1 / 20]])


@pytest.mark.parametrize('order', ['<', '>'])
@pytest.mark.parametrize('scale', [None, 1 / 5000])
def test_the_largest_of_16_bits_is_not_measured(order, scale):
    depth = np.full(CAMERA.shape, 65534, f'{order}u2')
    depth[1, 2] = 65535
    image = RangeImage.from_depth(depth, CAMERA, scale)
    assert np.argwhere(~image.valid).tolist() == [[1, 2]]
    np.testing.assert_allclose(image.points[0, 0, 2], 65534 * (scale or 0.001), rtol=1e-6)


@pytest.mark.parametrize('kind', ['<u2', '>u2', '<i2', '>i4', '<u4', '<f4', '>f4', '>f8', 'f2'])
def test_masks_and_byte_orders(kind):
    depth = np.arange(1000, 1012).reshape(CAMERA.shape).astype(kind)
    hidden = depth % 5 == 0
    image = RangeImage.from_depth(np.ma.masked_array(depth, hidden), CAMERA, 0.001)
    np.testing.assert_array_equal(image.valid, ~hidden)
    expected = depth[~hidden].astype(float) / 1000
    np.testing.assert_allclose(image.points[~hidden, 2], expected, rtol=1e-6)
    assert RangeImage.from_depth(np.ma.masked_array(depth), CAMERA, 0.001).valid.all()


@pytest.mark.filterwarnings('error')
def test_millimetres_that_are_said_to_be_metres_are_doubted():
    depth = np.full(CAMERA.shape, 1500.0, np.float32)
    half = np.where(np.arange(4) < 2, depth, 1.5)
    far = np.full((4, 5, 3), 100.0)
    far[:2] = 10.0
    for points in (far, 0 * far + 1e300, far * np.nan):
        RangeImage.from_points(points)
    RangeImage.from_depth(depth, CAMERA, 0.001)
    for measured in (half, np.full(CAMERA.shape, 65534, np.uint16), depth * np.nan):
        RangeImage.from_depth(measured, CAMERA)
    far[1, 0] = np.nan
    with pytest.warns(UnitWarning, match='metres'):
        RangeImage.from_points(far)
    half[0, 2:], half[1, 0] = (1500, np.nan), 0
    for far, scale in ((depth, None), (half, None), (depth.astype(np.uint16), 1.0)):
        with pytest.warns(UnitWarning, match='beyond 65.0 m: are they in metres'):
            RangeImage.from_depth(far, CAMERA, scale)
    with pytest.warns(UnitWarning, match='below 0.01 m'):
        RangeImage.from_depth(depth, CAMERA, 6e-6)


def test_clouds_keep_their_points():
    points = np.random.default_rng(1).normal(size=(5, 6, 3)) * 3
    points[2, 3], points[0, 0], points[1, 1, 2] = np.nan, 0, np.inf
    hidden = np.arange(90).reshape(points.shape) == 89  # a coordinate of the last one
    for given, missing in ((points, 3), (np.ma.masked_array(points, hidden), 4)):
        image = RangeImage.from_points(given)
        assert np.argwhere(~image.valid).tolist() == [[0, 0], [1, 1], [2, 3], [4, 5]][:missing]
    np.testing.assert_allclose(image.points[image.valid], points[image.valid], rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(image.rays[image.valid], axis=1), 1, rtol=1e-6)


@pytest.mark.parametrize(
    'camera',
    [
        Camera(160, 120, 131.0, 131.5, 79.5, 59.5),  # numbers of a data sheet
        Camera(212, 160, 178.8243, 179.2906, 105.819287, 79.129813),  # of a calibration
        Camera(16, 12, 14.0, 14.0, 7.25, 5.5),
    ],
)
@pytest.mark.parametrize('holes', ['none', 'random', 'columns', 'left'])
def test_the_cloud_of_a_pinhole_camera_is_its_depth_image(camera, holes):
    """Made in float32 as depth_image_proc does."""
    v, u = np.indices(camera.shape, np.float32)
    random, f = np.random.default_rng(3), np.float32
    z, few = random.uniform(0.4, 6, camera.shape).astype(f), random.random(camera.shape) < 0.3
    missing = {'none': u < 0, 'random': few, 'columns': u % 2 == 0, 'left': u < camera.width // 3}
    z[missing[holes]] = np.nan
    x = (u - f(camera.cx)) * z * f(1 / camera.fx)
    points = np.stack([x, (v - f(camera.cy)) * z * f(1 / camera.fy), z], axis=2)
    image = RangeImage.from_points(points)
    found, expected = image.camera, RangeImage.from_depth(z, camera)
    assert found.shape == camera.shape and image.pinhole
    np.testing.assert_allclose(found.matrix, camera.matrix, atol=2e-3)
    np.testing.assert_array_equal(image.inverse, expected.inverse)
    assert image.rays is RangeImage.from_points(points).rays


def test_dithering_adds_the_stated_noise_to_the_ranges():
    camera = Camera(200, 150, 100.0, 100.0, 99.5, 74.5)
    depth = np.full(camera.shape, 2.0)
    depth[:, :50] = 0
    plain = RangeImage.from_depth(depth, camera)
    image, again = (plain.dithered(0.01, seed=4) for _ in range(2))
    np.testing.assert_array_equal(image.valid, depth > 0)
    z = image.points[:, 50:, 2]
    assert z.mean() == pytest.approx(2.0, abs=5e-4) and z.std() == pytest.approx(0.01, rel=0.03)
    np.testing.assert_array_equal(image.inverse, again.inverse)


@pytest.mark.filterwarnings('error')
def test_eight_bits_have_no_unit_but_the_stated_one():
    depth = np.full((3, 4), 50, np.uint8)
    with pytest.warns(UnitWarning, match='no unit'):
        RangeImage.from_depth(depth, CAMERA)
    image = RangeImage.from_depth(depth, CAMERA, 10 / 255)
    np.testing.assert_allclose(image.points[..., 2], 500 / 255, rtol=1e-6)


@pytest.mark.parametrize(
    ('depth', 'scale', 'message'),
    [
        (np.zeros((3, 4, 1), np.uint16), None, r'\(H, W\), not \(3, 4, 1\)'),
        ([[1, 2], [3]], None, r'rows differ in length: \[\[1'),
        ('depth.png', None, r"\(H, W\), not 'depth.png'"),
        (np.zeros((3, 4), bool), None, 'floats, not bool'),
        (np.zeros((4, 4), np.uint16), None, '4x4'),
        (np.zeros((3, 4), np.uint16), 0.0, 'scale'),
        (np.zeros((3, 4), np.uint16), np.nan, 'scale'),
        (np.zeros((3, 4), np.uint16), 'mm', "number, not 'mm'"),
    ],
)
def test_refused_depth_images(depth, scale, message):
    with pytest.raises(RangeImageError, match=message):
        RangeImage.from_depth(depth, CAMERA, scale)


def test_refused_clouds():
    for shape, kind in (((3, 4), float), ((3, 4, 2), float), ((0, 0, 3), float), ((3, 4, 3), int)):
        with pytest.raises(RangeImageError, match='organised cloud'):
            RangeImage.from_points(np.zeros(shape, kind))
