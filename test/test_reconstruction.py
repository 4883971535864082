"""Reconstructed normals and jump edges as outputs: Segmentation, files, messages, report."""

import cv2
import numpy as np
import pytest

from rangeseg_ros.core.by_normals.directions import directions
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.segmenter import Segmenter
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.drawing import normals_picture
from rangeseg_ros.messages.outputs import OUTPUTS
from rangeseg_ros.simulation.kinect import simulate_kinect
from rangeseg_ros.simulation.scenes import kinect_room
from rangeseg_ros.simulation.sensors.kinect import kinect_camera

CAMERA = kinect_camera(160, 120)


@pytest.fixture(scope='module')
def room():
    return simulate_kinect(kinect_room(3), CAMERA, noise='none')


def segmented(room, **options):
    image = RangeImage.from_depth(room.depth, CAMERA)
    return image, Segmenter(Config(min_pixels=100, **options)).segment(image)


@pytest.mark.parametrize('method', ['planes', 'normals'])
def test_normals_are_those_of_the_surfaces(room, method):
    image, result = segmented(room, method=method, smoothness=30.0)  # for so small an image
    normals = result.normals
    assert normals.dtype == np.float32 and normals.shape == (120, 160, 3)
    np.testing.assert_array_equal(np.isnan(normals).any(axis=2), result.labels == 0)
    known = result.labels > 0
    np.testing.assert_allclose(np.linalg.norm(normals[known], axis=1), 1, atol=1e-6)
    assert ((normals * image.rays).sum(axis=2)[known] < 0).mean() > 0.99
    truth = np.full((len(room.planes) + 1, 3), np.nan)
    for plane in room.planes:
        truth[plane.label] = plane.normal
    cosine = (truth[np.where(room.labels <= len(room.planes), room.labels, 0)] * normals).sum(2)
    angle = np.degrees(np.arccos(np.minimum(cosine[known & np.isfinite(cosine)], 1)))
    # Of 305 directions, the nearest is at most 4.7 degrees away.
    assert np.mean(angle < (0.1 if method == 'planes' else 5.0)) > 0.94


def test_method_normals_gives_its_directions(room):
    _, result = segmented(room, method='normals', direction_count=73)
    known = directions('platonic', 73).astype(np.float32)
    found = np.unique(result.normals[result.labels > 0], axis=0)
    assert all((known == normal).all(axis=1).any() for normal in found)


def test_edges_lie_on_both_sides_of_jumps():
    depth = np.full(CAMERA.shape, 2.0, np.float32)
    depth[:, 80:] = 1.5
    image = RangeImage.from_depth(depth, CAMERA)
    edges = Segmenter(Config()).segment(image).edges
    assert edges.dtype == bool and np.flatnonzero(edges.any(axis=0)).tolist() == [79, 80]
    assert edges[:, 79:81].all()
    assert not Segmenter(Config(jump_edges='none')).segment(image).edges.any()


def test_segment_writes_normals_as_red_green_blue(tmp_path, room, run):
    path = tmp_path / 'a.tiff'
    cv2.imwrite(str(path), room.depth)
    (tmp_path / 'camera.yaml').write_text(
        'image_width: 160\nimage_height: 120\ncamera_matrix: {rows: 3, cols: 3, data: '
        f'[{CAMERA.fx}, 0, {CAMERA.cx}, 0, {CAMERA.fy}, {CAMERA.cy}, 0, 0, 1]}}\n'
    )
    segment = 'segment', path, '--camera', tmp_path / 'camera.yaml', '--output'
    assert run(*segment, tmp_path, '--normals')[0] == run(*segment, tmp_path / 'plain')[0] == 0
    assert not (tmp_path / 'plain/a_normals.tiff').exists()
    # OpenCV reads blue, green, red.
    written = cv2.imread(str(tmp_path / 'a_normals.tiff'), cv2.IMREAD_UNCHANGED)[..., ::-1]
    image = RangeImage.from_depth(room.depth, CAMERA)
    np.testing.assert_array_equal(written, Segmenter().segment(image).normals)


def test_messages_hold_normals_and_edges(room):
    image, result = segmented(room)
    made = {}
    for name in ('normals', 'edges'):
        made[name] = OUTPUTS[name].message(lambda kind, **fields: fields, None, image, result)
    assert made['normals']['encoding'] == '32FC3' and made['normals']['step'] == 160 * 12
    sent = made['normals']['data'].view('<f4').reshape(120, 160, 3)
    np.testing.assert_array_equal(sent, result.normals)
    assert made['edges']['encoding'] == 'mono8'
    np.testing.assert_array_equal(made['edges']['data'].reshape(120, 160) == 255, result.edges)


def test_picture_of_normals():
    normals = np.array([[[0, 0, -1], [1, 0, 0], [0, 1, 0], [np.nan] * 3]], np.float32)
    expected = [[[128, 128, 255], [255, 128, 128], [128, 0, 128], [0, 0, 0]]]
    np.testing.assert_array_equal(normals_picture(normals), expected)
