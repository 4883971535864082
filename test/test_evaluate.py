"""`rangeseg evaluate` on small scenes whose regions and planes are known exactly."""

import csv
from functools import partial

import cv2
import numpy as np
import pytest
from corner_set import CAMERA, LEFT, RIGHT, corner, depth_and_truth, segcomp_set
from dataset_files import literal_lzf

from rangeseg_ros.evaluation.datasets import find_cases, read_segcomp
from rangeseg_ros.evaluation.hoover import classify
from rangeseg_ros.evaluation.measure import (
    CORRECT,
    MISSED,
    NO_DATA,
    NOISE,
    OVER,
    class_picture,
)
from rangeseg_ros.io.cameras import write_camera
from rangeseg_ros.segcomp import abw_calibration


@pytest.fixture
def simulated(tmp_path):
    """Folder as `rangeseg simulate kinect` writes it."""
    folder = tmp_path / 'set'
    depth, truth = depth_and_truth()
    for kind, image in (('depth', depth), ('truth', truth)):
        (folder / kind).mkdir(parents=True)
        for name in ('000002', '000010'):
            assert cv2.imwrite(str(folder / kind / f'{name}.png'), image)
    write_camera(folder / 'camera.yaml', CAMERA)
    with (folder / 'planes.csv').open('w', newline='') as file:
        rows = csv.writer(file)
        rows.writerow(['image', 'label', 'normal_x', 'normal_y', 'normal_z', 'distance'])
        rows.writerows(
            [name, label, *plane]
            for name in ('000002', '000010')
            for label, plane in ((1, LEFT), (2, RIGHT))
        )
    return folder


@pytest.fixture
def evaluate(figures_of):
    """Run `rangeseg evaluate`; exit code, figures (or None), standard output and error."""
    return partial(figures_of, 'evaluate', '--method', 'normals', '--jobs', '1')


def test_depth_images_with_known_planes(simulated, evaluate):
    code, figures, out, _ = evaluate(simulated, '--tolerance', '0.8', '0.9')
    assert code == 0
    assert list(figures['per_image']) == ['000002', '000010']
    row = figures['tolerances']['0.8']
    assert (row['regions'], row['correct'], row['missed'], row['noise']) == (4, 4, 0, 0)
    assert row['mean_iou'] > 0.9
    # Depth is rounded to 1 mm at about 2 m; nothing else is wrong.
    assert row['normal_worst'] < 0.5 and row['offset_worst'] < 0.005
    assert 'angle_mean' not in row
    # The table has averages over the images.
    assert out.splitlines()[2].split()[:3] == ['0.8', '2.00', '2.00']


def test_pictures(simulated, evaluate, tmp_path):
    output = tmp_path / 'out'
    assert evaluate(simulated, '--output', output)[0] == 0
    labels = cv2.imread(str(output / '000002_labels.png'), cv2.IMREAD_UNCHANGED)
    assert labels.dtype == np.uint16 and set(np.unique(labels)) == {0, 1, 2}
    picture = cv2.cvtColor(cv2.imread(str(output / '000002_classes.png')), cv2.COLOR_BGR2RGB)
    assert picture.shape == (72, 2 * 96 + 4, 3)
    assert tuple(picture[3, 10]) == NO_DATA
    assert tuple(picture[40, 10]) == CORRECT and tuple(picture[40, 120]) == CORRECT


def test_picture_colours(simulated):
    sample = find_cases(simulated)[0].load()
    labels = np.zeros(sample.image.shape, np.uint16)
    # Region 1 in two halves: over-segmented; region 2 missed, but for a speck of noise.
    labels[sample.truth.labels == 1] = 1
    labels[36:][labels[36:] == 1] = 2
    labels[50:54, 80:84] = 3
    overlap = sample.truth.compare(labels)
    picture = class_picture(sample, labels, overlap, classify(overlap, 0.8))
    assert tuple(picture[60, 10]) == OVER and tuple(picture[60, 80]) == MISSED
    assert tuple(picture[60, 110]) == OVER and tuple(picture[52, 100 + 82]) == NOISE


