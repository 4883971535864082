"""Corrections of what a sensor sees: its fixed distortion, and the body of the robot."""

import json

import cv2
import numpy as np
import pytest
from clouds import cloud_of
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, TiffImagePlugin

from rangeseg_ros import Camera, Config, RangeImage, RangeImageError, Segmenter, corrected
from rangeseg_ros.core.ground.points import unseen
from rangeseg_ros.core.sensing.distortion import DistortionError, DistortionMap
from rangeseg_ros.io.corrections import load_distortion
from rangeseg_ros.io.distortion import KIND, read_distortion, write_distortion
from rangeseg_ros.io.images import read_mask

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
WALL = (CAMERA.rays.astype(float) @ [0.1, -0.2, 0.5]).astype(np.float32)
"""Inverse depth of a slanted wall."""


def smooth_map(scale=0.01):
    v, u = np.indices(CAMERA.shape)
    return (scale * np.sin(u / 9) * np.cos(v / 7)).astype(np.float32)


@pytest.mark.parametrize(('slope', 'reference'), [(0.0, 0.0), (0.1, 0.0), (0.1, 0.4)])
def test_the_error_of_the_inverse_depth_is_taken_off(slope, reference):
    """Of depth images and along the rays of clouds; what is then beyond infinity is unknown."""
    inverse = WALL.copy()
    inverse[5, 6], inverse[7, 8] = 0, 0.002
    bent = np.full(CAMERA.shape, slope, np.float32) if slope else None
    distortion = DistortionMap(smooth_map(), None, bent, CAMERA, reference)
    expected = inverse - smooth_map() - slope * (inverse - reference)
    expected[(inverse == 0) | (expected < 0)] = 0
    assert expected[5, 6] == 0 and (expected[7, 8] == 0) == (reference == 0)
    depth = np.divide(1, inverse, out=np.zeros_like(inverse), where=inverse > 0)
    image = RangeImage.from_depth(depth, CAMERA)
    found, cloud = map(distortion.corrected, (image, cloud_of(image.points)))
    assert found.inverse == pytest.approx(expected, abs=1e-6)
    assert found.corrected and not image.corrected
    true = CAMERA.rays[expected > 0] / expected[expected > 0, None]
    np.testing.assert_array_equal(cloud.valid, expected > 0)
    assert cloud.points[cloud.valid] == pytest.approx(true, rel=1e-5)


def test_size_and_camera_are_checked():
    distortion = DistortionMap(smooth_map(), camera=CAMERA)
    other = Camera(32, 24, 30.0, 30.0, 15.5, 11.5)
    with pytest.raises(DistortionError, match='64x48, the image 32x24'):
        distortion.corrected(RangeImage.from_depth(np.ones(other.shape, np.float32), other))
    other = Camera(64, 48, 70.0, 60.0, 31.5, 23.5)
    with pytest.raises(DistortionError, match='another camera: fx 60, not 70'):
        distortion.corrected(RangeImage.from_depth(np.ones(other.shape, np.float32), other))


def test_segmenter_does_not_forget_the_map(tmp_path):
    write_distortion(tmp_path / 'map.tiff', DistortionMap(smooth_map()))
    config = Config(distortion_map=str(tmp_path / 'map.tiff'), min_pixels=50)
    image = RangeImage.from_depth((1 / (WALL + smooth_map())).astype(np.float32), CAMERA)
    with pytest.raises(RangeImageError, match=r'corrected\(image, config\)'):
        Segmenter(config).segment(image)
    (plane,) = Segmenter(config).segment(corrected(image, config)).planes
    assert plane.rms < 1e-6


@pytest.mark.parametrize(('pages', 'reference'), [(1, 0.0), (2, 0.0), (3, 0.0), (3, 0.6)])
def test_file_holds_the_map(tmp_path, pages, reference):
    parts = [smooth_map(), abs(smooth_map()), smooth_map(0.1)][:pages]
    distortion = DistortionMap(*[*parts, None, None][:3], CAMERA, reference)
    path = tmp_path / 'map.tiff'
    write_distortion(path, distortion)
    read = read_distortion(path)
    for name in ('offset', 'deviation', 'slope'):
        assert np.array_equal(getattr(distortion, name), getattr(read, name))
    assert read.camera == CAMERA and read.reference == reference
    # Readers of one page read the offset, and so do those who add the third times 1/z, unless it
    # is the slope of an offset at 1/z = 0.
    assert np.array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), smooth_map())
    if reference:
        _, images = cv2.imreadmulti(str(path), flags=cv2.IMREAD_UNCHANGED)
        assert len(images) == 4 and not images[2].any()
    assert [file.name for file in tmp_path.iterdir()] == ['map.tiff']


