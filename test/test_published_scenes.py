"""Simulated scenes and sensors are those that the figures of the documents were measured on.

As a program it records them anew, for when they are to be others: then the figures are, too.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from rangeseg_ros.simulation.render import simulate
from rangeseg_ros.simulation.scenes import curved_scene, kinect_room
from rangeseg_ros.simulation.sensors.catalogue import SENSORS
from rangeseg_ros.simulation.sensors.sensor import resize
from rangeseg_ros.simulation.terrain.frame import simulate_terrain
from rangeseg_ros.simulation.terrain.kinds import HARD, KINDS, stated, terrain_scene
from rangeseg_ros.simulation.terrain.testpieces import all_pieces, piece_scene

RECORDED = Path(__file__).with_name('published_scenes.json')
SEEDS = range(1, 5)


def inverse_of(frame):
    """1/z (H, W), 1/m; 0 where nothing is measured."""
    metres = frame.depth / (1000 if frame.depth.dtype == np.uint16 else 1)
    return np.divide(1, metres, out=np.zeros(metres.shape), where=metres > 0)


def terrain(scenes):
    """Means over what an ideal sensor sees: 1/z, class, height, and the up and height stated."""
    sensor = SENSORS['ideal'](0)
    camera, told = resize(sensor.camera, 64, 48), []
    for seed, scene in scenes:
        frame = simulate_terrain(scene, sensor, camera, seed)
        up, height = stated(scene, seed)
        told.append([inverse_of(frame).mean(), frame.terrain.mean(), np.nanmean(frame.height)])
        told[-1] += [*up, height]
    return np.mean(told, axis=0)


def room(build):
    """Means over two frames of rooms that an ideal sensor sees: 1/z, its square, label."""
    camera, told = resize(SENSORS['ideal'](0).camera, 64, 48), []
    for seed in SEEDS:
        for k in (0, 1):
            frame = simulate(build(seed, 20), SENSORS['ideal'](0), camera, frame=19 * k)
            inverse = inverse_of(frame)
            told.append([inverse.mean(), (inverse**2).mean(), (frame.labels < 99).mean()])
    return np.mean(told, axis=0)


def errors(name):
    """Share of rooms that sensors measure, their error in 1/z and that from pixel to pixel."""
    told, ideal = [], SENSORS['ideal'](0)
    for seed in SEEDS:
        sensor = SENSORS[name](seed)
        camera = resize(sensor.camera, 80, 60)
        frame, truth = (
            simulate(kinect_room(seed), each, camera, seed=seed) for each in (sensor, ideal)
        )
        both = (frame.depth > 0) & (truth.depth > 0)
        error = np.where(both, inverse_of(frame) - inverse_of(truth), 0)
        told.append([both.mean(), np.abs(error).mean(), np.abs(np.diff(error)).mean()])
    return np.mean(told, axis=0)


def figures():
    kinds = {
        kind: terrain((seed, terrain_scene(kind, seed)) for seed in SEEDS)
        for kind in (*KINDS, *HARD)
    }
    for piece in sorted({kind for kind, *_ in all_pieces()}):
        scenes = [(1, piece_scene(*each, 0.8, 1)) for each in all_pieces() if each[0] == piece]
        kinds[piece] = terrain(scenes)
    rooms = {build.__name__: room(build) for build in (kinect_room, curved_scene)}
    sensors = {name: errors(name) for name in SENSORS}
    return {
        name: [float(f'{value:.5g}') for value in values]
        for name, values in {**kinds, **rooms, **sensors}.items()
    }


def test_scenes_and_sensors_are_those_of_the_figures():
    recorded, found = json.loads(RECORDED.read_text()), figures()
    assert found.keys() == recorded.keys()
    for name, values in recorded.items():
        # A pixel at an edge is a tenth of a thousandth.
        assert found[name] == pytest.approx(values, rel=1e-3, abs=1e-5), name


if __name__ == '__main__':
    lines = (f'{json.dumps(name)}: {values}' for name, values in figures().items())
    RECORDED.write_text('{\n' + ',\n'.join(lines) + '\n}\n')
