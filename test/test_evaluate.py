"""`rangeseg evaluate` and `compare` on scenes whose regions and planes are known exactly."""

import importlib
import re
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from dataset_files import raster

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.evaluation.datasets import find_cases, read_segcomp
from rangeseg_ros.evaluation.hoover import classify
from rangeseg_ros.evaluation.measure import CORRECT, MISSED, NO_DATA, NOISE, OVER, class_picture
from rangeseg_ros.io.cameras import write_camera
from rangeseg_ros.io.images import write_image
from rangeseg_ros.io.params import read_config, read_params
from rangeseg_ros.io.tables import write_table
from rangeseg_ros.segcomp import abw_calibration

ROOT = Path(__file__).parents[1]
CAMERA = Camera(96, 72, 90.0, 90.0, 47.5, 35.5)
EVALUATE = 'evaluate', '--jobs', 1
BY_NORMALS = *EVALUATE, '--method', 'normals', '--tolerance', '0.8'
# Two walls that meet in the vertical line x = 0, z = 2.
LEFT = np.array([np.sqrt(0.5), 0.0, -np.sqrt(0.5), 2 * np.sqrt(0.5)])
RIGHT = np.array([-np.sqrt(0.5), 0.0, -np.sqrt(0.5), 2 * np.sqrt(0.5)])


def corner(rays):
    """Distance along rays from the origin to a corner of two walls, and labels 1 and 2."""
    reach = np.stack([-plane[3] / (rays @ plane[:3]) for plane in (LEFT, RIGHT)])
    reach[reach <= 0] = np.inf
    return reach.min(axis=0), (reach.argmin(axis=0) + 1).astype(np.uint16)


def depth_and_truth():
    depth, truth = corner(CAMERA.rays.astype(float))
    depth = np.rint(1000 * depth).astype(np.uint16)
    depth[:6], truth[:6] = 0, 0
    return depth, truth


def segcomp_set(folder):
    """One ABW test image of the corner, 1.1 times nearer, with its truth and its angle."""
    folder.mkdir()
    calibration = abw_calibration(1)
    depth, truth = corner(calibration.camera.rays.astype(float))
    values = np.rint((500 * depth - calibration.offset) * calibration.scale).clip(1, 255)
    (folder / 'abw.test.1.range').write_bytes(raster(values.astype(np.uint8)))
    (folder / 'abw.test.1.gt-seg').write_bytes(raster((truth + 9).astype(np.uint8)))
    (folder / 'abw.test.1.gt-ang').write_text('1\n10 11 90.0\n')
    return folder


@pytest.fixture
def simulated(tmp_path):
    """Folder as `rangeseg simulate kinect` writes it."""
    folder, rows = tmp_path / 'set', []
    for name in ('000002', '000010'):
        for kind, image in zip(('depth', 'truth'), depth_and_truth(), strict=True):
            write_image(folder / kind / f'{name}.png', image)
        rows += [(name, 1, *LEFT), (name, 2, *RIGHT)]
    write_camera(folder / 'camera.yaml', CAMERA)
    heads = 'image', 'label', 'normal_x', 'normal_y', 'normal_z', 'distance'
    write_table(folder / 'planes.csv', heads, rows)
    return folder


def test_depth_images_with_known_planes(simulated, figures_of, tmp_path):
    output = tmp_path / 'out'
    code, figures, out, _ = figures_of(*BY_NORMALS, '0.9', '--output', output, simulated)
    assert code == 0 and list(figures['per_image']) == ['000002', '000010']
    row = figures['tolerances']['0.8']
    assert (row['regions'], row['correct'], row['missed'], row['noise']) == (4, 4, 0, 0)
    assert row['mean_iou'] > 0.9
    # Depth is rounded to 1 mm at about 2 m; nothing else is wrong.
    assert row['normal_worst'] < 0.5 and row['offset_worst'] < 0.005
    assert 'angle_mean' not in row
    # The table has averages over the images.
    assert out.splitlines()[2].split()[:3] == ['0.8', '2.00', '2.00']
    labels = cv2.imread(str(output / '000002_labels.png'), cv2.IMREAD_UNCHANGED)
    assert labels.dtype == np.uint16 and set(np.unique(labels)) == {0, 1, 2}
    picture = cv2.imread(str(output / '000002_classes.png'))[..., ::-1]
    assert picture.shape == (72, 2 * 96 + 4, 3)
    assert tuple(picture[3, 10]) == NO_DATA
    assert tuple(picture[40, 10]) == CORRECT and tuple(picture[40, 120]) == CORRECT


