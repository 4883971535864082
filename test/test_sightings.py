"""What rays say of places where something is known to be."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from scipy.spatial.transform import Rotation

from rangeseg_ros.core.mapping.observations import PlaneSet
from rangeseg_ros.core.mapping.plane_grid import (
    HIT,
    PlaneGrid,
    may_be_in_sight,
    passed_through,
    seen_cells,
)
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel
from rangeseg_ros.core.tracking.plane_errors import tangents

CAMERA = Camera(40, 30, 35.0, 38.0, 17.0, 16.0)
BODY = replace(CAMERA, turn=(-0.5, 0.5, -0.5, 0.5))  # x forward, y to the left, z up
SENSOR = SensorModel(0.001, 0, 1.0, 0, 0, 0, 35)


def passed(points, image):
    """Which of points are seen through, each on a plane that faces the camera."""
    distance = np.linalg.norm(points, axis=1)
    return passed_through(points, distance, lambda k: np.full(len(k), 1e-4), image, SENSOR)


def test_whatever_rays_tell_of_lies_in_spheres_that_may_be_in_sight():
    random = np.random.default_rng(1)
    image = RangeImage.from_depth(np.full(CAMERA.shape, 8.0), CAMERA)
    centres = random.normal(0, 2, (4000, 3))
    radii = random.exponential(0.5, 4000)
    within = random.normal(size=(4000, 3))
    within *= (radii * random.random(4000) / np.linalg.norm(within, axis=1))[:, None]
    found = passed(centres + within, image)
    shown = may_be_in_sight(centres, radii, CAMERA)
    assert np.count_nonzero(found) > 200
    assert shown[found].all()
    # What is behind the camera or far to its sides is not.
    aside = np.array([[0, 0, -2.0], [9, 0, 2], [0, -9, 2]])
    assert not may_be_in_sight(aside, np.ones(3), CAMERA).any()


def test_rays_pass_through_what_is_before_their_ends_in_any_frame_of_the_camera():
    random = np.random.default_rng(2)
    np.testing.assert_allclose(BODY.axes @ [0, 0, 1], [1, 0, 0], atol=1e-12)
    depth = random.uniform(1, 3, CAMERA.shape)
    v, u = random.integers(0, CAMERA.shape, (2000, 2)).T
    truth = random.uniform(0.5, 4, 2000)
    points = CAMERA.rays[v, u] * truth[:, None]
    for turn, camera in ((np.eye(3), CAMERA), (BODY.axes, BODY)):
        found = passed(points @ turn.T, RangeImage.from_depth(depth, camera))
        clear = np.abs(truth - depth[v, u]) > 0.1
        np.testing.assert_array_equal(found[clear], (truth < depth[v, u])[clear])


def test_cells_are_seen_where_pixels_of_the_plane_look_at_them():
    random = np.random.default_rng(3)
    labels = random.integers(1, 4, CAMERA.shape).astype(np.uint16)
    grid = PlaneGrid(0.07)
    grid.add(grid.fill([[np.array([[-3.0, -2], [3, -2], [3, 2], [-3, 2]])]]), HIT)
    normal = Rotation.from_rotvec([0.4, -0.3, 0.2]).apply([[0, 0, -1]])
    known = PlaneSet(normal, np.array([[0.2, 0.1, 2.5]]), tangents(normal))
    # As the frame found it, and where that lies over the cells.
    off = Rotation.from_rotvec([0.02, 0.01, 0]).apply(normal[0])
    points = known.points(grid.centres())
    points -= (points @ off + 2.4)[:, None] * off
    x, y, z = points.T
    column = np.rint(CAMERA.fx * x / z + CAMERA.cx).astype(int)
    row = np.rint(CAMERA.fy * y / z + CAMERA.cy).astype(int)
    inside = (row >= 0) & (column >= 0) & (row < CAMERA.height) & (column < CAMERA.width)
    truth = np.where(inside, labels[row * inside, column * inside], 0)
    for turn, camera in ((np.eye(3), CAMERA), (BODY.axes, BODY)):
        seen = SimpleNamespace(normal=turn @ off, distance=2.4, label=2)
        moved = known.moved(Transform(turn, np.zeros(3)))
        found = seen_cells(grid, moved, seen, labels, camera)[grid.odds > 0]
        # Of some, the border of a pixel looks at the centre.
        assert (found == (truth == 2))[z > 0.1].mean() > 0.98
