"""Writers of rosbag2: any messages, and depth images."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags import rosbag2
from rosbags.interfaces import Connection
from rosbags.typesys import Stores

from rangeseg_ros.core.arrays import Singles
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.rotations import quaternions
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.io.files import replacing
from rangeseg_ros.io.recordings import BagError, make_rosbags, message_types
from rangeseg_ros.messages.cameras import camera_info_message
from rangeseg_ros.messages.images import image_message
from rangeseg_ros.messages.make import CAMERA_INFO, IMAGE, TRANSFORMS, header_of, vector


class BagWriter(rosbag2.Writer):
    """Writer of a rosbag2 (mcap, version 9) in a directory to make, or compressed with zstd."""

    def __init__(self, path: Path, compressed: bool = False) -> None:
        super().__init__(path, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
        if compressed:
            self.set_compression(rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD)
        self.types = message_types(Stores.ROS2_JAZZY)

    def topic(self, name: str, kind: str) -> Connection:
        """Begin a topic of a type of messages."""
        return self.add_connection(name, kind, typestore=self.types)

    def serialised(self, topic: Connection, message: Any) -> bytes:
        """A message of `make_rosbags` as it is written; bytes as they are."""
        if isinstance(message, bytes):
            return message
        return bytes(self.types.serialize_cdr(message, topic.msgtype))


class DepthBagWriter:
    """Writes depth frames of one camera to a new rosbag2 (mcap).

    The topics are those to which the node listens by default; raw images of a camera that is no
    pinhole go to image_raw. The intrinsics are written with every image; `frame_id` is the optical
    frame of the camera. The recording, a directory, appears under its name once it is complete;
    BagError where something is there.
    """

    def __init__(
        self, path: Path, camera: Camera, frame_id: str = 'camera_depth_optical_frame'
    ) -> None:
        self._path, self._camera, self._frame_id = Path(path), camera, frame_id
        self._topics: dict[str, Connection] = {}
        self._files = ExitStack()

    def __enter__(self) -> DepthBagWriter:
        if self._path.exists():
            raise BagError(f'{self._path}: exists already, not overwritten')
        with ExitStack() as stack:
            partial = stack.enter_context(replacing(self._path))
            self._bag = stack.enter_context(BagWriter(partial))
            self._files = stack.pop_all()
        return self

    def __exit__(self, *exception: Any) -> None:
        self._files.__exit__(*exception)

    def write(self, depth: NDArray[np.uint16] | Singles, stamp: int) -> None:
        """Append an image, (H, W) uint16 millimetres or float32 metres, at `stamp` nanoseconds.

        BagError: another size or type, or a stamp beyond the 32 bits of ROS 2 for seconds.
        """
        if not -(2**31) <= stamp // 10**9 < 2**31:
            raise BagError(f'stamp of {stamp // 10**9} s is beyond the range of ROS 2')
        camera = self._camera
        encodings = {np.dtype(np.uint16): '16UC1', np.dtype(np.float32): '32FC1'}
        if depth.shape != camera.shape or depth.dtype not in encodings:
            raise BagError(
                f'depth image must be {camera.shape} uint16 or float32, '
                f'not {depth.shape} {depth.dtype}'
            )
        header = header_of(make_rosbags, stamp, self._frame_id)
        info = camera_info_message(make_rosbags, header, camera)
        image = image_message(make_rosbags, header, depth, encodings[depth.dtype])
        self._append('/depth/camera_info', CAMERA_INFO, stamp, info)
        name = 'image_rect' if camera.pinhole else 'image_raw'
        self._append(f'/depth/{name}', IMAGE, stamp, image)

    def write_pose(self, pose: Transform, stamp: int) -> None:
        """Append to /tf where the camera is in `world` at `stamp` nanoseconds."""
        transform = make_rosbags(
            'geometry_msgs/msg/TransformStamped',
            header=header_of(make_rosbags, stamp, 'world'),
            child_frame_id=self._frame_id,
            transform=make_rosbags(
                'geometry_msgs/msg/Transform',
                translation=vector(make_rosbags, 'Vector3', pose.shift),
                rotation=vector(make_rosbags, 'Quaternion', quaternions(pose.rotation)),
            ),
        )
        self._append('/tf', TRANSFORMS, stamp, make_rosbags(TRANSFORMS, transforms=[transform]))

    def _append(self, name: str, kind: str, stamp: int, message: Any) -> None:
        if name not in self._topics:
            self._topics[name] = self._bag.topic(name, kind)
        topic = self._topics[name]
        self._bag.write(topic, stamp, self._bag.serialised(topic, message))
