"""`rangeseg evaluate` of terrains whose shares are counted on paper.

A camera looks straight down from 2 m onto a floor with a box on it and a pit in it, without noise:
what is found of them, away from where they end, is plain. The truth is drawn by hand and wrong on
purpose: what is found as one class counts as an error of another.
"""

import cv2
import numpy as np
import pytest
from scipy.stats import beta

from rangeseg_ros.core.ground.cells import DROP, GROUND, OBSTACLE
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.evaluation.detection import LEVEL, lower_bound
from rangeseg_ros.io.cameras import write_camera
from rangeseg_ros.io.images import write_image
from rangeseg_ros.io.tables import write_table
from rangeseg_ros.simulation.terrain.testpieces import catalogue

CAMERA = Camera(160, 120, 100.0, 100.0, 79.5, 59.5)
BOX = np.s_[20:60, 20:60]
PIT = np.s_[20:60, 100:140]
# Rows and columns of what is judged, its class, and what is found there.
DRAWN = (
    (np.s_[80:100, 10:50], GROUND),  # 800 pixels of floor
    (np.s_[80:90, 60:70], OBSTACLE),  # 100 of floor
    (np.s_[80:90, 90:130], DROP),  # 400 of floor
    # 200 pixels each, of which 3 columns or rows of 20 are beside another class: 140 count.
    (np.s_[30:50, 30:40], OBSTACLE),  # of the box
    (np.s_[30:50, 40:50], GROUND),  # of the box
    (np.s_[30:40, 110:130], DROP),  # of the pit
    (np.s_[40:50, 110:130], GROUND),  # of the pit, 3 m away
)
EVALUATE = 'evaluate', '--jobs', 1
HEADS = 'name kind sensor up_x up_y up_z sensor_height direction count rise run'
NO_CLASS, FLAT = np.full(CAMERA.shape, 4, np.uint8), np.ones(CAMERA.shape, np.float32)
# Reaches of 3.5 and of 2.5 m: pixels by true and found class, as the comments above add up.
SENSORS = {'kinect': 'near', 'realsense': 'far'}
SHARES = [f'ground_{name}' for name in ('kept', 'called_obstacle', 'called_drop')]
SHARES += [f'{name}_{how}' for name in ('obstacle', 'drop') for how in ('found', 'called_ground')]
KINECT, REALSENSE, POOLED = (
    dict(zip(SHARES, values, strict=True))
    for values in (
        (800 / 1080, 140 / 1080, 140 / 1080, 140 / 240, 100 / 240, 140 / 440, 300 / 440),
        (800 / 940, 140 / 940, 0.0, 140 / 240, 100 / 240, 140 / 340, 200 / 340),
        (1600 / 2020, 280 / 2020, 140 / 2020, 280 / 480, 200 / 480, 280 / 780, 500 / 780),
    )
)


@pytest.fixture
def drawn(tmp_path):
    """Folder as `rangeseg simulate terrain` writes it: the same image of two sensors."""
    folder = tmp_path / 'set'
    depth = np.full(CAMERA.shape, 2000, np.uint16)
    depth[BOX], depth[PIT] = 1600, 3000
    truth = np.zeros(CAMERA.shape, np.uint8)
    for where, class_ in DRAWN:
        truth[where] = class_
    crossing, size = np.full((2, *CAMERA.shape), 2.0, np.float32)
    # Where the rays cross the ground, metres: 100 pixels each of the drop that is floor.
    crossing[80:90, 110:120], crossing[80:90, 120:130] = 3.0, 3.6
    size[:], size[BOX] = 0.05, 0.4
    height = (2 - depth / 1000).astype(np.float32)
    images = {'depth': depth, 'truth': truth, 'crossing': crossing, 'size': size, 'height': height}
    for part, image in images.items():
        suffix = 'tiff' if image.dtype == np.float32 else 'png'
        for name in SENSORS:
            write_image(folder / part / f'{name}.{suffix}', image)
    write_camera(folder / 'camera.yaml', CAMERA)
    rows = [(name, kind, name, 0, 0, -1, 2, '', '', '', '') for name, kind in SENSORS.items()]
    write_table(folder / 'terrain.csv', HEADS.split(), rows)
    return folder