def test_annotated_folders(tmp_path, evaluate):
    depth, truth = depth_and_truth()
    truth[:, 90:] = 65535
    for name in ('a', 'b'):
        (tmp_path / 'set' / name).mkdir(parents=True)
        assert cv2.imwrite(str(tmp_path / 'set' / name / 'depth.png'), depth)
        assert cv2.imwrite(str(tmp_path / 'set' / name / 'truth.png'), truth)
        (tmp_path / 'set' / name / 'camera.txt').write_text('90 90 47.5 35.5\n')
    code, figures, _, _ = evaluate(tmp_path / 'set')
    assert code == 0 and list(figures['per_image']) == ['a', 'b']
    assert figures['tolerances']['0.8']['correct'] == 4


def test_segcomp_set(tmp_path, evaluate):
    folder = segcomp_set(tmp_path / 'abw')
    code, figures, _, _ = evaluate(folder, '--tolerance', '0.8')
    assert code == 0 and list(figures['per_image']) == ['abw.test.1']
    row = figures['tolerances']['0.8']
    assert (row['regions'], row['correct']) == (2, 2)
    assert row['angle_mean'] < 1.0 and row['angle_std'] == 0.0


def test_calibration_follows_split_and_number(tmp_path):
    folder = segcomp_set(tmp_path / 'abw')
    sample = find_cases(folder)[0].load()
    files = folder / 'abw.test.1.range', folder / 'abw.test.1.gt-seg'
    assert sample.image.camera == abw_calibration(1).camera
    assert read_segcomp(*files, 'abw', 'test', 0).image.camera == abw_calibration(0).camera


def test_labelled_scan(tmp_path):
    # As SynPEB: columns from right to left in azimuth, rows from above; x forward, z up.
    azimuth = np.radians(np.linspace(-30, 30, 80))
    elevation = np.radians(np.linspace(20, -20, 60))[:, None]
    direction = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation) * np.ones(80),
        ],
        axis=2,
    )
    optical = np.stack([-direction[..., 1], -direction[..., 2], direction[..., 0]], axis=2)
    reach, label = corner(optical)
    points = (reach[..., None] * direction).astype(np.float32)
    intensity = (label + 9).astype(np.float32)
    intensity[:4] = 3
    raw = b''.join(a.astype('<f4').tobytes() for a in (*np.moveaxis(points, 2, 0), intensity))
    packed = literal_lzf(raw)
    header = (
        'VERSION .7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n'
        'WIDTH 80\nHEIGHT 60\nPOINTS 4800\nDATA binary_compressed\n'
    )
    path = tmp_path / 'scan.pcd'
    sizes = np.array([len(packed), len(raw)], '<u4')
    path.write_bytes(header.encode() + sizes.tobytes() + packed)
    (case,) = find_cases(tmp_path)
    sample = case.load()
    # Column 0 is on the left, x right, y down: the left wall is region 10.
    assert sample.image.points[0, 0, 0] < 0 and sample.image.points[0, 0, 1] < 0
    assert sample.truth.labels[30, 0] == 10 and sample.truth.labels[30, -1] == 11
    assert not sample.truth.labels[:4].any()
    distance = sample.image.points[30, 0].astype(float) @ LEFT[:3] + LEFT[3]
    assert distance == pytest.approx(0, abs=1e-5)


def refuse(result, *parts):
    code, figures, _, err = result
    assert code == 2 and figures is None
    assert err.count('\n') == 1
    for part in parts:
        assert str(part) in err


def test_refusals(simulated, evaluate, tmp_path):
    assert cv2.imwrite(str(simulated / 'truth/000002.png'), np.ones((4, 5), np.uint16))
    refuse(evaluate(simulated), '000002.png', 'truth is 5x4', '96x72')
    (simulated / 'truth' / '000010.png').unlink()
    refuse(evaluate(simulated), '000010.png', 'no ground truth')
    folder = tmp_path / 'annotated'
    folder.mkdir()
    refuse(evaluate(folder), folder, 'known layout')
    for name, image in zip(('depth', 'truth'), depth_and_truth(), strict=True):
        assert cv2.imwrite(str(folder / f'{name}.png'), image)
    for text in ('1 2 3', 'nan 1 1 1'):
        (folder / 'camera.txt').write_text(text)
        refuse(evaluate(folder), 'camera.txt')
