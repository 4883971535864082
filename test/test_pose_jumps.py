"""Poses that jump are told by the planes of a real sequence, and by how much."""

import os
from pathlib import Path

import numpy as np
import pytest

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.io.cameras import read_camera
from rangeseg_ros.io.images import read_depth
from rangeseg_ros.io.poses import read_pose


@pytest.fixture
def kinect_sequence():
    """A folder with depth, poses and camera.yaml of 7-Scenes; RANGESEG_DATA is where it is."""
    folder = Path(os.environ.get('RANGESEG_DATA', 'nowhere')) / 'kinect_sequence'
    if not folder.is_dir():
        pytest.skip('no kinect_sequence in RANGESEG_DATA')
    return folder


@pytest.mark.parametrize('jump', [0.0, 0.07, 0.36])
def test_jumps_of_real_poses_are_told(jump, kinect_sequence):
    folder = kinect_sequence
    camera, sequence = read_camera(folder / 'camera.yaml'), SequenceSegmenter(Config())
    images = sorted((folder / 'depth').iterdir())[64:84]
    poses = sorted((folder / 'poses').iterdir())[64:84]
    for k, (image, pose) in enumerate(zip(images, poses, strict=True)):
        told = read_pose(pose)
        if k >= 11:
            told = Transform(told.rotation, told.shift + np.array([jump, 0, 0]))
        depth = RangeImage.from_depth(read_depth(image), camera)
        sequence.segment(depth, 10**9 + k * 10**9 // 30, pose=told)
    assert not sequence.map.begun_anew
    found = [(stamp, np.linalg.norm(each.error[3:])) for stamp, each in sequence.map.jumps]
    if not jump:
        assert not found
    else:
        ((stamp, shift),) = found
        assert stamp == 10**9 + 11 * 10**9 // 30
        assert shift == pytest.approx(jump, abs=0.02)
