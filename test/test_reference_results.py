"""Simulated scenes, and what is found in them, are those that were recorded.

    python test/test_reference_results.py

records those of the present code in reference_results.json; whoever changes what is found does
that, and says in the changelog what has become better. Other scenes or sensors are another
benchmark: the figures in the documents are measured anew.
"""

import json
import re
from dataclasses import astuple
from pathlib import Path

import numpy as np
import pytest
from calibration_frames import CAMERA as SMALL
from calibration_frames import frames, true_map
from scanner_points import scanned

from rangeseg_ros import Config, RangeImage, SequenceSegmenter
from rangeseg_ros.core.calibration.calibrate import calibrate
from rangeseg_ros.core.calibration.sightings import concatenate, find_sightings
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.simulation.render import simulate
from rangeseg_ros.simulation.scenes import Scene, curved_scene, kinect_room, walk
from rangeseg_ros.simulation.sensors.catalogue import SENSORS
from rangeseg_ros.simulation.sensors.ideal import Ideal
from rangeseg_ros.simulation.sensors.sensor import resize
from rangeseg_ros.simulation.solids import cast
from rangeseg_ros.simulation.terrain.frame import simulate_terrain
from rangeseg_ros.simulation.terrain.hard import HARD
from rangeseg_ros.simulation.terrain.kinds import KINDS, stated, terrain_scene
from rangeseg_ros.simulation.terrain.testpieces import PIECES, piece_scene

RECORDED = Path(__file__).with_name('reference_results.json')
KINECT = resize(SENSORS['kinect'](0).camera, 320, 240)
OPTIONS = (
    {},
    {'jump_edges': 'sobel', 'noise_regions': 'merge', 'normal_baseline': 1},
    {'normals': 'plane_fit', 'directions': 'spiral', 'direction_count': 300},
    {'weighting': 'distance', 'directions': 'regular', 'direction_count': 225},
    {'exact': True, 'moves': 'swap', 'direction_count': 17, 'directions': 'platonic'},
)


def numbers(thing):
    """All numbers of values as JSON has them, as letters have numbers, too."""
    if isinstance(thing, str) or thing is None:
        return [float(sum(str(thing).encode()))]
    if isinstance(thing, dict):
        thing = [*thing, *thing.values()]
    if isinstance(thing, list | tuple):
        return [number for part in thing for number in numbers(part)]
    return np.ravel(thing).astype(float).tolist()


def mean(things):
    """Mean magnitude of all numbers."""
    found = np.array([number for thing in things for number in numbers(thing)])
    found = np.abs(found[np.isfinite(found)])
    return float(found.mean()) if len(found) else 0.0


def of_planes(planes):
    told = [plane.to_dict() for plane in planes]
    return {'planes': len(planes)} | {key: mean(d[key] for d in told) for key in told[0]}


def of_result(result):
    grid, stairs = result.grid, result.stairs
    classes = np.bincount(result.terrain.ravel(), minlength=4)
    return of_planes(result.planes) | {
        'energy': float(result.energy),
        'errors': mean(map(float, re.findall(r'[\d.]+', str(result.sensor)))),
        'labelled': float((result.labels > 0).mean()),
        'edges': float(result.edges.mean()),
        **{f'normals {axis}': mean([result.normals[..., k]]) for k, axis in enumerate('xyz')},
        **{f'terrain {k}': int(count) for k, count in enumerate(classes)},
        'height': mean([result.height]),
        'grid': mean([grid.classes]),
        'grid height': mean([grid.height]),
        'grid variance': mean([grid.variance]),
        'stairs': mean([s.count, s.rise, s.run, s.width, s.edge] for s in stairs),
        'ramps': mean([ramp.slope, ramp.climb] for ramp in result.ramps),
        'ground': mean(map(float, re.findall(r'[\d.]+', str(result.ground)))),
    }


def rooms():
    for number, name in enumerate(('kinect', 'realsense', 'tof', 'lidar', 'ideal')):
        scene, sensor = kinect_room(number), SENSORS[name](number)
        frame = simulate(scene, sensor, resize(sensor.camera, 320, 240), seed=number)
        image, pose = RangeImage.from_depth(frame.depth, frame.camera), scene.poses[0]
        sequence = SequenceSegmenter(Config(min_pixels=200))
        height = float(pose.position[2])
        yield name, of_result(sequence.segment(image, 0, pose.rotation[2], height=height))


def options():
    scene = kinect_room(5)
    frame = simulate(scene, SENSORS['kinect'](5), resize(KINECT, 160, 120), seed=5)
    image = RangeImage.from_depth(frame.depth, frame.camera)
    for number, changes in enumerate(OPTIONS):
        config = Config(method='normals', min_pixels=150, **changes)
        result = SequenceSegmenter(config).segment(image, 0, scene.poses[0].rotation[2])
        yield f'normals {number}', of_result(result)


