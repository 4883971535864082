"""Pinhole intrinsics from every source, and what is refused."""

import pickle

import numpy as np
import pytest

from rangeseg_ros import Camera, camera_from_calibration, camera_from_matrices
from rangeseg_ros.core.sensing.camera import CameraError

K = [[500, 0, 320], [0, 510, 240], [0, 0, 1]]
P = [[450, 0, 310, 0], [0, 460, 235, 0], [0, 0, 1, 0]]
WHOLE = {'image_width': 640, 'image_height': 480, 'camera_matrix': {'data': np.ravel(K).tolist()}}


def test_rays_project_back_to_their_pixels():
    camera = Camera(7, 5, 500.0, 510.0, 3.2, 1.9)
    assert camera.shape == (5, 7) and camera.rays.dtype == np.float32
    columns = camera.rays[..., 0] * 500 + 3.2
    rows = camera.rays[..., 1] * 510 + 1.9
    np.testing.assert_allclose(columns, np.tile(np.arange(7), (5, 1)), atol=1e-4)
    np.testing.assert_allclose(rows, np.tile(np.arange(5)[:, None], 7), atol=1e-4)
    assert (camera.rays[..., 2] == 1).all()


def test_pickles_leave_the_rays_behind():
    camera = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
    rays = camera.rays
    pickled = pickle.dumps(camera)
    assert len(pickled) < 1000
    copy = pickle.loads(pickled)
    assert copy == camera
    assert not copy.rays.flags.writeable
    np.testing.assert_array_equal(copy.rays, rays)


def test_numbers_of_numpy_are_numbers():
    values = np.int64(4), np.uint16(3), np.float32(2), np.float64(3), np.int8(1), 1
    camera = Camera(*values)
    assert camera == Camera(4, 3, 2.0, 3.0, 1.0, 1.0)
    assert {type(value) for value in (camera.width, camera.height)} == {int}
    assert {type(value) for value in (camera.fx, camera.fy, camera.cx, camera.cy)} == {float}


def test_projection_matrix_wins_when_rectified():
    rectified = Camera(640, 480, 450, 460, 310, 235)
    assert camera_from_matrices(640, 480, K, P) == rectified
    assert camera_from_calibration({**WHOLE, 'projection_matrix': {'data': P}}) == rectified
    assert camera_from_matrices(640, 480, K).fx == 500
    assert camera_from_matrices(640, 480, K, np.zeros(12)).fx == 500
    for calibration in (WHOLE, {**WHOLE, 'projection_matrix': None}):
        assert camera_from_calibration(calibration).fx == 500


def test_binning_keeps_the_rays_of_the_collected_pixels():
    full, binned = (
        camera_from_matrices(640, 480, K),
        camera_from_matrices(640, 480, K, None, (2, 4)),
    )
    assert binned.shape == (120, 320)
    block = full.rays[4:8, 6:8].reshape(-1, 3).mean(axis=0)
    np.testing.assert_allclose(binned.rays[1, 3], block, atol=1e-6)


def test_region_of_interest_moves_the_principal_point():
    full = camera_from_matrices(640, 480, K)
    part = camera_from_matrices(640, 480, K, None, (0, 0), (100, 50, 320, 200))
    assert part.shape == (200, 320)
    np.testing.assert_allclose(part.rays[10, 20], full.rays[60, 120], atol=1e-6)


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'width': 0}, 'size'),
        ({'fx': 0.0}, 'fx'),
        ({'fy': -1.0}, 'fy'),
        ({'fx': np.nan}, 'fx'),
        ({'cy': np.inf}, 'cy'),
        ({'width': 640.7}, 'width must be a positive whole number'),
        ({'width': '64'}, 'width'),
        ({'height': True}, 'height'),
        ({'width': 10**400}, 'width'),
        ({'width': np.inf}, 'width'),
        ({'fx': 10**400}, 'fx'),
        ({'fx': '500'}, 'fx'),
        ({'fx': 1e-300}, 'do not fit 4x3 pixels'),
        ({'cx': 1e300}, 'do not fit'),
        ({'skew': np.nan}, 'skew'),
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
        ({'image_width': 4, 'image_height': 3, 'camera_matrix': 5}, 'malformed'),
        ({**WHOLE, 'image_width': 640.7}, 'width'),
        ({**WHOLE, 'image_width': True}, 'width'),
        ({**WHOLE, 'image_width': np.inf}, 'width'),
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
