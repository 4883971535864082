"""Depth messages, live or recorded, with what is needed to make range images of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Singles
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.messages.clouds import points_from_message
from rangeseg_ros.messages.images import depth_from_message
from rangeseg_ros.messages.make import nanoseconds


@dataclass(frozen=True, eq=False)
class DepthFrame:
    """A depth message to be segmented, decoded when asked for.

    A sensor_msgs/Image or CompressedImage with its camera, or a PointCloud2 without; `time` is
    when it arrived or was recorded, nanoseconds.
    """

    message: Any
    camera: Camera | None
    time: int

    @property
    def stamp(self) -> int:
        """Time of the measurement (header stamp), nanoseconds."""
        return nanoseconds(self.message.header.stamp)

    @property
    def frame_id(self) -> str:
        """Frame of the image or cloud."""
        return str(self.message.header.frame_id)

    @property
    def depth(self) -> NDArray[np.uint16] | Singles:
        """Depth image (H, W): millimetres with 0 invalid, or metres with NaN or <= 0 invalid."""
        return depth_from_message(self.message, self.camera.shape if self.camera else None)

    def range_image(self) -> RangeImage:
        """Range image of the message; ValueError says what is wrong with it."""
        if self.stamp // 10**9 >= 2**31:  # ROS 1 has one bit more
            raise ValueError(f'stamp of {self.stamp // 10**9} s is beyond the range of ROS 2')
        if self.camera is None:
            return RangeImage.from_points(points_from_message(self.message))
        return RangeImage.from_depth(self.depth, self.camera)
