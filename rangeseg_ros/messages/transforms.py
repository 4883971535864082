"""Messages of tf2 into a buffer of transforms."""

from __future__ import annotations

from typing import Any

from rangeseg_ros.core.mapping.transforms import TransformBuffer, TransformError


def insert_transforms(buffer: TransformBuffer, message: Any, static: bool) -> list[str]:
    """Take in a tf2_msgs/TFMessage of /tf, or `static` of /tf_static.

    Returns
    -------
    list of str
        What is wrong with transforms that were left out.
    """
    problems = []
    for stamped in message.transforms:
        stamp = stamped.header.stamp
        turn, place = stamped.transform.rotation, stamped.transform.translation
        try:
            buffer.insert(
                stamped.header.frame_id,
                stamped.child_frame_id,
                # ROS 1 calls the parts secs and nsecs; rosbags gives both the names of ROS 2.
                stamp.sec * 10**9 + stamp.nanosec,
                (turn.x, turn.y, turn.z, turn.w),
                (place.x, place.y, place.z),
                static,
            )
        except TransformError as error:
            problems.append(str(error))
    return problems
