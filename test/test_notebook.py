"""One call to segment, and results as people look at them and take them elsewhere."""

import json
import sys
from functools import partial

import matplotlib
import numpy as np
import pytest

import rangeseg_ros
from rangeseg_ros import Camera, CameraError, Config, ConfigError, RangeImage, Segmenter
from rangeseg_ros.drawing import colours
from rangeseg_ros.extras import MissingExtraError, import_extra
from rangeseg_ros.io.cameras import write_camera
from rangeseg_ros.io.images import write_image


@pytest.fixture(scope='module')
def result(seen):
    with pytest.warns(UserWarning, match='up as stated, or of a level camera, is off'):
        return rangeseg_ros.segment(seen.depth, seen.camera)


def test_one_call_gives_what_the_segmenter_gives(seen, result):
    image = RangeImage.from_depth(seen.depth, seen.camera)
    assert (result.labels == Segmenter(Config()).segment(image).labels).all()
    assert 'wall' in {plane.role for plane in result.planes}
    scaled = rangeseg_ros.segment(seen.depth / 1000, seen.camera, min_pixels=3000)
    assert 0 < len(scaled.planes) < len(result.planes)
    points = rangeseg_ros.segment(np.ma.masked_less(1000 * image.points, -1000), scale=0.001)
    assert points.planes[0].distance < 10 and not points.labels[(image.points < -1).any(2)].any()


def test_texts_are_short(seen, result):
    sequence = rangeseg_ros.SequenceSegmenter(Config(noise=0.001))
    parts = result.ground, result.grid, result.source, result.labelling
    for thing in (result, result.planes[0], result.image, sequence, sequence.map, *parts):
        assert 10 < len(repr(thing)) < 200
    walls = sum(plane.role == 'wall' for plane in result.planes)
    assert f'{len(result.planes)} planes (' in repr(result) and f'wall {walls}' in repr(result)
    assert repr(Segmenter(Config(noise=0.001))) == 'Segmenter(Config(noise=0.001))'
    assert 'nothing' in repr(RangeImage.from_depth(np.zeros((480, 640)), seen.camera))


def test_the_command_says_once_that_up_is_off(seen, folder, run):
    write_camera(folder / 'camera.yaml', seen.camera)
    names = 'a.png', 'b.png'
    for name in names:
        write_image(folder / name, seen.depth)
    segment = 'segment', '--camera', 'camera.yaml', '--output'
    one, two = run(*segment, 'one', names[0])[2], run(*segment, 'two', *names)[2]
    assert one.startswith('rangeseg: a.png: up as stated') and one.count('\n') == 1
    assert two == f'{one}rangeseg: up is off in 2 images\n'


def test_dictionaries_and_tables_hold_the_numbers(result):
    told = json.loads(json.dumps(result.to_dict()))
    assert told['tilt'].startswith('up as stated')
    assert told['shape'] == list(result.labels.shape)
    for plane, known in zip(result.planes, told['planes'], strict=True):
        assert np.array_equal(plane.normal, known['normal'])
        assert np.array_equal(plane.hull, known['hull'])
        assert (plane.id, plane.role, plane.count) == (known['id'], known['role'], known['count'])
    table = result.to_pandas()
    assert table['count'].tolist() == [plane.count for plane in result.planes]
    assert table['normal_z'].tolist() == [plane.normal[2] for plane in result.planes]


def test_pictures(result):
    page = result._repr_html_()
    assert 'data:image/png;base64,' in page and page.count('<tr>') == len(result.planes) + 1
    matplotlib.use('agg')
    (shown,) = result.plot().images
    assert shown.get_array().shape == (480, 640, 3)
    scene = result.to_trimesh()
    for plane in result.planes:
        mesh = scene.geometry[f'plane {plane.id}']
        assert len(mesh.faces) == len(plane.mesh()[1])
        assert tuple(mesh.visual.face_colors[0][:3]) == tuple(colours([plane.id])[0])


def test_open3d(result):
    pytest.importorskip('open3d', exc_type=ImportError)
    for plane, mesh in zip(result.planes, result.to_open3d(), strict=True):
        assert np.allclose(np.asarray(mesh.vertices), plane.mesh()[0])


def test_errors_have_a_suggestion(seen, monkeypatch):
    depth, camera, segment = seen.depth, seen.camera, rangeseg_ros.segment
    image = RangeImage.from_depth(depth, camera)
    sequence = partial(rangeseg_ros.SequenceSegmenter().segment, image)
    monkeypatch.setitem(sys.modules, 'pandas', None)
    for call, kind, words in (
        (lambda: Config(smothness=3), ConfigError, "'smoothness' meant"),
        (lambda: segment(depth, camera, smothness=3), ConfigError, 'smoothness'),
        (lambda: segment(depth, camera, depth_scale=1), ConfigError, "'scale' meant"),
        (lambda: Config.from_mapping([1]), ConfigError, r'names and their values, not \[1\]'),
        (lambda: Segmenter().segment(depth), ValueError, r'RangeImage.from_depth\(depth, camera'),
        (lambda: Segmenter({'noise': 0.001}), ConfigError, r'must be a Config\(...\), not {'),
        (lambda: RangeImage.from_depth(depth, (525, 525)), ValueError, r'a Camera\(width'),
        (lambda: segment(depth), ValueError, 'a depth image needs its camera'),
        (lambda: segment(camera.rays, camera), ValueError, 'points need no camera'),
        (lambda: sequence(0, pose=np.eye(4)), ValueError, r'Transform.from_matrix\(matrix\)'),
        (lambda: sequence(1.5), ValueError, 'an integer, nanoseconds, not 1.5'),
        (lambda: Camera.from_fov(640, 480, 180), CameraError, 'between 0 and 180'),
        (lambda: import_extra('pandas'), MissingExtraError, r"install 'rangeseg_ros\[notebook\]'"),
    ):
        with pytest.raises(kind, match=words):
            call()


def test_field_of_view():
    camera = Camera.from_fov(640, 480, 90)
    found = camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
    assert found == pytest.approx((640, 480, 320, 320, 319.5, 239.5))
