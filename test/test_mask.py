"""The robot's own body in the image: neither segmented, nor terrain."""

import cv2
import numpy as np
import pytest

from rangeseg_ros import Camera, Config, RangeImage, RangeImageError, Segmenter, corrected
from rangeseg_ros.core.ground.points import unseen
from rangeseg_ros.io.images import read_labels, read_mask

CAMERA = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)
TILT = np.radians(40)
UP = np.array([0, -np.cos(TILT), -np.sin(TILT)])
BODY = np.zeros(CAMERA.shape, np.uint8)
BODY[70:, 50:110] = 255


def robot_on_a_floor():
    """Depth of a floor 1 m below, and of a bumper that covers `BODY`."""
    depth = np.divide(
        1, -(CAMERA.rays @ UP), out=np.zeros(CAMERA.shape), where=CAMERA.rays @ UP < 0
    )
    depth[BODY > 0] = 0.4
    return np.round(1000 * np.minimum(depth, 60)).astype(np.uint16)


def parameters(path):
    up = dict(zip(('up_x', 'up_y', 'up_z'), map(float, UP), strict=True))
    return {**up, 'sensor_height': 1.0, 'mask': str(path)}


@pytest.mark.parametrize('channels', [1, 3, 4])
def test_the_body_is_left_out(tmp_path, channels):
    path = tmp_path / 'mask.png'
    picture = BODY if channels == 1 else np.dstack([BODY] * channels)
    cv2.imwrite(str(path), picture)
    config = Config(**parameters(path))
    image = RangeImage.from_depth(robot_on_a_floor(), CAMERA)
    with pytest.raises(RangeImageError, match=r'corrected\(image, config\)'):
        Segmenter(config).segment(image)
    masked = corrected(image, config)
    result = Segmenter(config).segment(masked)
    assert not result.labels[BODY > 0].any() and not result.terrain[BODY > 0].any()
    assert len(unseen(masked, result.ground)) == 0
    assert (result.terrain[(BODY == 0) & image.valid] == 1).mean() > 0.99


def test_a_command_reads_it(tmp_path, segment_image):
    cv2.imwrite(str(tmp_path / 'mask.png'), BODY)
    code, _, error = segment_image(robot_on_a_floor(), CAMERA, **parameters(tmp_path / 'mask.png'))
    assert (code, error) == (0, '')
    terrain = read_labels(tmp_path / 'out' / 'depth_terrain.png')
    assert not terrain[BODY > 0].any() and terrain[BODY == 0].any()


@pytest.mark.parametrize('kind', ['missing', 'text', 'size'])
def test_wrong_files_end_the_command_in_one_line(tmp_path, kind, segment_image):
    path = tmp_path / 'mask.png'
    if kind == 'text':
        path.write_text('mask')
    elif kind == 'size':
        cv2.imwrite(str(path), BODY[:-1])
    code, _, error = segment_image(robot_on_a_floor(), CAMERA, **parameters(path))
    assert code == 2 and str(path) in error and error.count('\n') == 1
    # Of the size nothing is known before there is an image.
    assert (f'{tmp_path / "params.yaml"}: parameter mask: ' in error) == (kind != 'size')
    assert not (tmp_path / 'out').exists()


def test_of_four_channels_the_last_is_opacity(tmp_path):
    image = np.zeros((2, 3, 4), np.uint8)
    image[..., 3] = [[255, 0, 255], [255, 255, 0]]
    image[:, :2, 1] = 9
    cv2.imwrite(str(tmp_path / 'mask.png'), image)
    expected = [[True, False, False], [True, True, False]]
    assert read_mask(tmp_path / 'mask.png').tolist() == expected
