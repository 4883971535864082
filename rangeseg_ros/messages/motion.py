"""The motion of the camera as a message."""

from __future__ import annotations

from typing import Any

from rangeseg_ros.core.mapping.odometry import Motion
from rangeseg_ros.core.rotations import quaternions
from rangeseg_ros.messages.make import Make

ODOMETRY = 'nav_msgs/msg/Odometry'
"""Type of `odometry_message`."""


def odometry_message(make: Make, header: Any, motion: Motion) -> Any:
    """nav_msgs/Odometry: the pose in the frame of the odometry, the twist in that of the image.

    Parameters
    ----------
    make : Make
    header : std_msgs/Header
        Of the image.
    motion : Motion
    """

    def vector(kind: str, values: Any) -> Any:
        named = {name: float(value) for name, value in zip('xyzw', values, strict=False)}
        return make(f'geometry_msgs/msg/{kind}', **named)

    turn, shift = motion.pose
    pose = make(
        'geometry_msgs/msg/Pose',
        position=vector('Point', shift),
        orientation=vector('Quaternion', quaternions(turn)),
    )
    twist = make(
        'geometry_msgs/msg/Twist',
        linear=vector('Vector3', motion.velocity[:3]),
        angular=vector('Vector3', motion.velocity[3:]),
    )
    return make(
        ODOMETRY,
        header=make('std_msgs/msg/Header', stamp=header.stamp, frame_id=motion.frame),
        child_frame_id=header.frame_id,
        pose=make(
            'geometry_msgs/msg/PoseWithCovariance',
            pose=pose,
            covariance=motion.covariance.ravel(),
        ),
        twist=make(
            'geometry_msgs/msg/TwistWithCovariance',
            twist=twist,
            covariance=motion.velocity_covariance.ravel(),
        ),
    )