def test_picture_colours(simulated):
    sample = find_cases(simulated)[0].load()
    # Region 1 in two halves: over-segmented; region 2 missed, but for a speck of noise.
    halves = np.repeat([1, 2], 36)[:, None]
    labels = np.where(sample.truth.labels == 1, halves, 0).astype(np.uint16)
    labels[50:54, 80:84] = 3
    overlap = sample.truth.compare(labels)
    picture = class_picture(sample, labels, overlap, classify(overlap, 0.8))
    assert tuple(picture[60, 10]) == OVER and tuple(picture[60, 80]) == MISSED
    assert tuple(picture[60, 110]) == OVER and tuple(picture[52, 100 + 82]) == NOISE


def test_annotated_folders(tmp_path):
    depth, truth = depth_and_truth()
    truth[:, 90:] = 65535
    for name in ('a', 'b/c', 'b_c'):
        write_image(tmp_path / name / 'depth.png', depth)
        write_image(tmp_path / name / 'truth.png', truth)
        (tmp_path / name / 'camera.txt').write_text('90 90 47.5 35.5\n')
    cases = find_cases(tmp_path)
    assert [case.name for case in cases] == ['a', 'b_c', 'b_c_2']
    sample = cases[0].load()
    assert sample.image.camera == CAMERA
    np.testing.assert_array_equal(sample.truth.labels, np.where(truth == 65535, 0, truth))


def test_segcomp_set(tmp_path, figures_of):
    folder = segcomp_set(tmp_path / 'abw')
    code, figures, _, _ = figures_of(*BY_NORMALS, folder)
    assert code == 0 and list(figures['per_image']) == ['abw.test.1']
    row = figures['tolerances']['0.8']
    assert (row['regions'], row['correct']) == (2, 2)
    assert row['angle_mean'] < 1.0 and row['angle_std'] == 0.0
    # The calibration is that of the number.
    (case,) = find_cases(folder)
    assert case.load().image.camera == abw_calibration(1).camera
    other = read_segcomp(case.image, case.truth, 'abw', 'test', 0)
    assert other.image.camera == abw_calibration(0).camera


def test_labelled_scan(tmp_path):
    # As SynPEB: columns from right to left, rows from above; x forward, z up.
    left, up = np.meshgrid(np.linspace(-0.6, 0.6, 80), np.linspace(0.4, -0.4, 60))
    reach, label = corner(np.stack([-left, -up, np.ones(left.shape)], axis=2))
    label += 9
    label[:4] = 3
    header = (
        'VERSION .7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n'
        'WIDTH 80\nHEIGHT 60\nPOINTS 4800\nDATA binary\n'
    )
    points = np.stack([reach, reach * left, reach * up, label], axis=2)
    (tmp_path / 'scan.pcd').write_bytes(header.encode() + points.astype('<f4').tobytes())
    (case,) = find_cases(tmp_path)
    sample = case.load()
    # Column 0 is on the left, x right, y down: the left wall is region 10.
    assert sample.image.points[0, 0, 0] < 0 and sample.image.points[0, 0, 1] < 0
    assert sample.truth.labels[30, 0] == 10 and sample.truth.labels[30, -1] == 11
    assert not sample.truth.labels[:4].any()
    distance = sample.image.points[30, 0].astype(float) @ LEFT[:3] + LEFT[3]
    assert distance == pytest.approx(0, abs=1e-5)


