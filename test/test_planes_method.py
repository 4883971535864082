"""Method planes as a whole: accuracy, any size, whatever there is not."""

from contextlib import nullcontext

import numpy as np
import pytest

from rangeseg_ros import Camera, Config, RangeImage, Segmenter
from rangeseg_ros.core.sensing.range_image import UnitWarning
from rangeseg_ros.evaluation.hoover import classify
from rangeseg_ros.evaluation.label_files import as_truth
from rangeseg_ros.evaluation.overlap import overlap_figures
from rangeseg_ros.simulation.render import simulate
from rangeseg_ros.simulation.scenes import kinect_room
from rangeseg_ros.simulation.sensors.kinect import Kinect, kinect_camera


def segmented(depth, camera, **config):
    return Segmenter(Config(**config)).segment(RangeImage.from_depth(depth, camera))


def room(seed, noise='measured', width=640, height=480):
    camera = kinect_camera(width, height)
    return simulate(kinect_room(seed), Kinect(seed, noise), camera, seed=seed)


@pytest.mark.parametrize(
    ('width', 'height', 'noise', 'mean_iou', 'share'),
    [
        (640, 480, 'measured', 0.95, 0.93),
        (640, 480, 'independent', 0.96, 0.95),
        (160, 120, 'measured', 0.92, 0.9),
        (160, 120, 'none', 0.95, 0.95),
        (80, 60, 'measured', 0.72, 0.7),
        (80, 60, 'none', 0.69, 0.65),
    ],
)
def test_accuracy_on_simulated_rooms(width, height, noise, mean_iou, share):
    """Well above the best peer on such rooms (0.926 and 94 %; independent 0.910 and 91 %).

    A little below the targets over many rooms (0.96 and 97 %; 0.97 and 98 %): these are 37 regions
    of 1000 pixels and more, correct when they overlap by 80 %. Small images show the same faces.
    """
    overlaps, normals = [], []
    for seed in range(900, 903 if width == 640 else 906):
        frame = room(seed, noise, width, height)
        result = segmented(frame.depth, frame.camera)
        assert not result.labels[frame.depth == 0].any()
        least = round(1000 * width * height / 307200)
        overlaps.append(as_truth(frame.labels, least).compare(result.labels))
        found = {plane.label: plane.normal for plane in result.planes}
        truth = {plane.label: plane.normal for plane in frame.planes}
        for g, m in classify(overlaps[-1], 0.8).matches.items():
            normals.append(np.degrees(np.arccos(min(truth[g] @ found[m], 1.0))))
    count = sum(len(overlap.truth) for overlap in overlaps)
    assert count >= 35
    assert overlap_figures(overlaps)['mean_iou'] >= mean_iou
    assert len(normals) >= share * count
    if noise == 'independent':
        # The targets; the distortion of real sensors turns planes by more.
        assert np.median(normals) <= 0.1 and np.max(normals) <= 2.0


@pytest.mark.parametrize('size', [(424, 240), (212, 120), (101, 67), (37, 61)])
def test_any_size(size):
    """Also those that blocks do not divide."""
    camera = kinect_camera(*size)
    result = segmented(1 / (camera.rays @ np.array([0.1, 0.2, 0.5])), camera)
    assert result.labels.shape == camera.shape and (result.labels == 1).all()
    assert [plane.count for plane in result.planes] == [size[0] * size[1]]


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('value', [1e-38, 1e-6, 1e6, 1e38])
def test_absurd_depths_disturb_nothing(value):
    frame = room(900, 'none', 160, 120)
    depth = frame.depth.copy()
    depth[30:60, 40:90] = value
    result, expected = (segmented(image, frame.camera) for image in (depth, frame.depth))
    assert np.isfinite(result.energy)
    for plane in result.planes:
        assert np.isfinite([*plane.normal, plane.distance]).all()
    away = np.ones(depth.shape, bool)
    away[20:70, 30:100] = False
    assert ((result.labels > 0) == (expected.labels > 0))[away].mean() > 0.9
    # Depths that no sensor can measure are not measured; 1000 km is still a wall.
    with pytest.warns(UnitWarning) if value == 1e6 else nullcontext():
        result = segmented(np.full_like(depth, value), frame.camera)
    if value == 1e6:
        (wall,) = result.planes
        np.testing.assert_allclose(wall.normal, [0, 0, -1], atol=1e-6)
        assert wall.distance == pytest.approx(value, rel=1e-6) and wall.count == depth.size
    else:
        assert not result.planes and result.reason == 'no valid depth'


@pytest.mark.parametrize(('distance', 'degrees'), [(2, 0), (2, 40), (4, 20)])
def test_a_picture_before_a_wall_is_a_plane(distance, degrees):
    """Half a percent of the distance: planes themselves bend by half of that."""
    camera = kinect_camera()
    angle = np.radians(degrees)
    wall = camera.rays @ np.array([np.sin(angle), 0.0, np.cos(angle)])
    away = distance * np.cos(angle)
    picture = np.zeros(camera.shape, bool)
    picture[150:330, 200:460] = True
    depth = np.where(picture, away - distance / 200, away) / wall
    labels = segmented(depth.astype(np.float32), camera).labels
    here, there = labels[picture], labels[~picture]
    hung, behind = np.bincount(here).argmax(), np.bincount(there).argmax()
    assert hung != behind and (here == hung).mean() > 0.98 and (there == behind).mean() > 0.98


@pytest.mark.parametrize('offset', range(4))
def test_a_board_a_third_larger_than_the_smallest_plane_is_found_wherever_it_is(offset):
    """Blocks that its rim crosses are not its own."""
    camera = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
    depth = 2 + np.random.default_rng(0).normal(0, 0.002, camera.shape)
    board = np.s_[200 + offset : 220 + offset, 300 + offset : 320 + offset]
    depth[board] -= 0.4
    labels = segmented(depth, camera).labels
    label = np.bincount(labels[board].ravel()).argmax()
    assert label > 0 and (labels[board] == label).mean() > 0.9
    assert (labels == label).sum() < 1.1 * 400
