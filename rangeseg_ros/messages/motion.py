"""Where frames are: the motion of the camera out, messages of tf2 in."""

from __future__ import annotations

from typing import Any

from rangeseg_ros.core.mapping.odometry import Motion
from rangeseg_ros.core.mapping.transforms import TransformBuffer, TransformError
from rangeseg_ros.core.rotations import quaternions
from rangeseg_ros.messages.make import ODOMETRY, Make, header_of, nanoseconds, pose_of, vector


def odometry_message(make: Make, header: Any, motion: Motion) -> Any:
    """nav_msgs/Odometry: the pose in the frame of the odometry, the twist in that of the image.

    `header` is that of the image.
    """
    twist = make(
        'geometry_msgs/msg/Twist',
        linear=vector(make, 'Vector3', motion.velocity[:3]),
        angular=vector(make, 'Vector3', motion.velocity[3:]),
    )
    return make(
        ODOMETRY,
        header=header_of(make, header.stamp, motion.frame),
        child_frame_id=header.frame_id,
        pose=make(
            'geometry_msgs/msg/PoseWithCovariance',
            pose=pose_of(make, motion.pose.shift, quaternions(motion.pose.rotation)),
            covariance=motion.covariance.ravel(),
        ),
        twist=make(
            'geometry_msgs/msg/TwistWithCovariance',
            twist=twist,
            covariance=motion.velocity_covariance.ravel(),
        ),
    )


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
