"""Writers of rosbag2: any messages, and depth images."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags import rosbag2
from rosbags.interfaces import Connection
from rosbags.typesys import Stores
from scipy.spatial.transform import Rotation

from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.io.files import replacing
from rangeseg_ros.io.message_types import (
    CAMERA_INFO,
    IMAGE,
    TRANSFORMS,
    make_rosbags,
    message_types,
)
from rangeseg_ros.io.recordings import BagError
from rangeseg_ros.messages.cameras import camera_info_message
from rangeseg_ros.messages.images import image_message


class BagWriter(rosbag2.Writer):
    """Writer of a rosbag2 (mcap, version 9).

    Parameters
    ----------
    path : Path
        Directory to make.
    compressed : bool
        Compress the chunks with zstd.
    """

    def __init__(self, path: Path, compressed: bool = False) -> None:
        super().__init__(path, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
        if compressed:
            self.set_compression(rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD)


class DepthBagWriter:
    """Writes depth frames of one camera to a new rosbag2 (mcap).

    The topics are those to which the node listens by default; raw images of a camera that is no
    pinhole go to image_raw. The recording appears under its name once it is complete.

    Parameters
    ----------
    path : Path
        Directory to make.
    camera : Camera
        Intrinsics, written with every image.
    frame_id : str
        Optical frame of the camera.

    Raises
    ------
    BagError
        `path` exists, an image does not have the camera's size or a depth image's type, or a stamp
        is beyond the 32 bits that ROS 2 has for seconds.

    Examples
    --------
    >>> with DepthBagWriter(path, camera) as bag:
    ...     bag.write(depth, stamp)
    """

    camera_topic = '/depth/camera_info'
    transform_topic = '/tf'

    def __init__(
        self, path: Path, camera: Camera, frame_id: str = 'camera_depth_optical_frame'
    ) -> None:
        self.path = Path(path)
        self.camera = camera
        self.frame_id = frame_id
        self.depth_topic = '/depth/image_rect' if camera.pinhole else '/depth/image_raw'
        self._store = message_types(Stores.ROS2_JAZZY)

    def __enter__(self) -> DepthBagWriter:
        if self.path.exists():
            raise BagError(f'{self.path}: exists already, not overwritten')
        with ExitStack() as stack:
            partial = stack.enter_context(replacing(self.path))
            self._writer = stack.enter_context(BagWriter(partial))
            self._files = stack.pop_all()
        self._image = self._writer.add_connection(self.depth_topic, IMAGE, typestore=self._store)
        self._info = self._writer.add_connection(
            self.camera_topic, CAMERA_INFO, typestore=self._store
        )
        self._transforms: Connection | None = None
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._files.__exit__(kind, error, trace)

    def write(self, depth: NDArray[np.uint16] | NDArray[np.float32], stamp: int) -> None:
        """Append an image, (H, W) uint16 millimetres or float32 metres, at `stamp` nanoseconds."""
        if not -(2**31) <= stamp // 10**9 < 2**31:
            raise BagError(f'stamp of {stamp // 10**9} s is beyond the range of ROS 2')
        encodings = {np.dtype(np.uint16): '16UC1', np.dtype(np.float32): '32FC1'}
        if depth.shape != self.camera.shape or depth.dtype not in encodings:
            raise BagError(
                f'depth image must be {self.camera.shape} uint16 or float32, '
                f'not {depth.shape} {depth.dtype}'
            )
        header = self._header(stamp, self.frame_id)
        image = image_message(make_rosbags, header, depth, encodings[depth.dtype])
        info = camera_info_message(make_rosbags, header, self.camera)
        for connection, message in ((self._info, info), (self._image, image)):
            self._append(connection, stamp, message)

    def write_pose(self, pose: Transform, stamp: int, parent: str = 'world') -> None:
        """Append to /tf where the camera is in `parent` at `stamp` nanoseconds."""
        if self._transforms is None:
            self._transforms = self._writer.add_connection(
                self.transform_topic, TRANSFORMS, typestore=self._store
            )
        types = self._store.types
        transform = types['geometry_msgs/msg/TransformStamped'](
            header=self._header(stamp, parent),
            child_frame_id=self.frame_id,
            transform=types['geometry_msgs/msg/Transform'](
                translation=types['geometry_msgs/msg/Vector3'](*pose.shift.tolist()),
                rotation=types['geometry_msgs/msg/Quaternion'](
                    *Rotation.from_matrix(pose.rotation).as_quat().tolist()
                ),
            ),
        )
        self._append(self._transforms, stamp, types[TRANSFORMS]([transform]))

    def _header(self, stamp: int, frame_id: str) -> Any:
        time = self._store.types['builtin_interfaces/msg/Time'](*divmod(stamp, 10**9))
        return self._store.types['std_msgs/msg/Header'](time, frame_id)

    def _append(self, connection: Connection, stamp: int, message: Any) -> None:
        data = self._store.serialize_cdr(message, connection.msgtype)
        self._writer.write(connection, stamp, data)
