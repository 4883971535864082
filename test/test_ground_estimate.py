"""The ground by what is stated and what is seen: where they agree, contradict, or do not tell."""

import numpy as np
import pytest
from scipy.stats import norm
from terrain_scenes import FLOOR, KINECT, drop_of, gap, scene, share, view

from rangeseg_ros import Camera, Config, RangeImage
from rangeseg_ros.core.ground.cells import DROP, GROUND, OBSTACLE
from rangeseg_ros.core.ground.estimate import HIGHEST_STEP, STEP_PRIOR, continued
from rangeseg_ros.core.ground.terrain import terrain_of
from rangeseg_ros.core.segmentation import STATED
from rangeseg_ros.simulation.sensors.kinect import Kinect
from rangeseg_ros.simulation.solids import box, prism
from rangeseg_ros.simulation.terrain.scene import Piece

SEEN = np.degrees(np.arctan2(240, KINECT.camera.fy))  # below the middle of the image
ABOVE = 0.8


def judged(pieces, pitch, height, seed=0, camera=ABOVE, yaw=0, config=None):
    """Terrain as the camera's true up has it, and the truth."""
    terrain = scene(*pieces, pitch=pitch, yaw=yaw, height=camera)
    image, frame = view(terrain, KINECT.camera, seed, Kinect(seed))
    known = (height, 0.015) if height else (0.0, 0.0)
    return terrain_of(image, STATED, terrain.up, known, config or Config()), frame


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('depth', [0.06, 0.08, 0.1, 0.12, 0.15])
def test_a_landing_whose_edge_is_out_of_view_is_no_ground(depth, seed):
    """The floor is hidden up to 1.5 m ahead, and ends before."""
    pitch = np.degrees(np.arctan2(ABOVE, 1.5)) - SEEN
    terrain, frame = judged(drop_of(depth, 0.9), pitch, ABOVE, seed=seed)
    assert share(terrain.classes, frame, DROP, GROUND) < 0.01 and not terrain.stand.found
    assert 'stated height is 0.80 m' in terrain.stand.reasons[0]


@pytest.mark.parametrize(('offset', 'sd'), [(0.0, 0.003), (0.02, 0.003), (0.02, 0.3)])
def test_the_ground_continued_errs_as_least_squares_say(offset, sd):
    random, steepest = np.random.default_rng(0), Config().steepest
    x, y = random.uniform((1, -1), (2, 1), (400, 2)).T
    h = offset + 0.03 * x - 0.01 * y + np.tile([0.002, -0.002], 200)
    seen = continued(np.stack([h, x, y]), np.full(400, sd**2), 0.01, Config())
    # As if four cells that err alike were one, and level to within half of the steepest slope.
    design = np.stack([np.ones(400), x, y], axis=1) / (2 * sd)
    design = np.concatenate([design, np.diag([1e-3, 2 / steepest, 2 / steepest])])
    plane = np.linalg.lstsq(design, np.append(h / (2 * sd), np.zeros(3)), rcond=None)[0]
    assert seen.plane == pytest.approx(plane, abs=1e-9)
    # What they are off it goes on, from the nearest hundredth of them on, over the longest way.
    start, off = np.sort(np.hypot(x, y))[4], h - 2 * sd * design[:400] @ plane
    bent = (1 + 2 * start / 3.2) * np.sqrt((off**2).mean())
    known = np.linalg.inv(design.T @ design)[0, 0]
    assert seen.error == pytest.approx(np.sqrt(0.01**2 + known + bent**2), rel=1e-6)
    a, step = seen.plane[0], Config().least_step
    same = (1 - STEP_PRIOR) * norm.pdf(a, scale=seen.error)
    tails = norm.sf(step, a, seen.error) + norm.cdf(-step, a, seen.error)
    other = STEP_PRIOR * tails / (2 * (HIGHEST_STEP - step))
    assert seen.confidence == pytest.approx(same / (same + other), rel=1e-9)


@pytest.mark.parametrize('error', [-0.5, -0.2, -0.1, 0.1, 0.2, 0.5, 1.0])
def test_a_wrong_height_is_named_and_nothing_is_ground(error):
    terrain, _ = judged(drop_of(0.1, 1.5), 30, ABOVE + error)
    assert not (terrain.classes == GROUND).any()
    told = f'the stated height is {ABOVE + error:.2f} m, the ground seen is 0.80 m below, '
    (why,) = terrain.stand.reasons
    sds = why.removeprefix(told).removesuffix(' sd: a step or ramp out of view, or a wrong height')
    # Of the stated height, 0.015 m, and of what is seen, a few millimetres.
    assert float(sds) == pytest.approx(abs(error) / 0.0166, abs=2)


@pytest.mark.parametrize('yaw', [-40, -20, 0])
def test_what_falls_to_the_side_by_20_degrees_is_no_ground(yaw):
    turn = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])  # from x, y to y, z of the world
    level = prism(np.array([(-0.2, -4), (8, -4), (8, 0), (-0.2, 0)]), 20, turn, (0, 0, 0))
    fall = -7.8 * np.tan(np.radians(20))
    side = prism(np.array([(-8, -9), (-0.2, -9), (-0.2, 0), (-8, fall)]), 20, turn, (0, 0, 0))
    terrain, frame = judged((Piece(level, GROUND), Piece(side, DROP, 1.0)), 28, ABOVE, yaw=yaw)
    assert share(terrain.classes, frame, DROP, GROUND) < 0.01
    assert yaw or share(terrain.classes, frame, GROUND, GROUND) > 0.97


@pytest.mark.parametrize(('most', 'wide', 'kept'), [(0.15, 1, 0), (0.5, 1, 0.97), (0.5, 0.2, 0)])
def test_ground_leads_over_gaps_that_the_robot_crosses(most, wide, kept):
    config = Config(ground_gap=most, robot_radius=wide)
    terrain, frame = judged(gap(1.2, 1.5, 1.0), 28, ABOVE, config=config)
    beyond = (frame.terrain == GROUND) & (frame.depth > 2100) & (frame.depth < 2600)
    assert beyond.sum() > 1000
    assert abs((terrain.classes[beyond] == GROUND).mean() - kept) < 0.03


def test_a_table_alone_is_no_floor():
    table = Piece(box((1.2, 1.2, 0.03), np.eye(3), (0.8, 0, 0.7)), OBSTACLE, 0.7)
    terrain, frame = judged((Piece(FLOOR, GROUND), table), 55, 0.0, camera=1.7)
    assert not (terrain.classes[frame.terrain == OBSTACLE] == GROUND).any()


@pytest.mark.parametrize('metres', [1e4, 1e6, 1e8])
def test_a_point_at_the_horizon_tells_no_height(metres):
    """Level with the camera, where errors of the inverse range are none of the height."""
    camera = Camera(2, 1, 1.0, 1.0, 1.0, 0.0)
    up = np.array([0.0, -1.0, 0.0])
    for beside in (0.0, 0.4 * metres, 0.8 * metres):
        image = RangeImage.from_depth(np.array([[metres, beside]], np.float32), camera, 1.0)
        for known in ((0.0, 0.0), (0.02, 0.015), (0.8, 0.015)):
            terrain = terrain_of(image, STATED, up, known, Config())
            assert not terrain.stand.found and not (terrain.classes == GROUND).any()
