"""What results may not depend on: unit of length, axes and sides of the image, frame of a map."""

from dataclasses import replace

import numpy as np
import pytest
from planes_of_labels import fit_planes
from scipy.spatial.transform import Rotation

from rangeseg_ros import Camera, Config, RangeImage, Segmenter
from rangeseg_ros.core.mapping.adjustment import Adjustment
from rangeseg_ros.core.mapping.observations import PoseNoise
from rangeseg_ros.core.mapping.plane_map import PlaneMap
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.simulation.render import simulate
from rangeseg_ros.simulation.scenes import kinect_room, walk
from rangeseg_ros.simulation.sensors.kinect import Kinect
from rangeseg_ros.simulation.sensors.sensor import resize
from rangeseg_ros.simulation.terrain.frame import simulate_terrain
from rangeseg_ros.simulation.terrain.kinds import stated, terrain_scene

LENGTHS = {'distance': 1, 'rms': 1, 'centroid': 1, 'extents': 1, 'area': 2}
SWAPPED = [1, 0, 2]


@pytest.fixture(scope='module')
def seen():
    """A room, and what is found in it."""
    frame = simulate(kinect_room(5), Kinect(5))
    image = RangeImage.from_depth(frame.depth, frame.camera)
    return image, Segmenter().segment(image)


@pytest.mark.parametrize('factor', [2, 8])
def test_a_larger_world_looks_the_same(seen, factor):
    """No rule has a length in it, but for floors of errors, which change them by a millionth."""
    image, result = seen
    large = Segmenter().segment(replace(image, inverse=image.inverse / np.float32(factor)))
    np.testing.assert_array_equal(large.labels, result.labels)
    for error in 'noise', 'distortion', 'quantum':
        found = factor * getattr(large.sensor, error)
        assert found == pytest.approx(getattr(result.sensor, error), rel=1e-4), error
    units = factor ** np.array([0, 0, 0, 1.0])
    for plane, other in zip(result.planes, large.planes, strict=True):
        for name, power in LENGTHS.items():
            scaled = factor**power * np.asarray(getattr(plane, name))
            np.testing.assert_allclose(getattr(other, name), scaled, rtol=1e-6, err_msg=name)
        np.testing.assert_allclose(other.normal, plane.normal, atol=1e-9)
        scaled = np.outer(units, units) * plane.covariance
        np.testing.assert_allclose(other.covariance, scaled, rtol=1e-4, atol=1e-4 * scaled.max())
        shares = other.probability, other.confidence
        assert shares == pytest.approx((plane.probability, plane.confidence), abs=1e-4)


def test_no_axis_of_the_image_is_another_one(seen):
    """The same regions of the transposed image have the transposed planes and errors."""
    image, result = seen
    camera = image.camera
    turned = Camera(camera.height, camera.width, camera.fy, camera.fx, camera.cy, camera.cx)
    across = RangeImage(turned.rays, image.inverse.T.copy(), turned)
    planes = fit_planes(result.labels, image, result.sensor)
    others = fit_planes(result.labels.T.copy(), across, result.sensor)
    full = [*SWAPPED, 3]
    for plane, other in zip(planes, others, strict=True):
        np.testing.assert_allclose(other.normal[SWAPPED], plane.normal, atol=1e-7)
        np.testing.assert_allclose(other.centroid[SWAPPED], plane.centroid, atol=1e-7)
        root = np.sqrt(np.diag(plane.covariance))
        near = (other.covariance[np.ix_(full, full)] - plane.covariance) / np.outer(root, root)
        assert np.abs(near).max() < 1e-5
        sizes = [(each.area, *each.extents) for each in (other, plane)]
        np.testing.assert_allclose(*sizes, rtol=1e-6)


def test_the_map_turns_with_its_frame():
    """Poses in another fixed frame, days later: the same planes, errors and solution there."""
    scene = kinect_room(701, 18, walk)
    sequence, random = SequenceSegmenter(Config()), np.random.default_rng(1)
    turn = Rotation.from_rotvec([0.7, -0.4, 1.1]).as_matrix()
    moved = Transform(turn, np.array([3, -2, 0.5]))
    noise = PoseNoise(0.005, np.radians(0.3))
    maps = [(PlaneMap(Config()), Adjustment(noise), g) for g in (Transform.identity(), moved)]
    for k in range(0, 18, 3):
        frame = simulate(scene, Kinect(701), frame=k, seed=701)
        image = RangeImage.from_depth(frame.depth, frame.camera)
        true = Transform(scene.poses[k].rotation, scene.poses[k].position)
        stamp = 10**9 * (1 + k) // 30
        found = sequence.segment(image, stamp, up=true.rotation[2])
        told = true.by(random.normal(0, [noise.turn] * 3 + [noise.shift] * 3))
        for plane_map, adjustment, frame_of_map in maps:
            pose = frame_of_map.after(told)
            later = stamp + (frame_of_map is moved) * 10**15
            plane_map.add(found.labels, found.planes, image, pose, later)
            adjustment.add(plane_map.sighting)
    (planes, solution), (others, other) = (
        (each.planes, adjustment.solve(each.planes, each.successors))
        for each, adjustment, _ in maps
    )
    jacobian = np.eye(4)
    jacobian[:3, :3], jacobian[3, :3] = turn, -moved.shift @ turn
    assert len(planes) > 5
    for before, after in (planes, others), (solution.planes, other.planes):
        for plane, twin in zip(before, after, strict=True):
            normal = turn @ plane.normal
            np.testing.assert_allclose(twin.normal, normal, atol=1e-9)
            assert twin.distance == pytest.approx(plane.distance - normal @ moved.shift, abs=1e-9)
            covariance = jacobian @ plane.covariance @ jacobian.T
            np.testing.assert_allclose(twin.covariance, covariance, atol=1e-6 * covariance.max())
            assert (twin.id, twin.observations) == (plane.id, plane.observations)
            assert twin.area == pytest.approx(plane.area)
    for pose, twin in zip(solution.poses, other.poses, strict=True):
        np.testing.assert_allclose(twin.shift, moved.after(pose).shift, atol=1e-9)


@pytest.mark.parametrize(
    'kind', ['clutter', 'waves', 'stairs up', 'stairs down', 'ramp up', 'bridge', 'rolled']
)
def test_a_mirror_swaps_left_and_right(kind):
    """Ground, obstacles, drops, heights, grid and stairs of the mirrored image."""
    scene = terrain_scene(kind, 3)
    camera = resize(Kinect(3).camera, 320, 240)
    mirrored = replace(camera, cx=camera.width - 1 - camera.cx)
    up, height = stated(scene, 3)
    depth = simulate_terrain(scene, Kinect(3), camera, 3).depth
    found = []
    for seen, rays, side in (depth, camera, 1), (depth[:, ::-1].copy(), mirrored, -1):
        x, y, z = map(float, up * (side, 1, 1))
        config = Config(up_x=x, up_y=y, up_z=z, sensor_height=height)
        result = Segmenter(config).segment(RangeImage.from_depth(seen, rays))
        pictures = result.terrain[:, ::side], result.height[:, ::side], result.grid.classes
        found.append((*pictures, list(map(str, result.stairs))))
    (classes, heights, grid, stairs), (others, other_heights, other_grid, other_stairs) = found
    # Where a surface ends, rounding decides which side a few pixels are on.
    assert (classes != others).mean() < 1e-3
    same = np.isfinite(heights) & np.isfinite(other_heights)
    assert np.quantile(np.abs(heights - other_heights)[same], 0.99) < 1e-3
    assert (grid != other_grid[::-1]).mean() < 2e-3 and stairs == other_stairs
