"""The ledger of mechanisms: its table, its arithmetic, and cases whose outcome is known."""

import ablate
import numpy as np
import pytest
from ablation_frames import Frame, border_f

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.segmenter import Segmenter
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.evaluation.label_files import as_truth
from rangeseg_ros.simulation.render import simulate
from rangeseg_ros.simulation.scenes import kinect_room
from rangeseg_ros.simulation.sensors.kinect import Kinect, kinect_camera


@pytest.fixture(scope='module')
def frame():
    seen = simulate(kinect_room(3), Kinect(0, 'none'), kinect_camera(320, 240), seed=3)
    image = RangeImage.from_depth(seen.depth, seen.camera)
    planes = {plane.label: np.array([*plane.normal, plane.distance]) for plane in seen.planes}
    return Frame('simulated', 'kinect', image, as_truth(seen.labels), planes, 300)


def test_every_mechanism_is_in_the_code():
    assert len({mechanism.name for mechanism in ablate.MECHANISMS}) == len(ablate.MECHANISMS)
    for mechanism in ablate.MECHANISMS:
        for entry in mechanism.modules.split():
            name, _, functions = entry.partition(':')
            for function in functions.split(','):
                assert ablate.source_of(f'{name}:{function}')[0] > 0, (entry, function)
        with ablate.switched(mechanism.changes) as parameters:
            Config(**parameters)


def test_without_any_plane_all_of_the_accuracy_is_lost_and_without_a_change_none(frame):
    nothing = ablate.Mechanism('nothing', '', {'seed': Config().seed})
    planes = ablate.Mechanism('planes', '', {'min_pixels': 10**8})
    option = ablate.Mechanism('no planes', '', {'min_pixels': 10**8}, option=True)
    gains = ablate.measure(iter([('kinect', frame.run)]), [nothing, planes, option])
    iou = frame.truth._replace(min_pixels=300).compare(Segmenter().segment(frame.image).labels)
    iou = iou.best_iou[iou.truth_sizes >= 300].mean()
    assert iou > 0.9
    assert gains['']['simulated']['kinect'] == [pytest.approx(iou, abs=0.02)]
    assert gains['planes']['simulated'] == gains['']['simulated']
    assert gains['no planes']['simulated']['kinect'] == [-gains['']['simulated']['kinect'][0]]
    for column in ('simulated', 'all', 'border', 'faces', 'angle'):
        assert gains['nothing'][column]['kinect'] == [0.0]


def test_a_mean_over_sensors_gives_each_the_same_weight():
    mean, error = ablate.pooled({'a': [1.0, 3.0], 'b': [4.0, np.nan], 'c': [np.nan]})
    assert (mean, error) == (3.0, 1.0)
    assert np.isnan(ablate.pooled({'a': [1.0]})[1])
    # Verdicts ask for more than chance.
    for gains, expected in (
        ({'all': (3.0, 2.0), 'curved': (3.0, 2.0)}, 'earns: all'),
        ({'all': (0.4, 0.0), 'curved': (-5.0, 2.0)}, 'harms: curved'),
        ({'all': (3.0, np.nan), 'curved': (np.nan, 1.0)}, ''),
        ({'all': (-3.0, 2.0), 'border': (9.0, 1.0)}, 'earns: border; harms: all'),
    ):
        assert ablate.verdict(gains) == expected, gains


def test_borders_match_within_two_pixels():
    def halves(column):
        return np.tile(np.where(np.arange(20) < column, 1, 2), (10, 1))

    valid = np.ones((10, 20), bool)
    assert border_f(halves(8), halves(10), valid) == 1.0
    assert border_f(halves(8), halves(11), valid) == 0.0
    assert border_f(halves(8), halves(20), valid) == 0.0


def test_the_page_has_a_row_for_each_mechanism(frame, monkeypatch, tmp_path):
    monkeypatch.setattr(ablate, 'simulated_frames', lambda *_: iter([frame]))
    page = tmp_path / 'ledger.md'
    ablate.main(['--only', '^(curved regions told|method normals)$', '--output', str(page)])
    rows = [line for line in page.read_text().splitlines() if line.startswith('| ')]
    names = 'mechanism', '---', 'with all', 'curved regions told', 'method normals (an option)'
    assert [row.split(' | ')[0] for row in rows] == [f'| {name}' for name in names]