def test_slope_has_one_page(tmp_path):
    path = tmp_path / 'map.tiff'
    pages = [Image.fromarray(smooth_map()) for _ in range(4)]
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    for reference, words in ((0.6, 'a third page beside'), (None, 'damaged description')):
        tags[270] = json.dumps({'kind': KIND, 'reference': reference})
        pages[0].save(path, save_all=True, append_images=pages[1:], tiffinfo=tags)
        with pytest.raises(DistortionError, match=words):
            read_distortion(path)


def test_a_changed_file_is_read_again(tmp_path):
    """In place of one of another program, which says nothing of the camera."""
    path = tmp_path / 'map.tiff'
    cv2.imwrite(str(path), smooth_map())
    read = load_distortion(path)
    assert np.array_equal(read.offset, smooth_map()) and read.camera is None
    assert load_distortion(path) is read
    write_distortion(path, DistortionMap(smooth_map(0.02)))
    assert np.array_equal(load_distortion(path).offset, smooth_map(0.02))


@given(data=st.data())
def test_damaged_files_are_refused(tmp_path_factory, data):
    path = tmp_path_factory.mktemp('maps') / 'map.tiff'
    write_distortion(path, DistortionMap(smooth_map(), abs(smooth_map()), camera=CAMERA))
    content = bytearray(path.read_bytes())
    del content[data.draw(st.integers(0, len(content))) :]
    for _ in range(data.draw(st.integers(0, 3))):
        if content:
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(bytes(content))
    try:
        assert np.isfinite(read_distortion(path).offset).all()
    except DistortionError as error:
        assert str(path) in str(error) and '\n' not in str(error)


VIEW = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)
TILT = np.radians(40)
UP = np.array([0, -np.cos(TILT), -np.sin(TILT)])
BODY = np.zeros(VIEW.shape, np.uint8)
BODY[70:, 50:110] = 255


def robot_on_a_floor():
    """Depth of a floor 1 m below, and of a bumper that covers `BODY`."""
    depth = np.divide(1, -(VIEW.rays @ UP), out=np.zeros(VIEW.shape), where=VIEW.rays @ UP < 0)
    depth[BODY > 0] = 0.4
    return np.round(1000 * np.minimum(depth, 60)).astype(np.uint16)


@pytest.mark.parametrize('channels', [1, 3, 4])
def test_the_body_is_left_out(tmp_path, channels):
    path = tmp_path / 'mask.png'
    cv2.imwrite(str(path), np.dstack([BODY] * channels))
    up = dict(zip(('up_x', 'up_y', 'up_z'), UP.tolist(), strict=True))
    config = Config(**up, sensor_height=1.0, mask=str(path))
    image = RangeImage.from_depth(robot_on_a_floor(), VIEW)
    with pytest.raises(RangeImageError, match=r'corrected\(image, config\)'):
        Segmenter(config).segment(image)
    masked = corrected(image, config)
    result = Segmenter(config).segment(masked)
    assert not result.labels[BODY > 0].any() and not result.terrain[BODY > 0].any()
    assert len(unseen(masked, result.ground)) == 0
    assert (result.terrain[(BODY == 0) & image.valid] == 1).mean() > 0.99


def test_of_four_channels_the_last_is_opacity(tmp_path):
    image = np.zeros((2, 3, 4), np.uint8)
    image[..., 3] = [[255, 0, 255], [255, 255, 0]]
    image[:, :2, 1] = 9
    cv2.imwrite(str(tmp_path / 'mask.png'), image)
    expected = [[True, False, False], [True, True, False]]
    assert read_mask(tmp_path / 'mask.png').tolist() == expected


WRONG = {'mask': 'missing text size long', 'distortion_map': 'missing text nan integers'}


@pytest.mark.parametrize(('option', 'kind'), [(o, k) for o in WRONG for k in WRONG[o].split()])
def test_wrong_files_end_the_command_in_one_line(tmp_path, option, kind, segment_image):
    path = tmp_path / ('file.tiff' if kind != 'long' else 300 * 'x')
    if kind == 'text':
        path.write_text('text')
    elif kind == 'size':
        cv2.imwrite(str(path), BODY[:-1])
    elif kind not in ('missing', 'long'):
        values = np.full(VIEW.shape, np.nan, np.float32)
        cv2.imwrite(str(path), values if kind == 'nan' else np.zeros(VIEW.shape, np.uint16))
    code, _, error = segment_image(robot_on_a_floor(), VIEW, **{option: str(path)})
    assert code == 2 and str(path) in error and error.count('\n') == 1
    # Of the size nothing is known before there is an image.
    assert (f'{tmp_path / "params.yaml"}: parameter {option}: ' in error) == (kind != 'size')
    assert not (tmp_path / 'out').exists()
