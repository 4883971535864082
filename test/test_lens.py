"""Lens distortion: closed forms, OpenCV's own projection, and planes seen through a lens."""

import warnings

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rangeseg_ros import Camera, CameraError, Config, RangeImage, Segmenter
from rangeseg_ros.core.sensing.camera import CameraWarning
from rangeseg_ros.core.sensing.lens import undistort
from rangeseg_ros.messages.cameras import camera_from_matrices

K = [[300, 0, 159.5], [0, 310, 119.5], [0, 0, 1]]
P = [[290, 0, 160, 0], [0, 290, 120, 0], [0, 0, 1, 0]]
RADII = np.linspace(0, 0.8, 81)


def lens(model, *d, **changes):
    return Camera(320, 240, 300, 310, 159.5, 119.5, distortion_model=model, d=d, **changes)


def undistorted_radius(model, *d):
    """Radii of the points that appear at RADII, for lenses of radial distortion alone."""
    direction = np.array([0.6, 0.8])
    x, y = undistort(RADII * direction[0], RADII * direction[1], model, d)
    known = ~np.isnan(x)
    np.testing.assert_allclose(x[known] * direction[1], y[known] * direction[0], atol=1e-12)
    return np.where(known, np.hypot(x, y), np.nan)


@pytest.mark.parametrize('k1', [-0.1, -0.3])
def test_barrel_of_one_coefficient_ends_where_it_turns_back(k1):
    scale = np.sqrt(-3 * k1)
    with np.errstate(invalid='ignore'):
        expected = 2 / scale * np.sin(np.arcsin(1.5 * RADII * scale) / 3)
    found = undistorted_radius('plumb_bob', k1, 0, 0, 0, 0)
    clear = np.abs(RADII - 2 / 3 / scale) > 0.02  # where it does not touch the turn
    np.testing.assert_allclose(found[clear], expected[clear], 1e-9)
    assert np.isnan(found).any() == (k1 == -0.3)


@pytest.mark.parametrize(
    ('model', 'd'),
    [
        ('plumb_bob', (-0.28, 0.07, 0.002, -0.001, -0.01)),
        ('rational_polynomial', (0.5, -2.6, 0.0006, -0.0002, 1.5, 0.4, -2.4, 1.4)),
        (
            'rational_polynomial',
            (0.1, -0.2, 0.003, -0.002, 0.05, 0.02, 0, 0, 0.01, -0.02, 0.005, 0.003),
        ),
        ('equidistant', (0.1, -0.05, 0.02, -0.01)),
    ],
)
def test_opencv_sees_the_rays_at_their_pixels(model, d):
    camera = lens(model, *d, skew=3.0)
    rays = camera.rays.reshape(-1, 3).astype(np.float64)
    assert (rays[:, 2] == 1).all()
    if model == 'equidistant':
        points = cv2.fisheye.distortPoints(rays[None, :, :2], np.eye(3), np.array(d))[0]
    else:
        zero = np.zeros(3)
        points = cv2.projectPoints(rays, zero, zero, np.eye(3), np.array(d))[0][:, 0]
    columns, rows = camera.matrix[:2] @ np.column_stack([points, np.ones(len(points))]).T
    v, u = np.indices(camera.shape)
    np.testing.assert_allclose(columns, u.ravel(), atol=2e-4)
    np.testing.assert_allclose(rows, v.ravel(), atol=2e-4)


@pytest.mark.parametrize('model', ['plumb_bob', 'equidistant'])
@pytest.mark.parametrize('method', ['planes', 'normals'])
def test_planes_behind_a_lens(model, method):
    camera = lens(model, *((-0.3, 0.08, 0.001, 0.001, 0.0), (0.1, 0.0, 0.0, 0.0))[model[0] == 'e'])
    normal, distance = np.array([0.3, -0.5, -0.8]), 2.0
    normal /= np.linalg.norm(normal)
    depth = -distance / (camera.rays.astype(np.float64) @ normal)
    image = RangeImage.from_depth(depth, camera)
    (plane,) = Segmenter(Config(method=method)).segment(image).planes
    assert plane.normal @ normal > 1 - 1e-8
    assert plane.distance == pytest.approx(distance, abs=1e-4)
    # The outline is half a pixel wider than the centres of the pixels, and so is the rectangle.
    points = image.points.reshape(-1, 3)
    assert np.abs(plane.hull @ plane.normal + plane.distance).max() < 1e-6
    for end in (np.min, np.max):
        np.testing.assert_allclose(end(plane.hull, axis=0), end(points, axis=0), atol=0.05)
    offsets = (points - plane.centre) @ Rotation.from_quat(plane.orientation).as_matrix()
    np.testing.assert_allclose(np.ptp(offsets[:, :2], axis=0), plane.extents, atol=0.06)
    assert (plane.extents > np.ptp(offsets[:, :2], axis=0)).all()
    # A pinhole of the same matrix bends it: parts of it are planes at best, each off by more.
    bent = RangeImage.from_depth(depth, lens(''))
    planes = Segmenter(Config(method=method)).segment(bent).planes
    assert all(bent_plane.normal @ normal < 1 - 1e-6 for bent_plane in planes)
    assert len(planes) != 1 or planes[0].normal @ normal < 1 - 1e-4


def test_pixels_without_a_ray_are_not_measured():
    camera = lens('plumb_bob', -1.0, 0, 0, 0)
    image = RangeImage.from_depth(np.full(camera.shape, 1000, np.uint16), camera)
    assert image.valid[120, 160] and not image.valid[0, 0]
    assert np.isfinite(camera.rays).all()


def test_what_is_rectified_and_what_is_raw():
    d = (-0.3, 0.1, 0, 0, 0)
    rectified = Camera(320, 240, 290, 290, 160, 120)
    raw = lens('plumb_bob', *d)

    def camera(p, raw=None, d=d):
        return camera_from_matrices(320, 240, K, p, distortion_model='plumb_bob', d=d, raw=raw)

    for choice in (None, False):
        with pytest.warns(CameraWarning, match='D beside P'):
            assert camera(P, choice) == rectified
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        assert camera(P, True) == raw
        assert camera(None) == camera(np.zeros(12)) == camera(None, True) == raw
        assert camera(None, False, np.zeros(5)) == lens('')
        assert camera(P, d=np.zeros(5)) == camera(P, d=()) == rectified
        with pytest.raises(CameraError, match='no P'):
            camera(None, False)
    for broken in (np.nan, -290.0, 0.0):
        with pytest.raises(CameraError, match=r'fx must be (finite|positive)'):
            camera([[broken, *P[0][1:]], *P[1:]], d=())


def test_lenses_that_distort_nothing_are_none():
    assert (
        lens('plumb_bob', 0, 0, 0, 0, 0) == lens('rational_polynomial') == lens('none') == lens('')
    )
    assert lens('plumb_bob', 0.1, 0, 0, 0, 0, 0, 0, 0) == lens('plumb_bob', 0.1, 0, 0, 0, 0)
    assert lens('equidistant') != lens('')


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


def test_a_lens_that_folds_the_image_is_told():
    with pytest.warns(CameraWarning, match=r'folds the image: .*% of it is left out'):
        folded = lens('plumb_bob', -0.8, 0.0, 0.0, 0.0)
    assert not folded.rays.any(axis=2).all()
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        lens('plumb_bob', -0.2, 0.0, 0.0, 0.0)
        lens('equidistant', 0.0, 0.0, 0.0, 0.0)
