"""A node under test in its own process, with a publisher and subscribers on real DDS."""

import os
import signal
import subprocess
import sys
import time
from array import array

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from visualization_msgs.msg import MarkerArray

from rangeseg_ros.simulation.kinect import kinect_camera

TYPES = {'labels': Image, 'planes': PointCloud2, 'markers': MarkerArray, 'overlay': Image}
RELIABLE = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
FRAME = 'camera_depth_optical_frame'

os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ['ROS_DOMAIN_ID'] = str(1 + os.getpid() % 100)


def corner_depth(camera):
    """Depth of two walls that meet in a vertical edge, millimetres: planes -+x + z = 2 m."""
    x = camera.rays[..., 0]
    return np.round(1000 * 2 / (1 + np.abs(x))).astype(np.uint16)


class Bench:
    """Starts `segment_planes` and talks to it."""

    def __init__(self, *arguments, camera=None, namespace='', command=None):
        self.camera = camera or kinect_camera(160, 120)
        self.received = {name: [] for name in [*TYPES, 'diagnostics']}
        command = command or [sys.executable, '-m', 'rangeseg_ros.ros.node']
        self.process = subprocess.Popen(
            [*command, '--ros-args', '-r', f'__ns:=/{namespace}', *arguments],
            start_new_session=True,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node('bench', context=self.context)
        self.executor = rclpy.executors.SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.name = f'{namespace}/segment_planes'.lstrip('/')
        self.listen('diagnostics', '/diagnostics', DiagnosticArray)
        self.clients = {
            kind: self.node.create_client(kind, f'/{self.name}/{service}')
            for kind, service in (
                (SetParameters, 'set_parameters'),
                (SetParametersAtomically, 'set_parameters_atomically'),
            )
        }
        self.stamps = 0

    def listen(self, name, topic=None, kind=None):
        """Subscribe to an output of the node."""
        return self.node.create_subscription(
            kind or TYPES[name],
            topic or f'/{self.name}/{name}',
            self.received[name].append,
            RELIABLE,
        )

    def advertise(self, kind, topic, qos=RELIABLE):
        return self.node.create_publisher(kind, topic, qos)

    def spin(self, seconds):
        self.until(lambda: False, seconds, required=False)

    def until(self, condition, timeout=20.0, required=True):
        """Spin until the condition holds; its value."""
        end = time.monotonic() + timeout
        while not (value := condition()) and time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.02)
        assert value or not required, f'not within {timeout} s: {self.complaints()}'
        return value

    def header(self):
        """Header with a stamp of its own."""
        message = Image()
        message.header.stamp = self.node.get_clock().now().to_msg()
        message.header.frame_id = FRAME
        return message.header

    def image(self, depth=None, encoding='16UC1', **fields):
        """Depth image message, by default of two walls."""
        depth = corner_depth(self.camera) if depth is None else depth
        message = Image(header=self.header(), encoding=encoding, step=depth.strides[0])
        message.height, message.width = depth.shape
        message.data = array('B', depth.tobytes())
        for name, value in fields.items():
            setattr(message, name, value)
        return message

    def info(self, camera=None, **fields):
        """CameraInfo message of the bench's camera."""
        camera = camera or self.camera
        message = CameraInfo(header=self.header(), height=camera.height, width=camera.width)
        message.k = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
        for name, value in fields.items():
            setattr(message, name, value)
        return message

    def labels_of(self, image):
        """The label image of an image that was published."""
        return self.until(
            lambda: next(
                (m for m in self.received['labels'] if m.header.stamp == image.header.stamp), None
            )
        )

    def status(self, condition):
        """The first diagnostic status from now on that satisfies the condition."""
        self.received['diagnostics'].clear()

        def found():
            for report in self.received['diagnostics']:
                if condition(report.status[0]):
                    return report.status[0]
            return None

        return self.until(found)

    def set_parameters(self, atomically=False, **values):
        """Set parameters by the node's service; its results."""
        kind = SetParametersAtomically if atomically else SetParameters
        parameters = [Parameter(name, value=value) for name, value in values.items()]
        self.until(self.clients[kind].service_is_ready)
        future = self.clients[kind].call_async(
            kind.Request(parameters=[p.to_parameter_msg() for p in parameters])
        )
        self.until(future.done)
        return future.result().result if atomically else future.result().results

    def complaints(self):
        return f'node has ended with {self.process.poll()}' if self.process.poll() else ''

    def close(self):
        """Stop the node; its exit code and what it wrote to stderr."""
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGINT)
        try:
            _, errors = self.process.communicate(timeout=20)
        except subprocess.TimeoutExpired:
            os.killpg(self.process.pid, signal.SIGKILL)
            raise
        finally:
            self.executor.shutdown()
            self.node.destroy_node()
            rclpy.try_shutdown(context=self.context)
        return self.process.returncode, errors
