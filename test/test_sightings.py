"""What rays say of places where something is known to be."""

from dataclasses import replace

import numpy as np

from rangeseg_ros.core.mapping.visibility import may_be_in_sight, ray_evidence
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel

CAMERA = Camera(40, 30, 35.0, 38.0, 17.0, 16.0)
SENSOR = SensorModel(0.001, 0, 1.0, 0, 0, 0, 35)


def test_whatever_rays_tell_of_lies_in_spheres_that_may_be_in_sight():
    random = np.random.default_rng(1)
    image = RangeImage.from_depth(np.full(CAMERA.shape, 8.0), CAMERA)
    centres = random.normal(0, 2, (4000, 3))
    radii = random.exponential(0.5, 4000)
    within = random.normal(size=(4000, 3))
    within *= (radii * random.random(4000) / np.linalg.norm(within, axis=1))[:, None]
    points = centres + within
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    found = ray_evidence(points, normals, np.full(4000, 1e-4), image, SENSOR)
    shown = may_be_in_sight(centres, radii, image)
    assert np.count_nonzero(found) > 200
    assert shown[found != 0].all()
    # What is behind the camera or far to its sides is not.
    assert not may_be_in_sight(
        np.array([[0, 0, -2.0], [9, 0, 2], [0, -9, 2]]), np.ones(3), image
    ).any()


def test_sightings_are_the_same_in_any_frame_of_the_camera():
    random = np.random.default_rng(2)
    body = replace(CAMERA, turn=(-0.5, 0.5, -0.5, 0.5))  # x forward, y to the left, z up
    np.testing.assert_allclose(body.axes @ [0, 0, 1], [1, 0, 0], atol=1e-12)
    depth = random.uniform(1, 3, CAMERA.shape)
    points = random.normal((0, 0, 2), 1, (2000, 3))
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    found = [
        ray_evidence(
            points @ turn.T,
            normals @ turn.T,
            np.full(2000, 1e-4),
            RangeImage.from_depth(depth, camera),
            SENSOR,
        )
        for turn, camera in ((np.eye(3), CAMERA), (body.axes, body))
    ]
    assert len(np.unique(found[0])) == 3
    np.testing.assert_array_equal(*found)
