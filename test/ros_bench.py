"""A node under test in its own process, with a publisher and subscribers on real DDS."""

import itertools
import os
import signal
import subprocess
import sys
import tempfile
import time
from array import array
from contextlib import AbstractContextManager, contextmanager

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from message_classes import cdr
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosbags import rosbag2
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_msgs.msg import Header

from rangeseg_ros.messages.make import message_class
from rangeseg_ros.messages.motion import ODOMETRY
from rangeseg_ros.messages.outputs import OUTPUTS
from rangeseg_ros.simulation.sensors.kinect import kinect_camera

TYPES = {name: message_class(output.kind) for name, output in OUTPUTS.items()}
TYPES['odometry'] = message_class(ODOMETRY)
RELIABLE = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
DEPTH, INFO = '/depth/image_rect', '/depth/camera_info'
NODE = [sys.executable, '-c', 'from rangeseg_ros.start import segment_planes; segment_planes()']
FRAME = 'camera_depth_optical_frame'

os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
# In which nobody hears another bench, of this process or of a worker beside it.
_domains = itertools.cycle(range(1 + (os.environ.get('PYTEST_XDIST_WORKER') == 'gw1'), 101, 2))
DOMAINS = map(str, itertools.islice(_domains, os.getpid() % 50, None))
os.environ['ROS_DOMAIN_ID'] = next(DOMAINS)


def corner_depth(camera):
    """Depth of two walls that meet in a vertical edge, millimetres: planes -+x + z = 2 m."""
    return np.round(1000 * 2 / (1 + np.abs(camera.rays[..., 0]))).astype(np.uint16)


def assert_replayed(bench, folder, topics, count):
    """The node has published, byte for byte, what a replay has written into a folder."""
    with rosbag2.Reader(folder / 'bag') as bag:
        written = [(connection.topic, bytes(data)) for connection, _, data in bag.messages()]
    for name, kind in topics.items():
        published = [cdr(message, kind) for message in bench.received[name]]
        replayed = [data for topic, data in written if topic == f'/segment_planes/{name}']
        assert len(replayed) == count and published == replayed, name


def values_of(status):
    """Values of a diagnostic status by their keys."""
    return {value.key: value.value for value in status.values}


@contextmanager
def ended(process):
    """Leave no process behind, whatever comes."""
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@contextmanager
def started(outputs=('labels',), **parameters):
    """A node with a listener for outputs and a reliable camera."""
    with Bench(**parameters) as bench, bench.listening(*outputs), bench.camera_on():
        yield bench


def benches(*outputs, **parameters):
    """Fixtures: the node of a module, and it with a listener for outputs and a reliable camera."""

    @pytest.fixture(scope='module')
    def node():
        with Bench(**parameters) as bench:
            yield bench

    @pytest.fixture
    def bench(node):
        with node.listening(*outputs), node.camera_on():
            yield node

    return node, bench


