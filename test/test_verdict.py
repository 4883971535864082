"""What is doubtful about an image is said; enlarged images and disparities are read as such."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from rangeseg_ros import Camera, Config, RangeImage, Segmenter, SequenceSegmenter, segment
from rangeseg_ros.core.sensing.encoding import decoded, encoding
from rangeseg_ros.core.sensing.enlargement import interpolation, replication
from rangeseg_ros.core.sensing.verdict import (
    _share_of_range,
    filled_share,
    improbable_scale,
    judge,
)
from rangeseg_ros.simulation.render import simulate
from rangeseg_ros.simulation.scenes import curved_scene, kinect_room
from rangeseg_ros.simulation.sensors.catalogue import SENSORS
from rangeseg_ros.simulation.sensors.kinect import Kinect, kinect_camera

SLOW = pytest.mark.slow


def enlarged(depth, camera, factor, crop, interpolation=cv2.INTER_NEAREST):
    """A depth image and its camera enlarged, without some pixels of each side."""
    size = depth.shape[1] * factor, depth.shape[0] * factor
    top, left, bottom, right = crop
    wide = cv2.resize(depth, size, interpolation=interpolation)
    wide = wide[top : size[1] - bottom, left : size[0] - right]
    centre = (camera.cx + 0.5) * factor - 0.5 - left, (camera.cy + 0.5) * factor - 0.5 - top
    focal = camera.fx * factor, camera.fy * factor
    return np.ascontiguousarray(wide), Camera(*wide.shape[::-1], *focal, *centre)


@pytest.mark.parametrize('factor', [2, 3, 4, 6, 8])
def test_replicated_pixels_are_undone_whatever_is_cropped(seen, factor):
    depth, camera = seen.depth[:240, :320], replace(seen.camera, width=320, height=240)
    original = RangeImage.from_depth(depth, camera)
    rng = np.random.default_rng(factor)
    for _ in range(3):
        crop = rng.integers(0, factor, 4)
        image = RangeImage.from_depth(*enlarged(depth, camera, factor, crop))
        cells = replication(image)
        assert cells == (factor, crop[0], crop[1], False)
        reduced = cells.reduced(image)
        np.testing.assert_array_equal(reduced.inverse, original.inverse)
        np.testing.assert_allclose(reduced.rays, original.rays, atol=1e-5)
        np.testing.assert_array_equal(cells.enlarged(reduced.inverse, image.shape), image.inverse)


@pytest.mark.parametrize('method', ['planes', 'normals'])
def test_an_enlarged_image_gives_what_the_original_gives(seen, method):
    depth, camera = enlarged(seen.depth, seen.camera, 3, (1, 2, 0, 1))
    small, large = (
        SequenceSegmenter(Config(method=method)).segment(RangeImage.from_depth(*frame), 0)
        for frame in ((seen.depth, seen.camera), (depth, camera))
    )
    for name in ('labels', 'normals', 'edges', 'terrain', 'height'):
        wanted = getattr(small, name).repeat(3, axis=0).repeat(3, axis=1)
        np.testing.assert_array_equal(getattr(large, name), wanted[1:, 2:-1])
    for one, other in zip(small.planes, large.planes, strict=True):
        np.testing.assert_allclose(one.normal, other.normal, atol=1e-4)
        np.testing.assert_allclose(one.hull.mean(axis=0), other.hull.mean(axis=0), atol=0.01)
    assert large.verdict.reasons[:1] == ('enlarged x 3',)


def test_clouds_and_their_own_body_are_reduced_as_well(seen):
    points = RangeImage.from_depth(seen.depth, seen.camera).points
    turned = points + np.float32(0.001) * np.sin(np.arange(640))[:, None]  # of no pinhole camera
    image = RangeImage.from_points(turned.repeat(2, axis=0).repeat(2, axis=1))
    cells = replication(image)
    assert image.camera is None and cells == (2, 0, 0, False)
    body = np.indices(image.shape)[0] < 100
    reduced, small = cells.reduced(image.without(body)), RangeImage.from_points(turned)
    np.testing.assert_array_equal(reduced.body, body[::2, ::2])
    np.testing.assert_array_equal(reduced.inverse, small.without(body[::2, ::2]).inverse)


@pytest.mark.parametrize('unmeasured', [0, np.nan])
@pytest.mark.parametrize('factor', [2, 3, *(pytest.param(k, marks=SLOW) for k in (4, 6, 8, 16))])
def test_linear_interpolation_is_undone_whatever_is_cropped(seen, factor, unmeasured):
    depth, camera = seen.depth[:240, :320] / 1000, replace(seen.camera, width=320, height=240)
    crop = np.random.default_rng(factor).integers(0, factor, 4)
    before = np.where(depth > 0, depth, unmeasured).astype(np.float32)
    wide, wide_camera = enlarged(before, camera, factor, crop, cv2.INTER_LINEAR)
    image = RangeImage.from_depth(wide, wide_camera)
    cells = interpolation(image)
    assert cells == (factor, crop[0], crop[1], True)
    reduced = cells.reduced(image)
    np.testing.assert_allclose(reduced.rays, RangeImage.from_depth(depth, camera).rays, atol=1e-5)
    # But for cells whose centres are cropped.
    found, true = reduced.points[1:-1, 1:-1, 2], depth[1:-1, 1:-1]
    both = (found > 0) & (true > 0)
    np.testing.assert_allclose(found[both], true[both], atol=1e-4)
    if unmeasured == 0:
        np.testing.assert_array_equal(found > 0, true > 0)
    assert not (found[true == 0] > 0).any() and both.sum() > 0.97 * (true > 0).sum()


def test_a_linear_enlargement_in_millimetres_gives_what_the_original_gives(seen):
    depth = seen.depth.astype(np.float32)
    wide, camera = enlarged(depth, seen.camera, 2, (0, 0, 0, 0), cv2.INTER_LINEAR)
    small = segment(depth / 1000, seen.camera).labels
    large = segment(np.rint(wide).astype(np.uint16), camera).labels
    assert (large[::2, ::2] == small).mean() > 0.98


def test_levels_of_exact_scenes_are_not_replication():
    for left, right, top, bottom in ((200, 440, 120, 360), (320, 328, 240, 248)):
        depth = np.full((480, 640), 2.1)
        depth[top:bottom, left:right] = 2.0
        assert segment(depth, Camera.from_fov(640, 480, 57)).verdict.ok


@pytest.mark.parametrize('seed', [1, 2])
@pytest.mark.parametrize('sensor', ['kinect', 'realsense', 'tof'])
def test_simulated_images_are_trusted(sensor, seed):
    seen = simulate(kinect_room(seed), SENSORS[sensor](seed), seed=seed)
    verdict = segment(seen.depth, seen.camera).verdict
    assert verdict.ok and str(verdict) == 'trusted'


def test_of_planes_in_a_line_the_share_of_range_is_told_or_unknown():
    camera, theta = Camera(320, 240, 150.0, 150.0, 159.5, 119.5), np.array([0.1, -0.2, 0.5])
    for column in range(320):
        rays = camera.rays[:60, column].astype(float)
        share, variance = _share_of_range(rays, (rays @ theta).astype(np.float32), theta)
        assert abs(share) < 0.01 and np.isfinite(variance)


def test_a_kinect_that_is_misread_is_told(seen):
    distances = seen.depth * np.linalg.norm(seen.camera.rays, axis=2) / 1000
    for depth, unit, reason, told in (
        (distances, None, 'range instead of z', 'multiply them by 1 / |ray|'),
        (seen.depth, 0.005, 'scale improbable', '5 times too far'),
        (seen.depth, 0.0002, 'scale improbable', '5 times too near'),
        (seen.depth, 0.01, 'scale improbable', '10 times too far'),
    ):
        verdict = segment(depth, seen.camera, unit).verdict
        assert verdict.reasons == (reason,) and verdict.invalid and told in str(verdict)


@pytest.mark.filterwarnings('ignore:more than half of the pixels are')
def test_what_is_no_depth_in_metres_has_no_ground(seen):
    random, shape = np.random.default_rng(1), seen.depth.shape
    for depth, told in (
        (random.integers(500, 5000, shape).astype('u2'), 'noise instead of depth'),
        (random.random(shape), 'noise instead of depth'),
        (random.choice([1.0, 3.0], shape), 'noise instead of depth'),
        (seen.depth.astype(float), 'millimetres in floats'),
        (np.round(seen.depth / 1000).astype('u2'), 'scale improbable'),
    ):
        result = segment(depth, seen.camera)
        first, *others = result.verdict.reasons
        assert first == told and 'scale improbable' not in others and result.verdict.invalid
        assert result.ground is None and not result.terrain.any()
    assert segment(0 * depth, seen.camera).verdict.reasons == ('nothing measured',)


@pytest.mark.parametrize(
    ('run', 'jump', 'share'), [(6, 1.06, 0.025), (4, 0.5, 0.015), (1, 0.5, 0), (6, 1.04, 0)]
)
def test_what_copies_its_neighbour_up_to_a_jump_was_filled(run, jump, share):
    inverse = np.random.default_rng(2).uniform(0.5, 0.502, (400, 200))
    inverse[:, 101 - run : 101] = inverse[:, 100:101]
    inverse[:, 101:] *= jump
    for turned in (inverse, inverse[:, ::-1], inverse.T, inverse.T[::-1]):
        camera = Camera(*turned.shape[::-1], 200.0, 200.0, 99.5, 99.5)
        image = RangeImage(camera.rays, turned.astype(np.float32), camera)
        found = filled_share(image)
        assert found == pytest.approx(share, abs=2e-4)
        reasons = judge(image, np.zeros(turned.shape, np.uint16), {}).reasons
        assert (f'filled {100 * found:.0f} %' in reasons) == (share > 0)


def levels(steps):
    """Range image of inverse ranges so many steps apart, each of 4 x 4 pixels."""
    inverse = np.kron(np.cumsum([0.1, *steps])[None], np.ones((4, 4))).astype(np.float32)
    return RangeImage(np.ones((*inverse.shape, 3), np.float32), inverse)


@pytest.mark.parametrize('factor', [5.0, 0.2, 10.0, 0.1, 1000.0, 0.001, 1.0])
def test_units_are_told_by_the_steps_of_a_kinect(factor):
    step, told = 1 / (8 * 580 * 0.075) / factor, 0 if factor == 1 else factor
    for off, count, expected in ((1.04, 40, told), (0.94, 40, 0), (1.0, 20, told), (1.0, 19, 0)):
        assert improbable_scale(levels([off * step] * count)) == expected
    # Half of the steps are even within a tenth, or less than half.
    assert improbable_scale(levels([1.05 * step, step, 0.95 * step, 1.2 * step] * 10)) == told
    assert improbable_scale(levels([step, *[1.2 * step] * 2, *[0.8 * step] * 2] * 9)) == 0


def test_planes_tell_their_share_of_the_bend_of_ranges():
    draw = np.random.default_rng(3)
    rays = np.column_stack([draw.uniform(-0.5, 0.5, (2, 400)).T, np.ones(400)])
    theta = np.array([0.1, -0.2, 0.5])
    for share in (0, 0.5, 1):
        inverse = (rays @ theta) * (1 + share * (1 / np.linalg.norm(rays, axis=1) - 1))
        inverse += draw.normal(0, 1e-4, 400)
        inverse[:20] += 0.1
        found, variance = _share_of_range(rays, inverse, theta)
        assert abs(found - share) < 4 * variance**0.5 < 0.02


def test_curved_surfaces_keep_their_pixels():
    """In rooms with barrels and balls, seen by Kinects: not in each, but on nothing else."""
    truth = []
    for seed in range(5):
        frame = simulate(curved_scene(seed), SENSORS['kinect'](seed), seed=seed)
        result = segment(frame.depth, frame.camera)
        curved = result.curved > 0
        assert not (curved & (result.labels > 0)).any()
        truth.append(frame.labels[curved])
    found = np.concatenate(truth)
    assert found.size and (found == 65535).mean() > 0.9


def test_a_curved_scene_is_said(seen):
    image = RangeImage.from_depth(seen.depth, seen.camera)
    labels = (np.arange(480)[:, None] < 239).repeat(640, axis=1).astype(np.uint16)
    for curved, told in ((1 - labels, True), (labels, False), (None, False)):
        assert ('curved scene' in judge(image, labels, {}, curved).reasons) == told


def test_errors_that_an_image_cannot_tell_are_said():
    depth = np.random.default_rng(0).uniform(1, 3, (20, 30))
    verdict = segment(depth, Camera(30, 20, 26.0, 26.0, 14.5, 9.5)).verdict
    assert 'distortion not identifiable' in verdict.reasons


SIGNS = {'disparity': 0, 'near is bright': 1, 'near is dark': -1}


def pictured(frame, kind, levels=None):
    """A frame as disparities or a picture of its depth, rounded to so many levels or not."""
    known, depth = frame.depth > 0, frame.depth.astype(float)
    if kind == 'disparity':
        depth[known] = 1 / depth[known]
    else:
        ends = np.quantile(depth[known], [0, 1] if kind == 'near is dark' else [1, 0])
        depth[known] = (depth[known] - ends[0]) / (ends[1] - ends[0])
    values = depth / depth[known].max()
    if levels:
        values = np.maximum(np.round(values * levels), 1) / levels
    return RangeImage.from_depth(np.where(known, 10 * values, 0).astype(np.float32), frame.camera)


@pytest.mark.parametrize('kind, levels', [('disparity', None), *((kind, 255) for kind in SIGNS)])
def test_disparities_and_pictures_are_segmented_as_such(seen, kind, levels):
    image = pictured(seen, kind, levels)
    assert np.sign(encoding(image)) == SIGNS[kind]
    result = Segmenter().segment(image)
    assert result.image is image and result.verdict.invalid
    assert result.values == ('picture' if 'near' in kind else 'disparity')
    assert result.verdict.reasons[0] == f'{result.values} instead of depth'
    assert result.ground is None and not result.terrain.any()
    depth = segment(seen.depth, seen.camera)
    for plane in depth.planes[:3]:
        own = depth.labels == plane.label
        same = result.labels == np.bincount(result.labels[own]).argmax()
        assert (own & same).sum() > 0.9 * (own | same).sum()


def test_what_is_nearest_in_a_picture_may_fill_no_block():
    frame = simulate(kinect_room(733), Kinect(733), seed=733)
    near = frame.depth[frame.depth > 0].min()
    frame.depth[300:340, 300:304] = 0.4 * near
    frame.depth[296:344:3, 296:310] = 0
    q = encoding(pictured(frame, 'near is bright', 255))
    assert 0.5 < (1 - q) * frame.depth.max() / (0.4 * near) < 2


def test_only_pictures_begin_at_an_unknown_distance(seen):
    """One surface that bends may look like that, and an image of more than 8 bits is measured."""
    image = pictured(seen, 'near is dark')
    assert encoding(image) < 0
    fine = np.random.default_rng(1).uniform(0.9999, 1.0001, image.shape).astype(np.float32)
    assert encoding(replace(image, inverse=image.inverse * fine)) in (0.0, None)


@pytest.mark.parametrize('kind', SIGNS)
def test_decoded_images_are_depths_but_for_a_factor(seen, kind):
    known = seen.depth[seen.depth > 0]
    again = decoded(pictured(seen, kind), 1 - (known.min() / known.max()) ** SIGNS[kind]).inverse
    # The end that is black is no measurement.
    shown = again > 0
    assert (shown == (seen.depth > 0)).mean() > 0.999
    ratio = again[shown] * seen.depth[shown]
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-3)
    assert np.median(again[shown]) == pytest.approx(0.5)


@pytest.mark.parametrize('size', [(160, 120), (320, 240), (640, 480)])
def test_a_crease_is_no_bend(size):
    """Along a floor that meets a wall every block beside the other shows the same."""
    camera = kinect_camera(*size)
    depth = np.minimum(0.8 / np.maximum(camera.rays[..., 1], 1e-6), 3)
    assert encoding(RangeImage.from_depth(depth, camera)) is None
    told = 0.0 if size[0] > 160 else None  # a small image tells too little
    assert encoding(RangeImage.from_depth(1 / depth, camera)) == told


def test_narrow_views_and_little_depth_tell_nothing_and_pass():
    for focal, least, most in ((1e4, 1, 2), (1e7, 1, 2), (1e12, 1, 2), (580, 0, 0), (580, 2, 2)):
        camera = Camera(640, 480, focal, focal, 319.5, 239.5)
        depth = np.random.default_rng(1).uniform(least, most, camera.shape)
        assert encoding(RangeImage.from_depth(depth, camera)) is None
