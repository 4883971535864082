"""What rays say of places where something is known to be."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rangeseg_ros import Camera, RangeImage, Transform
from rangeseg_ros.core.mapping.observations import PlaneSet
from rangeseg_ros.core.mapping.plane_grid import PlaneGrid, in_sight, passed_through, seen_cells
from rangeseg_ros.core.sensing.sensor import SensorModel
from rangeseg_ros.core.significance import HIT
from rangeseg_ros.core.tracking.plane_errors import tangents

CAMERA = Camera(40, 30, 35.0, 38.0, 17.0, 16.0)
BODY = replace(CAMERA, turn=(-0.5, 0.5, -0.5, 0.5))  # x forward, y to the left, z up
SENSOR = SensorModel(0.001, 0, 1.0, 0, 0, 0, 35)


def passed(points, image):
    """Which of points are seen through, each on a plane that faces the camera."""
    distance = np.linalg.norm(points, axis=1)
    return passed_through(points, distance, lambda k: np.full(len(k), 1e-4), image, SENSOR)


@pytest.mark.parametrize('camera', [CAMERA, BODY])
def test_whatever_a_camera_looks_at_is_in_the_part_in_sight(camera):
    random = np.random.default_rng(1)
    image = RangeImage.from_depth(random.uniform(1, 3, camera.shape), camera)
    normal = random.normal(size=(200, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    known = PlaneSet(normal, random.normal(0, 2, (200, 3)), tangents(normal))
    grids = [PlaneGrid(0.1) for _ in normal]
    for grid in grids:
        grid.extend_to(np.array([[-1.5, -1.0], [1.5, 2.0]]))
        grid.add(np.ones(grid.odds.shape, bool), HIT)
    shown = in_sight(grids, known, image)
    through = hidden = 0
    for k, grid in enumerate(grids):
        found = passed(known.where([k]).points(grid.centres()), image).reshape(grid.odds.shape)
        through += np.count_nonzero(found)
        if k not in shown:
            assert not found.any()
            continue
        # What is taken in there is in the whole as well.
        area = grid.area
        shown[k].add(np.ones(shown[k].odds.shape, bool), -2 * HIT)
        assert (grid.odds[found] < 0).all()
        assert area - grid.area == pytest.approx(0.01 * np.count_nonzero(grid.odds < 0))
        hidden += np.count_nonzero(grid.odds > 0)
    assert 0 < len(shown) < 200 and through > 1000 and hidden > 1000
    assert not in_sight(grids, known, RangeImage.from_depth(np.zeros(camera.shape), camera))


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
    labels = np.random.default_rng(3).integers(1, 4, CAMERA.shape).astype(np.uint16)
    grid = PlaneGrid(0.07)
    grid.add(grid.fill([[np.array([[-3.0, -2], [3, -2], [3, 2], [-3, 2]])]]), HIT)
    normal = Rotation.from_rotvec([0.4, -0.3, 0.2]).apply([[0, 0, -1]])
    known = PlaneSet(normal, np.array([[0.2, 0.1, 2.5]]), tangents(normal))
    # As the frame found it, and where that lies over the cells.
    off = Rotation.from_rotvec([0.02, 0.01, 0]).apply(normal[0])
    points = known.points(grid.centres())
    points -= (points @ off + 2.4)[:, None] * off
    pixels = np.rint(points @ CAMERA.matrix.T / points[:, 2:]).astype(int)[:, 1::-1]
    # Beside the image there are no labels.
    truth = np.pad(labels, 1)[tuple(np.clip(pixels + 1, 0, np.add(CAMERA.shape, 1)).T)]
    for turn, camera in ((np.eye(3), CAMERA), (BODY.axes, BODY)):
        seen = SimpleNamespace(normal=turn @ off, distance=2.4, label=2)
        moved = known.moved(Transform(turn, np.zeros(3)))
        found = seen_cells(grid, moved, seen, labels, camera)[grid.odds > 0]
        # Of some, the border of a pixel looks at the centre.
        assert (found == (truth == 2))[points[:, 2] > 0.1].mean() > 0.98
