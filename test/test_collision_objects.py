"""The example for MoveIt, run on messages of rclpy; of MoveIt itself, no more than a message."""

import runpy
import sys
from copy import deepcopy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip('rclpy')
pytest.importorskip('shape_msgs.msg')

from rclpy.serialization import deserialize_message
from ros_bench import DEPTH  # noqa: F401 - gives DDS a domain of its own
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from rangeseg_ros import Config, RangeImage
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.messages.make import make_rclpy
from rangeseg_ros.messages.outputs import OUTPUTS
from rangeseg_ros.simulation.sensors.kinect import kinect_camera

pytestmark = pytest.mark.ros

EXAMPLE = Path(__file__).parents[1] / 'examples' / 'collision_objects.py'


class CollisionObject(SimpleNamespace):
    """Of moveit_msgs/CollisionObject what does not need MoveIt's other packages."""

    ADD, REMOVE = b'\x00', b'\x01'


def area(mesh):
    """Area of a shape_msgs/Mesh, square metres."""
    corners = np.array([(p.x, p.y, p.z) for p in mesh.vertices])
    triangles = np.array([triangle.vertex_indices for triangle in mesh.triangles])
    # Every corner is used, and none is made up.
    assert set(triangles.ravel()) == set(range(len(corners)))
    sides = np.diff(corners[triangles], axis=1)
    return np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum() / 2


def test_hulls_become_meshes_and_go_with_their_planes(monkeypatch):
    """Of a floor 0.8 m below the camera and a wall 3 m ahead."""
    messages = SimpleNamespace(CollisionObject=CollisionObject)
    monkeypatch.setitem(sys.modules, 'moveit_msgs', SimpleNamespace(msg=messages))
    monkeypatch.setitem(sys.modules, 'moveit_msgs.msg', messages)
    example = runpy.run_path(str(EXAMPLE))
    camera = kinect_camera(160, 120)
    depth = np.minimum(0.8 / np.maximum(camera.rays[..., 1], 1e-6), 3).astype(np.float32)
    image = RangeImage.from_depth(depth, camera)
    result = SequenceSegmenter(Config()).segment(image, 0)
    planes, markers = (
        OUTPUTS[name].message(make_rclpy, Header(frame_id='optical'), image, result)
        for name in ('planes', 'markers')
    )
    assert example['floor_of'](planes).coef == pytest.approx([0, -1, 0, 0.8], abs=1e-3)
    markers = deserialize_message(markers, MarkerArray)
    planes, scene = result.planes, []
    node = SimpleNamespace(known={}, scene=SimpleNamespace(publish=scene.append))
    example['CollisionObjects'].on_markers(node, markers)
    assert [(o.id, o.operation) for o in scene] == [(f'plane {p.id}', b'\x00') for p in planes]
    assert len(planes) == 2
    for item, plane in zip(scene, planes, strict=True):
        assert item.header.frame_id == 'optical' and len(item.mesh_poses) == 1
        # Outlines are simplified.
        assert area(item.meshes[0]) == pytest.approx(plane.area, rel=0.03)
    scene.clear()
    assert [marker.ns for marker in markers.markers].count('hulls') == 2
    wall = MarkerArray(markers=[m for m in markers.markers if m.id != planes[0].id])
    example['CollisionObjects'].on_markers(node, wall)
    # What has not changed is not sent again.
    assert [(o.id, o.operation) for o in scene] == [(f'plane {planes[0].id}', b'\x01')]
    scene.clear()
    for shift in (0.01, 0.05):
        moved = deepcopy(wall)
        for marker in moved.markers:
            # Triangles share their corners.
            for point in {id(point): point for point in marker.points}.values():
                point.z += shift
        example['CollisionObjects'].on_markers(node, moved)
    assert [(o.id, o.operation) for o in scene] == [(f'plane {planes[1].id}', b'\x00')]
