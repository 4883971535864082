"""Planes for MoveIt: hulls as meshes, the floor as an endless plane, in its planning scene.

On the map of planes (docs/frames.md) objects are sent once, again when they have changed by more
than CHANGE, and taken away when rays pass through them.
"""

import math

import rclpy
from geometry_msgs.msg import Pose
from moveit_msgs.msg import CollisionObject
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from shape_msgs.msg import Mesh, MeshTriangle, Plane
from visualization_msgs.msg import MarkerArray

from rangeseg_ros import ROLES, planes_from_message

CHANGE = 0.02  # metres


def differ(hull, other):
    """Whether corners of two markers are not the same, or not in the same place."""
    if other is None or len(hull.points) != len(other.points):
        return True
    pairs = zip(hull.points, other.points, strict=True)
    return any(math.dist((p.x, p.y, p.z), (q.x, q.y, q.z)) > CHANGE for p, q in pairs)


def mesh_of(hull):
    """shape_msgs/Mesh of a marker of the namespace hulls: every three points are a triangle."""
    corners = range(0, len(hull.points), 3)
    triangles = [MeshTriangle(vertex_indices=[i, i + 1, i + 2]) for i in corners]
    return Mesh(triangles=triangles, vertices=hull.points)


def floor_of(message):
    """shape_msgs/Plane of the floor in a message of ~/planes; None when there is no floor."""
    planes = planes_from_message(message)
    floor = planes[planes['role'] == ROLES.index('floor')]
    if not len(floor):
        return None
    largest = floor[floor['area'].argmax()]
    columns = 'normal_x', 'normal_y', 'normal_z', 'distance'
    return Plane(coef=[float(largest[column]) for column in columns])


class CollisionObjects(Node):
    def __init__(self):
        super().__init__('collision_objects')
        self.known = {}
        self.scene = self.create_publisher(CollisionObject, '/collision_object', 50)
        self.create_subscription(MarkerArray, 'segment_planes/markers', self.on_markers, 5)
        self.create_subscription(PointCloud2, 'segment_planes/planes', self.on_planes, 5)

    def on_markers(self, message):
        hulls = {f'plane {m.id}': m for m in message.markers if m.ns == 'hulls' and m.points}
        for name in set(self.known) - set(hulls):
            del self.known[name]
            header = message.markers[0].header
            gone = CollisionObject(header=header, id=name, operation=CollisionObject.REMOVE)
            self.scene.publish(gone)
        for name, hull in hulls.items():  # an object with a known id is replaced
            if not differ(hull, self.known.get(name)):
                continue
            self.known[name] = hull
            mesh = CollisionObject(header=hull.header, id=name, operation=CollisionObject.ADD)
            mesh.meshes, mesh.mesh_poses = [mesh_of(hull)], [Pose()]
            self.scene.publish(mesh)

    def on_planes(self, message):
        plane = floor_of(message)
        if plane is not None:
            floor = CollisionObject(header=message.header, id='floor')
            floor.operation = CollisionObject.ADD
            floor.planes, floor.plane_poses = [plane], [Pose()]
            self.scene.publish(floor)


if __name__ == '__main__':
    rclpy.init()
    node = CollisionObjects()
    try:
        # rclpy.spin may sleep on when a signal ends the context between two of its waits.
        while rclpy.ok():
            rclpy.spin_once(node, timeout_sec=1.0)
    except (KeyboardInterrupt, Exception):
        # A signal ends rclpy between any two of its steps, with any of its errors.
        if rclpy.ok():
            raise
