"""Messages of tf2 into a buffer of transforms."""

from __future__ import annotations

from typing import Any

from rangeseg_ros.core.mapping.transforms import TransformBuffer, TransformError
from rangeseg_ros.messages.make import nanoseconds


def insert_transforms(buffer: TransformBuffer, message: Any, static: bool) -> list[str]:
    """Take in a tf2_msgs/TFMessage of /tf, or `static` of /tf_static.

    Returns what is wrong with transforms that were left out.
    """
    problems = []
    for stamped in message.transforms:
        turn, place = stamped.transform.rotation, stamped.transform.translation
        try:
            buffer.insert(
                stamped.header.frame_id,
                stamped.child_frame_id,
                nanoseconds(stamped.header.stamp),
                (turn.x, turn.y, turn.z, turn.w),
                (place.x, place.y, place.z),
                static,
            )
        except TransformError as error:
            problems.append(str(error))
    return problems
