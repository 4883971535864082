"""Print the largest planes once a second: how to read ~/planes in a node of one's own."""

import numpy as np
import rclpy
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from rangeseg_ros import planes_from_message


class PrintPlanes(Node):
    def __init__(self):
        super().__init__('print_planes')
        self.create_subscription(PointCloud2, 'segment_planes/planes', self.on_planes, 5)

    def on_planes(self, message):
        planes = planes_from_message(message)  # one row per plane, columns by name
        largest = planes[np.argsort(-planes['area'])][:3]
        lines = [f'{len(planes)} planes in {message.header.frame_id}']
        for plane in largest:
            normal = [float(plane[f'normal_{axis}']) for axis in 'xyz']
            lines.append(
                f'  id {plane["id"]}: normal ({normal[0]:+.3f} {normal[1]:+.3f} {normal[2]:+.3f}),'
                f' distance {plane["distance"]:.3f} m, {plane["area"]:.2f} m2,'
                f' rms {1000 * plane["rms"]:.1f} mm'
            )
        self.get_logger().info('\n'.join(lines), throttle_duration_sec=1.0)


if __name__ == '__main__':
    rclpy.init()
    node = PrintPlanes()
    try:
        # rclpy.spin may sleep on when a signal ends the context between two of its waits.
        while rclpy.ok():
            rclpy.spin_once(node, timeout_sec=1.0)
    except (KeyboardInterrupt, Exception):
        # A signal ends rclpy between any two of its steps, with any of its errors.
        if rclpy.ok():
            raise
