"""The sensors by name."""

from __future__ import annotations

from collections.abc import Callable

from rangeseg_ros.simulation.sensors.ideal import Ideal
from rangeseg_ros.simulation.sensors.kinect import Kinect
from rangeseg_ros.simulation.sensors.lidar import Lidar
from rangeseg_ros.simulation.sensors.sensor import Sensor
from rangeseg_ros.simulation.sensors.stereo import RealSense
from rangeseg_ros.simulation.sensors.time_of_flight import TimeOfFlight

SENSORS: dict[str, Callable[[int], Sensor]] = {
    'kinect': Kinect,
    'realsense': RealSense,
    'tof': TimeOfFlight,
    'lidar': lambda _seed: Lidar(),
    'ideal': lambda _seed: Ideal(),
}
"""Sensor of a name, by its seed: which one of its kind, with its fixed errors."""
