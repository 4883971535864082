"""Make docs/planes.png, the picture in the README: a simulated Kinect frame and its planes."""

from pathlib import Path

import numpy as np

from rangeseg_ros import RangeImage, Segmenter
from rangeseg_ros.drawing import contact_sheet, grey, overlay
from rangeseg_ros.io.images import write_image
from rangeseg_ros.simulation.kinect import kinect_camera, simulate_kinect
from rangeseg_ros.simulation.scenes import kinect_room

camera = kinect_camera(640, 480)
frame = simulate_kinect(kinect_room(8, 1), camera, seed=8)
image = RangeImage.from_depth(frame.depth, camera)
result = Segmenter().segment(image)
depth = np.repeat(grey(image.inverse)[..., None], 3, axis=2)
planes = overlay(image.inverse, result.labels, result.planes)
write_image(Path(__file__).with_name('planes.png'), contact_sheet([depth, planes], columns=2))
