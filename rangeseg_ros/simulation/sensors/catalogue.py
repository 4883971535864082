"""The sensors by name."""

from rangeseg_ros.simulation.sensors.kinect import Kinect
from rangeseg_ros.simulation.sensors.lidar import Lidar
from rangeseg_ros.simulation.sensors.sensor import Ideal, Sensor
from rangeseg_ros.simulation.sensors.stereo import RealSense
from rangeseg_ros.simulation.sensors.time_of_flight import TimeOfFlight

SENSORS: dict[str, type[Sensor]] = {
    'kinect': Kinect,
    'realsense': RealSense,
    'tof': TimeOfFlight,
    'lidar': Lidar,
    'ideal': Ideal,
}
"""Kind of sensor of a name; it takes the seed that tells which one of its kind it is."""
