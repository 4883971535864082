"""Intrinsics from every source, lenses against OpenCV, planes behind them, what is refused."""

import pickle
from dataclasses import astuple

import cv2
import numpy as np
import pytest

from rangeseg_ros import (
    Camera,
    CameraError,
    Config,
    RangeImage,
    Segmenter,
    camera_from_calibration,
    camera_from_matrices,
)
from rangeseg_ros.core.sensing.camera import CameraWarning
from rangeseg_ros.core.sensing.lens import _lens, undistort
from rangeseg_ros.io.cameras import read_camera, write_camera

K = [[500, 0, 320], [0, 510, 240], [0, 0, 1]]
P = [[450, 0, 310, 0], [0, 460, 235, 0], [0, 0, 1, 0]]
WHOLE = {'image_width': 640, 'image_height': 480, 'camera_matrix': {'data': np.ravel(K).tolist()}}


def test_pickles_leave_the_rays_behind():
    camera = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
    rays, pickled = camera.rays, pickle.dumps(camera)
    copy = pickle.loads(pickled)
    assert copy == camera and len(pickled) < 1000 and not copy.rays.flags.writeable
    np.testing.assert_array_equal(copy.rays, rays)


def test_numbers_of_numpy_are_numbers():
    camera = Camera(np.int64(4), np.uint16(3), np.float32(2), np.float64(3), np.int8(1), 1)
    assert camera == Camera(4, 3, 2.0, 3.0, 1.0, 1.0)
    assert [type(value) for value in astuple(camera)[:6]] == 2 * [int] + 4 * [float]


def test_projection_matrix_wins_when_rectified():
    rectified = camera_from_calibration({**WHOLE, 'projection_matrix': {'data': P}})
    assert rectified == Camera(640, 480, 450, 460, 310, 235)
    for calibration in (WHOLE, {**WHOLE, 'projection_matrix': None}):
        assert camera_from_calibration(calibration).fx == 500


@pytest.mark.parametrize('region', [(0, 0, 640, 480), (100, 52, 320, 200)])
def test_binned_regions_have_the_rays_of_the_pixels_they_collect(region):
    left, top, width, height = region
    binned = camera_from_matrices(640, 480, K, None, (2, 4), region)
    assert binned.shape == (height / 4, width / 2)
    block = camera_from_matrices(640, 480, K).rays[top + 4 : top + 8, left + 6 : left + 8]
    np.testing.assert_allclose(binned.rays[1, 3], block.mean(axis=(0, 1)), atol=1e-6)


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'width': 0}, 'size'),
        ({'fx': 0.0}, 'fx'),
        ({'fy': -1.0}, 'fy'),
        ({'cy': np.inf}, 'cy'),
        ({'width': 640.7}, 'width must be a positive whole number'),
        ({'height': True}, 'height'),
        ({'width': 10**400}, 'width'),
        ({'fx': 10**400}, 'fx'),
        ({'fx': '500'}, 'fx'),
        ({'fx': 1e-300}, 'do not fit 4x3 pixels'),
        ({'cx': 1e300}, 'do not fit'),
        ({'skew': np.nan}, 'skew'),
        ({'turn': None}, 'turn'),
    ],
)
def test_impossible_intrinsics(change, message):
    values = {'width': 4, 'height': 3, 'fx': 1.0, 'fy': 1.0, 'cx': 0.0, 'cy': 0.0, **change}
    with pytest.raises(CameraError, match=message):
        Camera(**values)


@pytest.mark.parametrize(
    ('calibration', 'message'),
    [
        ({}, 'image_width'),
        ({'image_width': 4, 'image_height': 3}, 'camera_matrix'),
        ({'image_width': 4, 'image_height': 3, 'camera_matrix': {'data': [1, 2]}}, '9 values'),
        ({**WHOLE, 'image_width': 640.7}, 'width'),
        ({**WHOLE, 'projection_matrix': 5}, 'malformed'),
        ({**WHOLE, 'projection_matrix': {}}, 'data'),
        ({**WHOLE, 'projection_matrix': {'data': ['a'] * 12}}, 'must be numbers'),
        ({**WHOLE, 'camera_matrix': {'data': np.transpose(K).ravel()}}, 'row by row'),
        ({**WHOLE, 'camera_matrix': {'data': [10**400] * 9}}, 'must be numbers'),
        ({**WHOLE, 'distortion_model': 5}, 'distortion_model'),
        ({**WHOLE, 'distortion_coefficients': {'data': 'abc'}}, 'must be numbers'),
        ({**WHOLE, 'distortion_coefficients': {'data': [0.1] * 5}}, 'unknown distortion model'),
        ([], 'malformed'),
    ],
)
def test_malformed_calibrations(calibration, message):
    with pytest.raises(CameraError, match=message):
        camera_from_calibration(calibration)


