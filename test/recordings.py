"""Recordings for tests, in every format, written with rosbags alone."""

import struct

import cv2
import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

IMAGE = 'sensor_msgs/msg/Image'
COMPRESSED = 'sensor_msgs/msg/CompressedImage'
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
TF, EARLY_TF = 'tf2_msgs/msg/TFMessage', 'tf/msg/tfMessage'
ROS1 = get_typestore(Stores.ROS1_NOETIC)
for tf in (TF, EARLY_TF):
    ROS1.register(get_types_from_msg('geometry_msgs/TransformStamped[] transforms', tf))
ROS2 = get_typestore(Stores.ROS2_JAZZY)
UNKNOWN = 'robot_msgs/msg/Secret'
"""A type of messages that only its recordings define."""
ROS2.register(get_types_from_msg('uint8 x', UNKNOWN))
SUFFIXES = {'mcap': '', 'sqlite3': '', 'rosbag1': '.bag'}
DEPTH, INFO = '/camera/depth/image_rect', '/camera/depth/camera_info'


def stamp_of(number):
    """Nanoseconds of an image, of 30 a second."""
    return 10**18 + number * 33_333_333


def depth_images(count, height=48, width=64):
    """Different, incompressible images: (count, H, W) uint16."""
    return np.random.default_rng(0).integers(0, 5000, (count, height, width)).astype(np.uint16)


class Recording:
    """Messages to record: `add` them, then `write`."""

    def __init__(self, ros1=False):
        self.ros1, self.messages = ros1, []
        self.store = ROS1 if ros1 else ROS2

    def header(self, stamp, frame_id='optical'):
        types = self.store.types
        time = types['builtin_interfaces/msg/Time'](*divmod(stamp, 10**9))
        fields = {'seq': 0} if self.ros1 else {}
        return types['std_msgs/msg/Header'](stamp=time, frame_id=frame_id, **fields)

    def add_image(self, stamp, image, encoding='16UC1', topic=DEPTH):
        data = np.ascontiguousarray(image).view(np.uint8).ravel()
        layout = *image.shape[:2], encoding, 0, image.strides[0]
        message = self.store.types[IMAGE](self.header(stamp), *layout, data)
        self.messages.append((stamp, topic, IMAGE, message))

    def add_compressed(self, stamp, image):
        png = cv2.imencode('.png', image)[1].tobytes()
        data = np.frombuffer(struct.pack('<iff', 0, 0, 0) + png, np.uint8)
        format = '16UC1; compressedDepth png'
        message = self.store.types[COMPRESSED](self.header(stamp), format, data)
        self.messages.append((stamp, f'{DEPTH}/compressedDepth', COMPRESSED, message))

    def add_camera(self, stamp, width=64, height=48, focal=50.0, topic=INFO, **changes):
        k = changes.get('k', np.array([focal, 0, 31.5, 0, focal, 23.5, 0, 0, 1]))
        p, r = np.insert(k, (3, 6, 9), 0.0), np.eye(3).ravel()
        # In the order of the message, in which ROS 1 has capitals.
        matrices = {'d': np.zeros(5), 'k': k, 'r': r, 'p': p} | changes
        roi = self.store.types['sensor_msgs/msg/RegionOfInterest'](0, 0, 0, 0, False)
        layout = self.header(stamp), height, width, 'plumb_bob', *matrices.values(), 0, 0, roi
        self.messages.append((stamp, topic, CAMERA_INFO, self.store.types[CAMERA_INFO](*layout)))

    def add_transform(self, stamp, parent, child, rotation, shift, kind=TF, static=False):
        """A transform of one moment, or for all; rotation x, y, z, w."""
        names = 'Vector3', 'Quaternion', 'Transform', 'TransformStamped'
        vector, turn, both, stamped = (self.store.types[f'geometry_msgs/msg/{n}'] for n in names)
        transform = both(translation=vector(*shift), rotation=turn(*rotation))
        transforms = [stamped(self.header(stamp, parent), child, transform)]
        message = self.store.types[kind](transforms=transforms)
        self.messages.append((stamp, '/tf_static' if static else '/tf', kind, message))

    def write(self, path, storage='mcap', compression=()):
        """Write all messages, compressed as its writer is told; the file that holds them."""
        if self.ros1:
            writer, serialize = rosbag1.Writer(path), self.store.serialize_ros1
        else:
            plugin = rosbag2.StoragePlugin[storage.upper()]
            writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
            serialize = self.store.serialize_cdr
        if compression:
            writer.set_compression(*compression)
        with writer:
            connections = {}
            for stamp, topic, kind, message in self.messages:
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=self.store)
                writer.write(connections[topic], stamp, serialize(message, kind))
        if self.ros1:
            return path
        (file,) = (part for part in path.iterdir() if part.suffix != '.yaml')
        return file


def record(path, storage, images, compressed=False):
    """Record `images` with their camera at 30 Hz; the file that holds the messages."""
    recording = Recording(ros1=storage == 'rosbag1')
    for index, image in enumerate(images):
        recording.add_camera(stamp_of(index), image.shape[1], image.shape[0])
        (recording.add_compressed if compressed else recording.add_image)(stamp_of(index), image)
    return recording.write(path, storage)
