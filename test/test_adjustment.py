"""Planes and poses solved together: errors against truth, drift, jumps of single planes."""

from types import SimpleNamespace

import numpy as np
import pytest
from map_squares import observed, plane
from scipy.spatial.transform import Rotation

from rangeseg_ros.core.mapping.adjustment import Adjustment
from rangeseg_ros.core.mapping.observations import (
    PlaneSet,
    PoseNoise,
    cell_rays,
    observations,
    views,
)
from rangeseg_ros.core.mapping.plane_filter import Jump
from rangeseg_ros.core.mapping.plane_map import Sighting
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.tracking.plane_errors import tangents, to_errors

FACES = np.array(
    [(0, 0, 1, 0), (0, 0, -1, 2.5), (-1, 0, 0, 3), (1, 0, 0, 3), (0, 1, 0, 2), (0, -1, 0, 2)]
)
NOISE = PoseNoise(0.005, np.radians(0.3))
# As the map has them before.
START = [plane(k + 1, f[:3], -f[:3] * f[3], 0.01) for k, f in enumerate(FACES)]
IDENTITY = Transform.identity()
# Errors of planes as a sensor shows them: direction about two axes, and offset.
ROOT = np.diag([0.004, 0.004, 0.003])


def sighting(pose, planes, *about):
    """Planes that a frame shows."""
    seen = observations(planes, np.zeros((len(planes), 1)), pose, NOISE)
    return Sighting(pose, seen, *about, np.zeros((1, 3)))


def walked(frames):
    """Poses of a camera that walks 4 m along a room."""
    k = np.arange(frames)
    turns = Rotation.from_rotvec(0.3 * np.sin(k[:, None] / [7, 9, 5])).as_matrix()
    places = np.stack([-2 + 4 * k / frames, 0.3 * np.sin(k / 5), np.full(frames, 1.2)], axis=1)
    return list(map(Transform, turns, places))


def ways(poses):
    """From each pose to the next one, metres."""
    return np.linalg.norm(np.diff([pose.shift for pose in poses], axis=0), axis=1)