def lens(model, *d, **changes):
    return Camera(320, 240, 300, 310, 159.5, 119.5, distortion_model=model, d=d, **changes)


@pytest.mark.parametrize('k1', [-0.1, -0.3])
def test_barrel_of_one_coefficient_ends_where_it_turns_back(k1):
    radii, scale = np.linspace(0, 0.8, 81), np.sqrt(-3 * k1)
    radii = radii[np.abs(radii - 2 / 3 / scale) > 0.02]  # where they do not touch the turn
    with np.errstate(invalid='ignore'):
        expected = 2 / scale * np.sin(np.arcsin(1.5 * radii * scale) / 3)
    found = undistort(0.6 * radii, 0.8 * radii, 'plumb_bob', (k1, 0, 0, 0, 0))
    np.testing.assert_allclose(found, [0.6 * expected, 0.8 * expected], 1e-9)
    assert np.isnan(expected).any() == (k1 == -0.3)


LENSES = [
    ('plumb_bob', (-0.28, 0.07, 0.002, -0.001, -0.01)),
    ('rational_polynomial', (0.5, -2.6, 0.0006, -0.0002, 1.5, 0.4, -2.4, 1.4)),
    ('rational_polynomial', (0.1, -0.2, 0.01, -0.02, 0.05, 0.02, 0, 0, 0.01, -0.03, 0.02, 0.04)),
    ('equidistant', (0.1, -0.05, 0.02, -0.01)),
]


@pytest.mark.parametrize(('model', 'd'), [('', ()), *LENSES])
def test_opencv_sees_the_rays_at_their_pixels(tmp_path, model, d):
    camera = lens(model, *d, skew=3.0)
    write_camera(tmp_path / 'camera.yaml', camera)
    assert read_camera(tmp_path / 'camera.yaml') == camera
    rays = camera.rays.reshape(-1, 3).astype(np.float64)
    assert (rays[:, 2] == 1).all() and camera.rays.dtype == np.float32
    if model == 'equidistant':
        points = cv2.fisheye.distortPoints(rays[None, :, :2], np.eye(3), np.array(d))[0]
    else:
        zero = np.zeros(3)
        points = cv2.projectPoints(rays, zero, zero, np.eye(3), np.array(d))[0][:, 0]
    columns, rows = camera.matrix[:2] @ np.column_stack([points, np.ones(len(points))]).T
    np.testing.assert_allclose([rows, columns], np.indices((240, 320)).reshape(2, -1), atol=1e-4)


@pytest.mark.parametrize(('model', 'd'), LENSES)
def test_derivatives_of_a_lens_are_its_differences(model, d):
    draw = np.random.default_rng(0).normal(size=(4, 50))
    # Of angles, which are real, or of places.
    z, step = (draw[:2] + 1j * (model != 'equidistant') * draw[2:]) * [[0.3], [1e-6]]
    lens = _lens(model, d)
    _, along, across = lens(z)
    difference = (lens(z + step)[0] - lens(z - step)[0]) / 2
    np.testing.assert_allclose(difference, along * step + across * np.conj(step), rtol=1e-5)


@pytest.mark.parametrize(('model', 'd'), [LENSES[0], LENSES[-1]])
@pytest.mark.parametrize('method', ['planes', 'normals'])
def test_planes_behind_a_lens(model, d, method):
    camera, normal, distance = lens(model, *d), np.array([0.3, -0.5, -0.8]), 2.0
    normal /= np.linalg.norm(normal)
    image = RangeImage.from_depth(-distance / (camera.rays.astype(np.float64) @ normal), camera)
    (plane,) = Segmenter(Config(method=method)).segment(image).planes
    assert plane.normal @ normal > 1 - 1e-8 and plane.distance == pytest.approx(distance, abs=1e-4)
    # The outline is half a pixel wider than the centres of the pixels.
    points = image.points.reshape(-1, 3)
    for end in (np.min, np.max):
        np.testing.assert_allclose(end(plane.hull, axis=0), end(points, axis=0), atol=0.05)
    assert (np.ptp(plane.hull, axis=0) > np.ptp(points, axis=0)).all()