def scanner():
    scene, rays = kinect_room(6), scanned(KINECT)
    pose, random = scene.poses[0], np.random.default_rng(6)
    distance, _ = cast(scene.solids, pose.position, rays @ pose.rotation.T)
    distance += random.normal(0, 0.01, distance.shape)
    image = RangeImage.from_points((rays * distance[..., None]).astype(np.float32))
    yield 'scanner', of_result(SequenceSegmenter().segment(image, 0, pose.rotation[2]))


def terrains():
    for number, kind in enumerate(('stairs up', 'stairs down', 'hole', 'ramp up', 'clutter')):
        scene, sensor = terrain_scene(kind, number), SENSORS['realsense'](number)
        frame = simulate_terrain(scene, sensor, resize(sensor.camera, 424, 240), number)
        image = RangeImage.from_depth(frame.depth, resize(sensor.camera, 424, 240))
        height = float(scene.pose.position[2])
        result = SequenceSegmenter().segment(image, 0, scene.up, height=height)
        yield kind, of_result(result)


def sequences():
    room = kinect_room(4)
    scene = Scene(room.solids, walk(room.poses[0], 4, 30), room.dark)
    for name, config in (
        ('poses', Config(fixed_frame='map', min_pixels=150)),
        ('odometry', Config(odometry=True, min_pixels=150)),
    ):
        sequence = SequenceSegmenter(config)
        for k in range(0, 30, 4):
            frame = simulate(scene, SENSORS['kinect'](4), KINECT, frame=k, seed=4)
            image, pose = RangeImage.from_depth(frame.depth, KINECT), scene.poses[k]
            told = Transform(pose.rotation, pose.position) if name == 'poses' else None
            result = sequence.segment(image, 10**9 + k * 10**9 // 30, pose.rotation[2], told)
        found = of_result(result) | {'map': len(sequence.map)}
        for key in ('id', 'normal', 'distance', 'covariance', 'centroid', 'area', 'observations'):
            found[f'map {key}'] = mean([getattr(plane, key) for plane in sequence.map.planes])
        if sequence.motion:
            motion = sequence.motion
            found |= {'pose': mean(motion.pose), 'velocity': mean([motion.velocity])}
            found |= {'covariance of the pose': mean([motion.covariance])}
        yield name, found


def calibrations():
    cells = concatenate([find_sightings(*frame) for frame in frames(15, true_map())])
    result = calibrate(cells, SMALL.shape, SMALL)
    distortion = result.distortion
    found = {'offset': mean([distortion.offset]), 'deviation': mean([distortion.deviation])}
    yield 'calibration', found | {'before': result.before, 'after': result.after}


def checksum(things):
    """A sum over all numbers of scenes whose weights depend on their places."""
    values = np.nan_to_num(numbers([*things]), posinf=99)
    return float(values @ np.cos(np.arange(len(values)))) / np.sqrt(len(values))


def scenes():
    for name, build in (('room', kinect_room), ('curved', curved_scene)):
        made = [build(seed, 4) for seed in range(6)]
        walks = [walk(scene.poses[0], seed, 9) for seed, scene in enumerate(made)]
        poses = [astuple(pose) for way in walks for pose in way]
        yield f'scenes: {name}', {'sum': checksum([*map(astuple, made), *poses])}
    for kind in (*KINDS, *HARD, *PIECES):
        told = []
        for seed in range(6):
            piece = (kind, 0.2, 1.5, 0.6, seed)
            scene = piece_scene(*piece) if kind in PIECES else terrain_scene(kind, seed)
            frame = simulate_terrain(scene, Ideal(), resize(Ideal().camera, 80, 60), seed)
            told += [astuple(scene), stated(scene, seed), [mean([part]) for part in frame]]
        yield f'terrain: {kind}', {'sum': checksum(told)}


def sensors():
    for name, sensor_of in SENSORS.items():
        for seed in (0, 1):
            sensor = sensor_of(seed)
            depth = simulate(kinect_room(seed), sensor, resize(sensor.camera, 320, 240)).depth
            depth = np.where(depth > 0, depth.astype(float), np.nan)
            step = np.abs(np.diff(depth, axis=1))
            yield (
                f'sensor: {name} {seed}',
                {
                    'measured': float(np.isfinite(depth).mean()),
                    'depth': float(np.nanmean(depth)),
                    'roughness': float(np.nanmean(np.minimum(step, np.nanmean(depth) / 50))),
                },
            )


# Rounding decides single pixels.
CASES = dict.fromkeys((rooms, options, scanner, terrains, sequences, calibrations), 2e-3)
CASES |= {sensors: 5e-4, scenes: 1e-6}


@pytest.mark.parametrize('case', CASES, ids=lambda case: case.__name__)
def test_results_are_those_that_were_recorded(case):
    recorded = json.loads(RECORDED.read_text())
    for name, found in case():
        assert found == pytest.approx(recorded[name], rel=CASES[case], abs=1e-9), name


if __name__ == '__main__':
    lines = []
    for name, found in (named for case in CASES for named in case()):
        rounded = {key: float(f'{value:.8g}') for key, value in found.items()}
        lines.append(f'"{name}": {json.dumps(rounded)}')
    RECORDED.write_text('{\n' + ',\n'.join(lines) + '\n}\n')