def solved(seed, drift=(0, 0, 0), frames=40, moving=0.0, odometry=False):
    """Solution for a camera that walks along a room, and its true poses."""
    random, truths = np.random.default_rng(seed), walked(frames)
    errors = random.normal(0, NOISE.deviations, (frames, 6))
    if odometry:
        errors = np.cumsum(errors, axis=0) * np.repeat([0, 1], 3)
    errors[:, 3:] += np.outer(np.append(0, np.cumsum(ways(truths))), drift)
    adjustment = Adjustment(NOISE, odometry)
    for k, (truth, error) in enumerate(zip(truths, errors, strict=True)):
        # All pixels are others after four frames.
        lasting = np.random.default_rng([seed, k // 4]).standard_normal((len(FACES), 3))
        begins, faces = np.full(len(FACES), k % 4 == 0), FACES.copy()
        faces[5, 3] += moving * (k > frames / 2)
        about = zip(faces, lasting, strict=True)
        planes = [observed(random, face, truth, ROOT, own) for face, own in about]
        adjustment.add(sighting(truth.by(error), planes, np.arange(1, len(FACES) + 1), begins))
    return adjustment.solve(START, {}), truths


def rms(values):
    return np.sqrt(np.mean(np.square(values)))


def errors_of(solution, truths):
    """Equations of the planes and shifts of the poses, less the true ones."""
    found = np.array([[*plane.normal, plane.distance] for plane in solution.planes])
    shifts = [a.shift - b.shift for a, b in zip(solution.poses, truths, strict=True)]
    return found - FACES, np.array(shifts)


def test_errors_are_as_small_as_stated_and_poses_better_than_told():
    nees, shifts, turns = [], [], []
    for seed in range(20):
        solution, truths = solved(seed)
        error, shift = errors_of(solution, truths)
        inverse = np.linalg.pinv(solution.covariance, 1e-9, hermitian=True)
        nees.append(error.ravel() @ inverse @ error.ravel() / 3 / len(FACES))
        shifts.append(shift)
        both = zip(solution.poses, truths, strict=True)
        off = Rotation.from_matrix([a.rotation @ b.rotation.T for a, b in both])
        turns.append(off.magnitude())
        assert solution.way == pytest.approx(ways(truths).sum(), rel=0.015) and not solution.drifts
    assert 0.7 < np.mean(nees) < 1.5
    assert rms(shifts) < 0.75 * NOISE.shift and rms(turns) < 0.75 * 3**0.5 * NOISE.turn


def test_drift_is_found_and_taken_off():
    told = np.array([0.006, 0.008, 0.0])
    for seed in range(5):
        solution, truths = solved(seed, told)
        assert solution.drifts and 'the poses drift by' in solution.drift_text()
        gap = solution.drift - told
        assert gap @ np.linalg.solve(solution.drift_covariance, gap) < 16.3
        assert np.linalg.norm(gap) < 0.003 and rms(errors_of(solution, truths)[1]) < 0.01


def test_a_plane_that_moves_does_not_move_the_camera():
    assert rms(errors_of(*solved(3, moving=0.3))[1]) < 0.01


def test_errors_of_an_odometry_add_up_and_planes_take_them_off():
    left = [errors_of(*solved(seed, odometry=True))[1] for seed in range(5)]
    # Where all of it is, nothing tells. Sums of n steps scatter by a root of n / 6 of them.
    assert np.std(left, axis=1).mean() < 0.29 * NOISE.shift * np.sqrt(40 / 6)


def test_observations_count_for_what_their_planes_became():
    random, adjustment = np.random.default_rng(0), Adjustment(NOISE)
    pose = Transform(np.eye(3), np.array([0.0, 0.0, 1.0]))
    for number in (1, 7, 9):
        planes = [observed(random, FACES[0], pose, ROOT)]
        adjustment.add(sighting(pose, planes, np.array([number]), np.array([True])))
    adjustment.add(sighting(pose, [], np.zeros(0, int), np.zeros(0, bool)))
    one, three = (adjustment.solve(START[:1], became) for became in ({}, {9: 7, 7: 1}))
    assert 3 * np.trace(three.covariance) == pytest.approx(np.trace(one.covariance), rel=1e-3)
    assert len(one.poses) == 4


def test_planes_are_moved_with_their_outlines_and_the_same_each_time():
    for a, b in zip(*(solved(1)[0].planes for _ in range(2)), strict=True):
        assert np.array_equal(a.covariance, b.covariance) and a.distance == b.distance
        np.testing.assert_allclose(a.hull @ a.normal + a.distance, 0, atol=1e-9)


RAYS = np.stack([*np.meshgrid([-0.6, -0.2, 0.2, 0.6], [-0.4, 0.0, 0.4]), np.ones((3, 4))], axis=-1)


def distorted(face, pose, view, field):
    """Equation of a face as pixels of these cells show it with this error of the inverse range."""
    rays = RAYS.reshape(-1, 3)
    told = -(pose.rotation.T @ face[:3]) / (face[3] + face[:3] @ pose.shift)
    design = np.sqrt(view)[:, None] * rays
    slope = np.linalg.lstsq(design, np.sqrt(view) * (rays @ told + field), rcond=None)[0]
    return np.append(-slope, 1) / np.linalg.norm(slope)


def test_what_a_distortion_makes_of_planes_is_what_fits_show():
    random, pose = np.random.default_rng(4), Transform(np.eye(3), np.array([0.5, 0.2, -1.0]))
    field = 1e-6 * random.standard_normal(12)
    for cells in (12, 4, 1):
        view = random.uniform(1, 2, 12) * (random.permutation(12) < cells)
        face = np.array([0.36, 0.48, -0.8, 2.0])
        if cells < 3:  # of which nothing tells the direction
            face[:3] = 0, 0, -1
        before, after = (distorted(face, pose, view, f) for f in (0 * field, field))
        normal, distance = before[None, :3], before[None, 3]
        planes = PlaneSet(normal, -distance[:, None] * normal, tangents(normal))
        told = planes.by_field(view[None], RAYS.reshape(-1, 3))[0] @ field
        found = to_errors(planes.axes, planes.point)[0] @ (after - before)
        if cells < 3:
            told, found = told[2:], found[2:]
        np.testing.assert_allclose(told, found, rtol=1e-3, atol=1e-12)


def test_the_distortion_of_the_sensor_is_told_from_the_planes():
    random = np.random.default_rng(5)
    field = 0.004 * random.standard_normal(12)
    adjustments = Adjustment(NOISE), Adjustment(NOISE)
    for _ in range(60):
        turn = Rotation.from_rotvec(random.normal(0, 1, 3)).as_matrix()
        truth = Transform(turn, random.uniform((-2, -1, 0.5), (2, 1, 2.0)))
        told = truth.by(random.normal(0, NOISE.deviations))
        ids = 1 + np.flatnonzero(FACES[:, :3] @ truth.rotation[:, 2] < -0.7)
        planes, views = [], random.uniform(0.1, 1, (len(ids), 12))
        views *= random.random(views.shape) < 0.8
        for face, view in zip(FACES[ids - 1], views, strict=True):
            planes.append(observed(random, distorted(face, truth, view, field), IDENTITY, ROOT))
        about = observations(planes, views, told, NOISE), ids, np.full(len(ids), True)
        for adjustment, rays in zip(adjustments, (RAYS, 0 * RAYS), strict=True):
            adjustment.add(Sighting(told, *about, rays.reshape(-1, 3)))
    told, untold = (adjustment.solve(START, {}) for adjustment in adjustments)
    np.testing.assert_allclose(told.field, field, atol=0.002)
    off = [[face.distance for face in each.planes] - FACES[:, 3] for each in (told, untold)]
    assert np.abs(off[0]).mean() < 0.5 * np.abs(off[1]).mean()


def test_images_are_corrected_by_the_field_of_their_cells():
    camera = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
    image = RangeImage.from_depth(np.full((120, 160), 2.0, np.float32), camera)
    field = 0.001 * np.arange(12.0)
    solution = solved(0, frames=2)[0]._replace(field=field)
    # Cells of 40 pixels, three rows of four; the middle of each is between two pixels.
    middle = solution.corrected(image, 20.0).inverse[19::40, 19::40]
    np.testing.assert_allclose(middle.ravel(), 0.5 - field, atol=1e-4)
    rays = cell_rays(image, 20.0).reshape(3, 4, 3)
    np.testing.assert_allclose(rays[1, 2], camera.rays[40:80, 80:120].mean(axis=(0, 1)), atol=0.01)
    labels = np.zeros((120, 160), np.uint16)
    labels[40:80, 80:120] = 1
    assert views(labels, [SimpleNamespace(label=1)], 20.0)[0].tolist() == np.eye(12)[6].tolist()
    assert solution.corrected(image, 40.0) is image


def test_what_a_jump_was_taken_for_wrongly_is_taken_off():
    """Poses before it are off as one body: a turn about where the camera was, and a shift."""
    camera = np.array([1.0, 0.5, 1.2])
    wrong = np.array([0.0, 0.02, 0.03, 0.05, -0.04, 0.03])
    spread = np.diag(np.repeat([0.03, 0.05], 3) ** 2)
    off = []
    for told_spread in (spread, 1e-6 * spread):
        random, adjustment, truths = np.random.default_rng(2), Adjustment(NOISE), walked(24)
        turn = Rotation.from_rotvec(wrong[:3]).as_matrix()
        moved = Transform(turn, camera + wrong[3:] - turn @ camera)
        for k, truth in enumerate(truths):
            told = truth.by(random.normal(0, NOISE.deviations))
            # Most frames before it show floor and ceiling only.
            shown = 6 if k in (0, 9, 17) or k >= 18 else 2
            planes = [observed(random, face, truth, ROOT) for face in FACES[:shown]]
            jump = Jump(IDENTITY, camera, wrong, told_spread) if k == 18 else None
            told = moved.after(told) if k < 18 else told
            now = sighting(told, planes, np.arange(shown) + 1, np.full(shown, True))
            adjustment.add(now._replace(jump=jump))
        off.append(errors_of(adjustment.solve(START, {}), truths)[1][:18])
    known, unknown = map(rms, off)
    assert known < 0.01 < unknown / 5