class Bench(AbstractContextManager):
    """Starts `segment_planes` and talks to it."""

    def __init__(
        self, *given, camera=None, namespace='', name='segment_planes', command=NODE, **parameters
    ):
        self.camera = camera or kinect_camera(160, 120)
        self.topics = [f'/{namespace}{topic}'.replace('//', '/') for topic in (DEPTH, INFO)]
        set_to = [word for key in parameters for word in ('-p', f'{key}:={parameters[key]}')]
        self.received = {name: [] for name in [*TYPES, 'diagnostics']}
        self.inputs = set()
        self.spins = False
        self.errors = tempfile.TemporaryFile('w+')  # noqa: SIM115
        self.domain = os.environ['ROS_DOMAIN_ID']
        os.environ['ROS_DOMAIN_ID'] = next(DOMAINS)
        self.process = subprocess.Popen(
            [*command, '--ros-args', '-r', f'__ns:=/{namespace}', *given, *set_to],
            start_new_session=True,
            stderr=self.errors,
        )
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node('bench', context=self.context)
        self.executor = rclpy.executors.SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.name = f'{namespace}/{name}'.lstrip('/')
        subscribe, callback = self.node.create_subscription, self._on_diagnostics
        subscribe(DiagnosticArray, '/diagnostics', callback, RELIABLE)
        service = f'/{self.name}/set_parameters_atomically'
        self.client = self.node.create_client(SetParametersAtomically, service)

    @contextmanager
    def listening(self, *names):
        """Subscribe to outputs of the node; afterwards it has let go of its inputs."""
        subscribe, own, received = self.node.create_subscription, f'/{self.name}/', self.received
        subscriptions = [
            subscribe(TYPES[name], own + name, received[name].append, RELIABLE) for name in names
        ]
        try:
            self.until(lambda: all(s.get_publisher_count() for s in subscriptions))
            yield
        finally:
            for subscription in subscriptions:
                self.node.destroy_subscription(subscription)
        if not any(s.topic_name.startswith(own) for s in self.node.subscriptions):
            for topic in self.inputs:
                self.ignored(topic)

    @contextmanager
    def advertised(self, kind, topic, qos=RELIABLE):
        """Advertise a topic; its publisher."""
        publisher = self.node.create_publisher(kind, topic, qos)
        try:
            yield publisher
        finally:
            self.node.destroy_publisher(publisher)

    @contextmanager
    def camera_on(self, topic=None, kind=Image, qos=RELIABLE):
        """Advertise depth and camera_info, and wait for the subscriptions of the node."""
        depth_topic, info_topic = topic or self.topics[0], self.topics[1]
        with (
            self.advertised(kind, depth_topic, qos) as self.depth,
            self.advertised(CameraInfo, info_topic, qos) as self.camera_info,
        ):
            self.settled(depth_topic, qos.reliability)
            if kind is not PointCloud2:
                self.settled(info_topic, qos.reliability)
            yield

    def settled(self, topic, reliability):
        """Wait until the node subscribes with that reliability."""

        def subscribed():
            endpoints = self.node.get_subscriptions_info_by_topic(topic)
            return [end.qos_profile.reliability for end in endpoints] == [reliability]

        self.inputs.add(topic)
        self.until(subscribed)
        publishers = [p for p in self.node.publishers if p.topic_name == topic]
        self.until(lambda: all(p.get_subscription_count() for p in publishers))

    def ignored(self, topic):
        """Wait until the node does not subscribe; one that has ended does not."""
        endpoints = self.node.get_subscriptions_info_by_topic
        self.until(lambda: self.process.poll() is not None or not endpoints(topic))

    def segment(self, image=None, info=None):
        """Publish an image with its camera_info; the labels (H, W) that come back."""
        return self.labels_of(self.send(image, info))

    def send(self, image=None, info=None):
        """Publish an image with its camera_info; the image."""
        image = image or self.image()
        self.camera_info.publish(info or self.info())
        self.depth.publish(image)
        return image

    def repeat(self, action, condition):
        """Do something five times a second until the condition holds; its value."""
        due = 0.0

        def found():
            nonlocal due
            if time.monotonic() >= due:
                due = time.monotonic() + 0.2
                action()
            return condition()

        return self.until(found)

    def status(self, condition, publish=lambda: None):
        """The first diagnostic status from now on that satisfies the condition."""
        self.received['diagnostics'].clear()

        def found():
            statuses = (report.status[0] for report in self.received['diagnostics'])
            return next(filter(condition, statuses), None)

        return self.repeat(publish, found)

    def error(self, words, publish=lambda: None):
        """The first error of the diagnostics from now on that says so."""
        error = DiagnosticStatus.ERROR
        return self.status(lambda s: s.level == error and words in s.message, publish)

    def stream(self):
        """Publish images until one comes back, as best effort has no promise for the first."""
        sent = []

        def answered():
            return next((image for image in sent if self.find('labels', image)), None)

        return self.labels_of(self.repeat(lambda: sent.append(self.send()), answered))

    def spin(self, seconds):
        end = time.monotonic() + seconds
        self.until(lambda: time.monotonic() > end)

    def until(self, condition):
        """Spin until the condition holds; its value. A loaded machine compiles for minutes."""
        end = time.monotonic() + 500
        while not (value := condition()):
            assert self.process.poll() is None, f'the node has ended: {self.complaints()}'
            assert time.monotonic() < end, f'not in time: {self.complaints()}'
            self.executor.spin_once(timeout_sec=0.02)
        return value

    def header(self):
        """Header with a stamp of its own."""
        return Header(stamp=self.node.get_clock().now().to_msg(), frame_id=FRAME)

    def image(self, depth=None, encoding='16UC1', **fields):
        """Depth image message, by default of two walls."""
        depth = corner_depth(self.camera) if depth is None else depth
        known = dict(zip(('height', 'width'), depth.shape, strict=True))
        known |= {'header': self.header(), 'encoding': encoding, 'step': depth.strides[0]}
        return Image(**{**known, 'data': array('B', depth.tobytes()), **fields})

    def info(self, camera=None, **fields):
        """CameraInfo message of the bench's camera."""
        camera = camera or self.camera
        known = {'header': self.header(), 'height': camera.height, 'width': camera.width}
        return CameraInfo(**{**known, 'k': camera.matrix.ravel(), **fields})

    def labels_of(self, image):
        """Labels (H, W) of an image that was published."""
        message = self.answer('labels', image)
        return np.frombuffer(message.data, np.uint16).reshape(message.height, message.width)

    def find(self, name, image):
        """The message of an output with the stamp of an image; None when it is not there."""
        stamp = image.header.stamp
        return next((m for m in self.received[name] if m.header.stamp == stamp), None)

    def answer(self, name, image):
        """That message once it is there."""
        return self.until(lambda: self.find(name, image))

    def call(self, client, **fields):
        """The response of a service to a request."""
        self.until(client.service_is_ready)
        future = client.call_async(client.srv_type.Request(**fields))
        self.until(future.done)
        return future.result()

    def set_parameters(self, **values):
        """Set parameters by the node's service, which must take them."""
        parameters = [Parameter(n, value=v).to_parameter_msg() for n, v in values.items()]
        assert self.call(self.client, parameters=parameters).result.successful

    def in_use(self):
        """Wait until the parameters that were set have the kernels they need."""
        self.status(lambda status: values_of(status)['parameters'] == 'in use')

    def complaints(self):
        """What there is to know when the node does not do what it should."""
        report = self.received['diagnostics'][-1:]
        return f'exit code {self.process.poll()}, {report}\n{self.log()}'

    def _on_diagnostics(self, report):
        # Other nodes report there, too.
        if report.status[0].name.startswith(f'{self.name}:'):
            self.spins = True
            self.received['diagnostics'].append(report)

    def log(self):
        """What the node has written to stderr."""
        self.errors.seek(0)
        return self.errors.read()

    def interrupt(self):
        """Press Ctrl-C."""
        os.killpg(self.process.pid, signal.SIGINT)

    def __exit__(self, *exception):
        """Stop the node, which must end well."""
        try:
            if self.process.poll() is None:
                # Interrupted before it spins it would end with another code.
                self.until(lambda: self.spins)
                self.interrupt()
            code = self.process.wait(timeout=60)
        finally:
            if self.process.poll() is None:
                os.killpg(self.process.pid, signal.SIGKILL)
            self.executor.shutdown()
            self.node.destroy_node()
            rclpy.try_shutdown(context=self.context)
            os.environ['ROS_DOMAIN_ID'] = self.domain
        assert code == 0 and 'Traceback' not in self.log(), f'exit code {code}: {self.log()}'