def test_shares_and_pictures_are_those_counted_on_paper(drawn, figures_of, tmp_path):
    """But beside borders and beyond a sensor's reach, of a drop by the ground in its place."""
    code, figures, out, _ = figures_of(*EVALUATE, drawn, '--output', tmp_path / 'pictures')
    assert code == 0 and figures['images'] == 2
    assert 'exists already' in figures_of(*EVALUATE, drawn, '--output', tmp_path / 'pictures')[3]
    assert figures['by_kind'] == {'far': pytest.approx(REALSENSE), 'near': pytest.approx(KINECT)}
    assert figures['pooled'] == pytest.approx(POOLED)
    # Obstacles of 0.05 m are floor 2 m away, that of 0.4 m is found, 1.6 m away.
    sizes = figures['by_size']
    told = {(k, m): v for k, row in sizes.items() for m, v in row.items() if v is not None}
    assert told == {('0.05', '2'): 0.0, ('0.4', '1'): 1.0}
    assert figures['drop_scenes_above_0.01'] == ['kinect', 'realsense']
    assert 'nan' not in out
    rows = {words[0]: words[1:] for words in map(str.split, out.splitlines()) if words}
    for kind, expected in (('near', KINECT), ('far', REALSENSE), ('all', POOLED)):
        assert rows[kind] == [f'{value:.4f}' for value in expected.values()]
    assert rows['0.4'] == ['-', '1.0000', '-', '-']
    # Truth, what was found, and where they differ.
    picture = cv2.imread(str(tmp_path / 'pictures' / 'kinect_near.png'))[..., ::-1]
    black, green, red, blue = (0, 0, 0), (0, 150, 0), (220, 0, 0), (0, 0, 240)
    for (row, column), colours in (
        ((90, 30), (green, green, black)),  # kept
        ((85, 65), (red, green, green)),  # an obstacle called ground
        ((40, 45), (green, red, red)),  # ground called an obstacle
        ((31, 120), (blue, blue, black)),  # a drop that is found
        ((85, 125), (blue, green, black)),  # out of reach
    ):
        assert np.array_equal(picture[row, column :: CAMERA.width], colours)


def test_the_height_in_the_table_is_told_unless_it_shall_not_be(drawn, figures_of):
    """Nothing is ground where a height of 2.2 m contradicts the floor that is seen 2 m below."""
    change(drawn, '-1,2,', '-1,2.2,')
    assert figures_of(*EVALUATE, drawn)[1]['by_kind']['near']['ground_kept'] == 0
    assert figures_of(*EVALUATE, drawn, '--unknown-height')[1]['pooled'] == pytest.approx(POOLED)


@pytest.mark.parametrize(
    ('damage', 'says'),
    [
        (lambda at: (at / 'truth/kinect.png').unlink(), 'truth/kinect.png: No such file'),
        (lambda at: write_image(at / 'truth/kinect.png', NO_CLASS[:4]), 'truth is 160x4, its'),
        (lambda at: write_image(at / 'size/kinect.tiff', FLAT[:4]), 'depth image is 160x4'),
        (lambda at: write_image(at / 'truth/kinect.png', NO_CLASS), 'kinect.png: 4 is no class'),
        (lambda at: change(at, 'kind,sensor', 'sort,sensor'), 'malformed table'),
        (lambda at: change(at, ',-1,2,', ',-1,high,'), 'malformed table'),
        (lambda at: change(at, ',-1,2,,,,', ''), 'malformed table'),
    ],
)
def test_errors_are_one_line(drawn, refused, damage, says):
    damage(drawn)
    assert says in refused(*EVALUATE, drawn)


def change(folder, old, new):
    path = folder / 'terrain.csv'
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))


def test_lower_bounds_are_those_of_the_beta_distribution():
    for successes, trials in ((0, 5), (1, 1), (3, 7), (10, 10), (19, 20)):
        expected = beta.ppf(1 - LEVEL, successes, trials - successes + 1) if successes else 0
        assert lower_bound(successes, trials) == pytest.approx(expected, abs=1e-9)


def test_pieces_are_detected_by_size_and_distance(run, figures_of, tmp_path):
    """Without noise: all of 20 cm and more, and nothing dangerous is ground."""
    folder, size = tmp_path / 'set', ('--width', 160, '--height', 120)
    words = 'simulate', 'testpieces', '--sensor', 'ideal', '--scenes', 1, *size
    assert run(*words, '--output', folder)[0] == 0
    code, figures, out, _ = figures_of(*EVALUATE, folder)
    rows = figures['detection']
    assert {size for kind, size, _ in catalogue() if kind == 'ramp'} == {5, 10, 15, 20}
    assert code == 0 and 'test pieces detected' in out
    assert [(r['kind'], r['size'], r['distance']) for r in rows] == [*catalogue()]
    for row in rows:
        assert row['ground'] == 0, row
        if row['size'] >= 0.2 and row['scenes']:
            assert row['detected'] == 1 and row['bound'] == pytest.approx(0.05), row
    assert sum(row['scenes'] for row in rows) > 40
    # Of a set without noise every confidence is high, and right.
    assert [(row['from'], row['right']) for row in figures['reliability']] == [(0.999, 1)]
