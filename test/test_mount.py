"""How a camera is mounted: angles, height and their errors against the truth."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.mapping.mount import mount_of
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.io.bag_writer import DepthBagWriter
from rangeseg_ros.simulation.kinect import simulate_kinect
from rangeseg_ros.simulation.scenes import Pose, Scene
from rangeseg_ros.simulation.sensors.kinect import kinect_camera
from rangeseg_ros.simulation.solids import box, half_space

CAMERA = kinect_camera(320, 240)


def driving(height, pitch, roll, frames=6):
    """A robot drives past a box, towards a wall."""
    solids = half_space((0, 0, 1), (0, 0, 0)), half_space((-1, 0, 0), (4, 0, 0))
    cube = box((0.4, 0.4, 0.3), np.eye(3), (2.2, 0.7, 0.15))
    poses = [Pose.looking((0.1 * k, 0, height), 0, pitch, roll) for k in range(frames)]
    return Scene((*solids, cube), tuple(poses))


@pytest.mark.parametrize(('height', 'pitch', 'roll'), [(1.1, 25, 3), (0.9, 40, -6), (1.4, 30, 0)])
def test_angles_and_height_are_within_their_errors(height, pitch, roll):
    scene, sequence = driving(height, pitch, roll), SequenceSegmenter(Config(min_pixels=150))
    for k in range(len(scene.poses)):
        view = simulate_kinect(scene, CAMERA, frame=k, sensor_seed=int(height * 10))
        image = RangeImage.from_depth(view.depth, CAMERA)
        sequence.segment(image, 10**9 + k * 10**8, pose=Transform.identity())
    mount = mount_of(sequence.map.planes, len(scene.poses), 10.0)
    assert not mount.doubts
    error = np.array([mount.roll - np.radians(roll), mount.pitch - np.radians(pitch)])
    assert np.all(np.abs(error) < np.radians(1.0))
    assert abs(mount.height - height) < 0.02
    assert np.all(np.abs([*error, mount.height - height]) < 4 * mount.sigma)
    # The camera's place in the frame on the floor, x forward.
    truth = scene.poses[0].rotation
    np.testing.assert_allclose(mount.rotation, truth, atol=0.03)
    turned = Rotation.from_euler('xyz', mount.rpy).as_matrix()
    np.testing.assert_allclose(turned, mount.rotation, atol=1e-9)
    np.testing.assert_allclose(
        Rotation.from_quat(mount.quaternion).as_matrix(), mount.rotation, atol=1e-9
    )


def test_the_command_prints_what_ros_takes_and_says_when_there_is_no_floor(tmp_path, run):
    scene = driving(1.1, 25, 3, frames=4)
    for name, pose in (('robot', None), ('wall', Pose.looking((0, 0, 1.5), 0, -20, 0))):
        with DepthBagWriter(tmp_path / name, CAMERA) as bag:
            for k in range(4):
                shown = Scene(scene.solids, (pose or scene.poses[k],))
                bag.write(simulate_kinect(shown, CAMERA).depth, 10**9 + k * 10**8)
    params = tmp_path / 'params.yaml'
    params.write_text('min_pixels: 150')
    robot, wall = (run('mount', tmp_path / name, '--params', params) for name in ('robot', 'wall'))
    code, output, _ = robot
    assert code == 0
    assert '--frame-id base_footprint --child-frame-id camera_depth_optical_frame' in output
    assert '<origin xyz="0 0 1.' in output and 'pitch 2' in output
    assert wall[0] == 2 and 'no plane that faces up' in wall[2]
