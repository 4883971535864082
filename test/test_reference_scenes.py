"""The simulated sets are those whose figures the documents state: not another scene or sensor.

The numbers were taken from the code that the figures were measured with; who changes a scene
measures anew.
"""

from dataclasses import astuple

import numpy as np
import pytest

from rangeseg_ros.simulation.render import simulate
from rangeseg_ros.simulation.scenes import curved_scene, kinect_room, walk
from rangeseg_ros.simulation.sensors.catalogue import SENSORS
from rangeseg_ros.simulation.sensors.ideal import Ideal
from rangeseg_ros.simulation.sensors.sensor import resize
from rangeseg_ros.simulation.terrain.frame import simulate_terrain
from rangeseg_ros.simulation.terrain.kinds import stated, terrain_scene
from rangeseg_ros.simulation.terrain.testpieces import PIECES, piece_scene

SEEDS = range(6)


def numbers(thing):
    """All numbers in a scene, in their order."""
    if isinstance(thing, str) or thing is None:
        return np.frombuffer(str(thing).encode(), np.uint8).astype(float)
    if isinstance(thing, dict):
        thing = [*thing, *thing.values()]
    if isinstance(thing, list | tuple):
        return np.concatenate([np.zeros(0), *map(numbers, thing)])
    return np.ravel(np.nan_to_num(np.asarray(thing, float), posinf=99)).astype(float)


def checksum(things):
    """A sum whose weights depend on the place."""
    values = numbers([*things])
    return float(values @ np.cos(np.arange(len(values)))) / np.sqrt(len(values))


def terrain_checksums(scene, seed):
    frame = simulate_terrain(scene, Ideal(), resize(Ideal().camera, 80, 60), seed)
    return astuple(scene), stated(scene, seed), [np.mean(numbers(part)) for part in frame]


SCENES = {'room': 14.523628320049728, 'curved': 5.12079776874523}
TERRAINS = {
    'room': 0.189306415,
    'low boxes': 14.72593881,
    'clutter': 2.693803847,
    'waves': -62.89175846,
    'drop': 7.373471733,
    'hole': 15.51136367,
    'pit': 4.255952255,
    'stairs down': -7.909167052,
    'stairs up': 8.179642057,
    'ramp up': 98.85282428,
    'ramp down': -23.18332796,
    'steep': -71.71806364,
    'curb': 1.892784143,
    'mirror': -1.958237343,
    'table in front': -4.098498297,
    'filled view': -11.93489379,
    'no floor': -3.770934589,
    'robot on a ramp': 47.17597069,
    'overhead': -16.1073374,
    'hidden drop': 4.514637565,
    'hidden kerb': 4.891228417,
    'strip': 6.39136015,
    'wrong height': 10.45674154,
    'wrong up': 13.68526409,
    'slope': -3.102914184,
    'rough': -32.11668022,
    'gap': -0.04453097742,
    'open stairs': -0.05392509851,
    'bridge': -57.54093515,
    'rolled': 7.035394384,
    'cylinder': -44.28081423,
    'box': -6.906271671,
    'kerb': 7.385156819,
    'edge': 12.11730107,
    'ramp': -8.825544411,
}
IMAGES = {
    'kinect': (0.972253, 3113.51, 0.0, 10.167, 0.925833, 2115.45, 0.0, 4.68682),
    'realsense': (0.95099, 2601.27, 18.0, 23.3371, 0.948438, 2014.9, 11.0, 15.7037),
    'tof': (0.955378, 2902.32, 9.0, 12.2125, 0.997383, 2113.8, 6.0, 9.09597),
    'lidar': (1.0, 3027.22, 2.0, 9.29146, 1.0, 2112.6, 1.0, 6.99996),
    'ideal': (1.0, 3.12227, 0.00119519, 0.00776545, 1.0, 2.11344, 9.17912e-05, 0.00465262),
}


@pytest.mark.parametrize(('name', 'expected'), SCENES.items())
def test_scenes_are_those_that_were_measured(name, expected):
    build = {'room': kinect_room, 'curved': curved_scene}[name]
    scenes = [build(seed, 4) for seed in SEEDS]
    walks = [walk(scene.poses[0], seed, 9) for seed, scene in enumerate(scenes)]
    found = checksum(
        [*map(astuple, scenes), *(astuple(pose) for poses in walks for pose in poses)]
    )
    assert found == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(('kind', 'expected'), TERRAINS.items())
def test_terrains_are_those_that_were_measured(kind, expected):
    if kind in PIECES:
        scenes = [piece_scene(kind, 0.2, 1.5, 0.6, seed) for seed in SEEDS]
    else:
        scenes = [terrain_scene(kind, seed) for seed in SEEDS]
    found = checksum(terrain_checksums(scene, seed) for seed, scene in enumerate(scenes))
    # Depths are in float32.
    assert found == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(('name', 'expected'), IMAGES.items())
def test_sensors_are_those_that_were_measured(name, expected):
    """Of two rooms: the share that is measured, the mean depth and its roughness, metres."""
    found = []
    for seed in (0, 1):
        sensor = SENSORS[name](seed)
        depth = simulate(kinect_room(seed), sensor, resize(sensor.camera, 320, 240)).depth
        depth = np.where(depth > 0, depth.astype(float), np.nan)
        step = np.abs(np.diff(depth, axis=1))
        found += [np.isfinite(depth).mean(), np.nanmean(depth), np.nanmedian(step)]
        found += [np.nanmean(np.minimum(step, np.nanmean(depth) / 50))]
    # Rounding decides single pixels.
    assert found == pytest.approx(expected, rel=5e-4)