def test_refusals_of_evaluate(simulated, refused, tmp_path):
    write_image(simulated / 'truth/000002.png', np.ones((4, 5), np.uint16))
    assert re.search('000002.png: .*truth is 5x4.*96x72', refused(*EVALUATE, simulated))
    (simulated / 'truth' / '000010.png').unlink()
    assert '000010.png: no ground truth' in refused(*EVALUATE, simulated)
    folder = tmp_path / 'annotated'
    folder.mkdir()
    assert re.search(f'{folder}: .*known layout', refused(*EVALUATE, folder))
    for name, image in zip(('depth', 'truth'), depth_and_truth(), strict=True):
        write_image(folder / f'{name}.png', image)
    for text in ('1 2 3', 'nan 1 1 1'):
        (folder / 'camera.txt').write_text(text)
        assert 'camera.txt' in refused(*EVALUATE, folder)


def write(path, labels):
    write_image(path, np.array(labels, np.uint16))
    return path


def test_rasters_count_regions_from_ten(tmp_path, figures_of):
    # 0-3 are no regions on either side, so nothing is noise.
    truth, labels = tmp_path / 'abw.test.1.gt-seg', tmp_path / 'abw.test.1.ms-seg'
    truth.write_bytes(raster(np.array([[10, 10, 2, 3], [11, 11, 0, 1]], np.uint8)))
    labels.write_bytes(raster(np.array([[12, 12, 3, 2], [10, 10, 1, 0]], np.uint8)))
    _, figures, *_ = figures_of('compare', truth, labels)
    assert list(figures['tolerances']) == ['0.51', '0.6', '0.7', '0.8', '0.9', '0.95']
    row = figures['tolerances']['0.95']
    assert (row['regions'], row['correct'], row['noise']) == (2, 2, 0)


def test_folders_are_paired_by_name_and_summed(tmp_path, figures_of):
    write(tmp_path / 'gt/2_truth.png', [[1, 1, 0]])
    write(tmp_path / 'gt/10_truth.png', [[1, 2, 0]])
    write(tmp_path / 'ms/2_depth_labels.png', [[1, 1, 0]])
    write(tmp_path / 'ms/10_depth_labels.png', [[0, 2, 3]])
    write(tmp_path / 'ms/10_depth_overlay.png', [[9, 9, 9]])
    folders = tmp_path / 'gt', tmp_path / 'ms'
    code, figures, *_ = figures_of('compare', *folders, '--tolerance', '0.8')
    assert code == 0 and figures['images'] == 2
    row = figures['tolerances']['0.8']
    assert (row['regions'], row['correct'], row['missed'], row['noise']) == (3, 2, 1, 1)
    # Over all three regions and four pixels, not the mean of two images.
    assert row['mean_iou'] == pytest.approx(2 / 3)
    assert row['pixel_accuracy'] == pytest.approx(3 / 4)
    assert list(figures['per_image']) == ['2', '10']
    assert figures['per_image']['10']['tolerances']['0.8']['missed'] == 1


NAMES = 'regions', 'correct', 'over', 'under', 'missed', 'noise', 'mean_iou', 'pixel_accuracy'
SHARES = pytest.approx((4 / 5 + 2 / 3) / 2), pytest.approx(6 / 7)
NONE = 65535
# Truth 1: 4 pixels, all in found 5 (5 pixels): (1, 0.8). Truth 2: 3 pixels, 2 in found 6.
TWO = [1, 1, 1, 1, 2, 2, 2, 0], [5, 5, 5, 5, 5, 6, 6, 0]
# Of the four pixels of 7 one is not judged, one curved: 2 / 3. Without 65535 all count: 2 / 4.
CURVED, FLAT, WIDE = [1, 1, 0, NONE, NONE], [1, 1, 0, 0, 0], [7, 7, 7, 7, 0]
# Found 8 has 2 of its 6 pixels on truth 1, the rest is not judged; 7 has the other 8.
RIM, PARTS = [1] * 10 + [0] * 4 + [NONE], [7] * 8 + [8] * 6 + [0]
# Half of its 4 judged: it counts, whatever its size.
HALF = [7] * 8 + [8] * 4 + [0] * 3