@pytest.mark.filterwarnings('error')
def test_what_is_rectified_and_what_is_raw():
    k = [[300, 0, 159.5], [0, 310, 119.5], [0, 0, 1]]
    p, d = [[290, 0, 160, 0], [0, 290, 120, 0], [0, 0, 1, 0]], (-0.3, 0.1, 0, 0, 0)
    rectified, raw = Camera(320, 240, 290, 290, 160, 120), lens('plumb_bob', *d)

    def camera(p, raw=None, d=d):
        return camera_from_matrices(320, 240, k, p, distortion_model='plumb_bob', d=d, raw=raw)

    for choice in (None, False):
        with pytest.warns(CameraWarning, match='D beside P'):
            assert camera(p, choice) == rectified
    assert camera(p, True) == raw
    assert camera(None) == camera(np.zeros(12)) == camera(None, True) == raw
    assert camera(None, False, np.zeros(5)) == lens('')
    assert camera(p, d=np.zeros(5)) == camera(p, d=()) == rectified
    with pytest.raises(CameraError, match='no P'):
        camera(None, False)
    for broken in (np.nan, -290.0, 0.0):
        with pytest.raises(CameraError, match=r'fx must be (finite|positive)'):
            camera([[broken, *p[0][1:]], *p[1:]], d=())


def test_lenses_that_distort_nothing_are_none():
    flat = lens('')
    assert lens('plumb_bob', 0, 0, 0, 0, 0) == lens('rational_polynomial') == lens('none') == flat
    assert lens('plumb_bob', 0.1, 0, 0, 0, 0, 0, 0, 0) == lens('plumb_bob', 0.1, 0, 0, 0, 0)
    assert lens('equidistant') != flat


@pytest.mark.parametrize(
    ('model', 'd', 'message'),
    [
        ('fov', (0.9,), 'unknown distortion model'),
        ('fov', (), 'unknown distortion model'),
        ('', (0.1, 0, 0, 0), 'unknown distortion model'),
        ('plumb_bob', (0.1,), '4 or 5'),
        ('plumb_bob', (0.1, 0, 0, 0, 0, 0.2), '4 or 5'),
        ('equidistant', (0.1, 0), '4 coefficients'),
        ('plumb_bob', (np.nan, 0, 0, 0), 'finite'),
        ('rational_polynomial', (*[0] * 12, 0.1, 0), 'tilted'),
        (None, (), 'distort|lower'),
        ('plumb_bob', ('a',), 'convert'),
    ],
)
def test_unknown_lenses_are_refused(model, d, message):
    with pytest.raises(CameraError, match=message):
        lens(model, *d)


@pytest.mark.parametrize('model', ['plumb_bob', 'rational_polynomial', 'equidistant'])
@pytest.mark.parametrize('value', [1e300, -1e300, -1e6])
def test_coefficients_that_no_lens_has_are_refused(model, value):
    with pytest.raises(CameraError, match='fits no lens'):
        lens(model, value, 0.0, 0.0, 0.0)


@pytest.mark.filterwarnings('error')
def test_a_lens_that_folds_the_image_is_told():
    with pytest.warns(CameraWarning, match=r'folds the image: .*% of it is left out'):
        folded = lens('plumb_bob', -0.8, 0.0, 0.0, 0.0)
    assert np.isfinite(folded.rays).all()
    image = RangeImage.from_depth(np.full(folded.shape, 1000, np.uint16), folded)
    assert image.valid[120, 160] and not image.valid[0, 0]
    np.testing.assert_array_equal(image.valid, folded.rays.any(axis=2))
    for model, k1 in (('plumb_bob', -0.2), ('equidistant', 0.0)):
        lens(model, k1, 0.0, 0.0, 0.0)


def test_rays_are_left_out_where_none_is_found_beside_the_fold():
    model, d, seen = 'plumb_bob', (-0.68, -0.07, 0.01, 0.02, 0.19), np.mgrid[-1:1:41j, -1:1:41j]
    x, y = undistort(*seen, model, d)
    shown = _lens(model, d)(x + 1j * y)[0][np.isfinite(x)]
    assert 400 < shown.size < 1681
    np.testing.assert_allclose([shown.real, shown.imag], seen[:, np.isfinite(x)], atol=1e-7)
