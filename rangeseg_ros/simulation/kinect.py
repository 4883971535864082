"""Rooms as a Kinect sees them."""

from __future__ import annotations

from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.simulation.render import Frame, simulate
from rangeseg_ros.simulation.scenes import Scene
from rangeseg_ros.simulation.sensors.kinect import Kinect


def simulate_kinect(
    scene: Scene,
    camera: Camera | None = None,
    *,
    noise: str = 'measured',
    sensor_seed: int = 0,
    frame: int = 0,
    seed: int = 0,
) -> Frame:
    """`simulate` with a `Kinect` of that seed and noise."""
    return simulate(scene, Kinect(sensor_seed, noise), camera, frame=frame, seed=seed)