@pytest.mark.parametrize(
    ('tolerance', 'truth', 'labels', 'least', 'expected'),
    [
        ('0.8', *TWO, 1, dict(zip(NAMES, (2, 1, 0, 0, 1, 1, *SHARES), strict=True))),
        ('0.9', *TWO, 1, {'correct': 0, 'missed': 2, 'noise': 2}),
        ('0.8', CURVED, WIDE, 1, {'regions': 1, 'noise': 1, 'mean_iou': pytest.approx(2 / 3)}),
        ('0.8', FLAT, WIDE, 1, {'mean_iou': 1 / 2}),
        ('0.8', RIM, PARTS, 1, {'correct': 0, 'over': 1, 'noise': 0}),
        ('0.8', RIM, PARTS, 3, {'correct': 1, 'over': 0, 'noise': 0}),
        ('0.8', RIM, HALF, 3, {'over': 1}),
        ('0.8', [1, 1, 1, 2], [1, 1, 1, 0], 1, {'missed': 1}),
        ('0.8', [1, 1, 1, 2], [1, 1, 1, 0], 2, {'regions': 1, 'missed': 0}),
        ('0.8', [0, 0], [0, 0], 1, {'mean_iou': None}),
    ],
)
def test_two_images_by_hand(tmp_path, figures_of, tolerance, truth, labels, least, expected):
    """What is not judged, or too small, does not count."""
    truth, labels = (write(tmp_path / f'{k}.png', [row]) for k, row in enumerate((truth, labels)))
    _, figures, *_ = figures_of('compare', truth, labels, '--min-pixels', least)
    row = figures['tolerances'][tolerance]
    assert {name: row[name] for name in expected} == expected and set(row) == {*NAMES}


def test_refusals_of_compare(tmp_path, refused):
    one, wide = write(tmp_path / 'gt/1.png', [[1]]), write(tmp_path / 'wide.png', [[1, 1]])
    extra = [write(tmp_path / f'ms/{k}.png', [[1]]) for k in (1, 2)][1]
    for words, *arguments in (
        *(('above 0.5', one, one, '--tolerance', value) for value in ('0.5', '1.2', '80', 'nan')),
        ('differ in size', wide, one),
        ('two files or two folders', one, one.parent),
        (f'{extra}: no ground truth', one.parent, extra.parent),
        (f'{extra}: no segmentation', extra.parent, one.parent),
    ):
        assert words in refused('compare', *arguments)


@pytest.mark.parametrize(('name', 'count'), [('lambda', 3), ('comparison', 3 * 6 + 9)])
def test_tables_and_plots(tmp_path, monkeypatch, name, count):
    monkeypatch.syspath_prepend(str(ROOT / 'docs'))
    experiments = importlib.import_module('experiments')
    monkeypatch.setattr(experiments, 'LAMBDAS', (20.0, 85.0, 150.0))
    words = [name, segcomp_set(tmp_path / 'abw'), '--output', tmp_path / 'out', '--jobs', 1]
    monkeypatch.setattr(sys, 'argv', ['experiments.py', *map(str, words)])
    experiments.main()
    assert len((tmp_path / f'out/{name}.csv').read_text().splitlines()) == 1 + count
    assert (tmp_path / f'out/{name}.png').stat().st_size > 10_000


@pytest.mark.parametrize(
    ('sensor', 'changes'),
    [
        ('perceptron', {}),
        ('abw', {'dithering': 0.001}),
        ('kinect', {'smoothness': 100.0, 'min_pixels': 2}),
    ],
)
def test_parameter_files_hold_the_published_settings(sensor, changes):
    path = ROOT / 'params' / f'thesis_{sensor}.yaml'
    thesis = {'method': 'normals', 'normal_baseline': 1, 'jump_edges': 'sobel', 'min_pixels': 100}
    assert read_config(path) == Config(**{**thesis, 'smoothness': 55.0, **changes})
    # Whatever the defaults become.
    assert {*thesis, 'smoothness'} <= set(read_params(path))
