"""The pages of replay and evaluate, what a browser makes of them, and pictures."""

import html
import os
import re
from dataclasses import replace
from types import SimpleNamespace
from urllib.parse import quote, unquote
from urllib.request import urlopen

import cv2
import numpy as np
import pytest
from replays import record_walls, walls

from rangeseg_ros import Camera, Config, RangeImage
from rangeseg_ros.batch.frame_files import write_frame
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.drawing import colours, grey, overlay
from rangeseg_ros.report import charts
from rangeseg_ros.report.page import MAX_PICTURES, Picture, evenly_spaced
from rangeseg_ros.report.replay import ReplayReport


def sources_and_text(path):
    """What a page loads or links to, and what it says."""
    page = path.read_text(encoding='utf-8')
    tags = '\n'.join(re.findall('<[^>]*>', page))
    return re.findall(' (?:src|href)="(.*?)"', tags), html.unescape(re.sub('<[^>]*>', '', page))


def test_a_page_is_self_contained_and_says_what_was_found(tmp_path):
    """Of three frames of walls and one without a measurement, whose picture is gone."""
    config, path = Config(min_pixels=499), tmp_path / 'report.html'
    sequence = SequenceSegmenter(config)
    report = ReplayReport('<script>alert(1)</script>', config)
    for index, depth in enumerate([*walls(3), np.zeros((48, 64), np.uint16)]):
        image = RangeImage.from_depth(depth, Camera(64, 48, 50.0, 50.0, 31.5, 23.5))
        stamp = 10**18 + index * 500_000_000
        # The last frame has not come to the labels.
        times = {'edges': 2.0} | ({'labels': (10.0, 20.0, 40.0)[index]} if index < 3 else {})
        result = replace(sequence.segment(image, stamp), timings=times)
        files = write_frame(tmp_path, f'{index}', image, result, ['overlay'])
        report.add(stamp, result, files['overlay'])
    files['overlay'].unlink()
    report.write(path, 'file ends within a record')
    sources, text = sources_and_text(path)
    page = path.read_text()
    assert len(sources) == 4 + 2  # overlays, charts
    assert all(source.startswith('data:image/') for source in sources)
    pictures = [np.frombuffer(urlopen(source).read(), np.uint8) for source in sources[:4]]
    shapes = [cv2.imdecode(picture, cv2.IMREAD_UNCHANGED).shape for picture in pictures]
    assert shapes == [(48, 64, 3)] * 3 + [(1, 1, 3)]
    assert not re.search(r'url\(|@import|<link', page)
    assert '4 frames in 1.5 s, 2 planes in the median frame, 2 ids in all' in text
    assert 'file ends within a record' in text
    assert re.search(r'Errors of the sensor, median over the frames: noise 0\.\d+ 1/m', text)
    assert 'frame 2: 2 planes' in text and 'frame 3: no valid depth' in text
    assert re.search(r'without planes\s*number\s*reason\s*1\s*no valid depth', text)
    # Median, 95th percentile and most.
    for stage in ('edges2.02.02.0', 'labels15.037.040.0', 'total17.039.042.0'):
        assert f'\n{stage}\n' in text
    # Parameters that were changed are marked; names are text.
    rows = re.findall(r'<tr class="changed"><td>(\w+)</td><td>(.*?)</td>', page)
    assert rows == [('min_pixels', '499')]
    for name in Config.__dataclass_fields__:
        assert f'<td>{name}</td>' in page
    assert page.count('<script') == 1 and '<script>alert(1)</script>' in text


def test_a_page_of_nothing(tmp_path):
    ReplayReport('nothing', Config()).write(tmp_path / 'report.html')
    sources, text = sources_and_text(tmp_path / 'report.html')
    assert '0 frames in 0.0 s, 0 planes in the median frame, 0 ids' in text and not sources


def test_long_sequences_are_shown_from_first_to_last(tmp_path):
    pictures = [Picture(tmp_path, str(n)) for n in range(1000)]
    chosen = [int(picture.title) for picture in evenly_spaced(pictures)]
    assert (len(chosen), chosen[0], chosen[-1]) == (MAX_PICTURES, 0, 999)
    assert set(np.diff(chosen)) <= {21, 22}
    assert evenly_spaced(pictures[:3]) == pictures[:3]


def sightings(*rows):
    return np.array([(*row, (0.0, 0.0, -1.0)) for row in rows], charts.SIGHTING)


def test_planes_of_most_area_over_time_are_charted_where_they_are_in_sight(monkeypatch):
    seen = sightings((0, 5, 1.0, 2.0), (0, 9, 4.0, 2.0), (1, 5, 1.0, 2.0), (1, 7, 3.0, 2.0))
    assert charts.longest_seen(seen, 2).tolist() == [9, 7]
    assert charts.longest_seen(seen, 9).tolist() == [9, 7, 5]
    # Bars and lines break where a plane is out of sight; drifts are told from medians.
    monkeypatch.setattr(charts, 'svg', lambda figure: figure)
    times = np.arange(10) * 0.5
    seen = sightings(*((frame, number, 1.0, 2.0) for frame in (1, 2, 4) for number in (4, 9)))
    figure = charts.id_bars(seen, times)
    (axes,) = figure.axes
    assert [label.get_text() for label in axes.get_yticklabels()] == ['4', '9']
    assert figure.get_size_inches().tolist() == [10, 1.2 + 0.2 * 2]
    for row, bars in enumerate(axes.collections):
        spans = [path.get_extents().extents.tolist() for path in bars.get_paths()]
        assert spans == [[0.5, row - 0.4, 1.5, row + 0.4], [2.0, row - 0.4, 2.5, row + 0.4]]
    (bars,) = charts.id_bars(sightings((0, 4, 1.0, 2.0)), times[:1]).axes[0].collections
    assert bars.get_paths()[0].get_extents().width == 1
    seen = sightings((0, 5, 1.0, 2.0), (1, 5, 1.0, 2.01), (4, 5, 1.0, 2.03))
    seen['normal'][1] = 0.0, np.sin(0.02), -np.cos(0.02)
    shown, degrees = charts.drifts(seen, times).axes, np.degrees(0.02)
    for axes, told in zip(shown, ([-10, 0, np.nan, 20], [0, degrees, np.nan, 0]), strict=True):
        (line,) = axes.lines
        np.testing.assert_allclose(line.get_xdata(), [0, 0.5, np.nan, 2])
        np.testing.assert_allclose(line.get_ydata(), told, atol=1e-6)
    assert shown[1].get_ylim()[0] == 0


def test_an_overview_leads_to_the_reports_of_several_recordings(tmp_path, monkeypatch, run):
    monkeypatch.chdir(tmp_path)
    names = ['walls', 'torn #2']
    for name in names:
        record_walls(tmp_path / name, 16)
    file = next((tmp_path / names[1]).glob('*.mcap'))
    os.truncate(file, file.stat().st_size - 100)
    pages = []
    for _ in range(2):  # the second time, all is found done
        assert run('replay', *names, '--output', 'out', '--jobs', 1)[0] == 1
        pages.append((tmp_path / 'out/index.html').read_text(encoding='utf-8'))
    assert pages[0] == pages[1]
    links, text = sources_and_text(tmp_path / 'out/index.html')
    assert links == [f'{quote(name)}/report.html' for name in names]
    assert all((tmp_path / 'out' / unquote(link)).exists() for link in links)
    whole, torn = (line for line in text.splitlines() if line.startswith(tuple(names)))
    assert whole == 'walls160.5220' and torn.startswith('torn #2') and 'damaged after' in torn


def test_colours_can_be_told_apart():
    palette = colours(range(1, 49))
    # CIE L*a*b*: 2.3 is a just noticeable difference.
    lab = cv2.cvtColor(palette[None] / np.float32(255), cv2.COLOR_RGB2LAB)[0]
    assert np.linalg.norm(lab[:, None] - lab, axis=2)[np.triu_indices(48, 1)].min() > 5 * 2.3
    assert np.hypot(lab[:, 1], lab[:, 2]).min() > 5 * 2.3  # nor taken for grey
    np.testing.assert_array_equal(colours([5, 9, 49]), palette[[4, 8, 0]])
    assert palette[0].argmax() == 2, 'blue'


def test_unlabelled_pixels_stay_grey_and_labelled_ones_have_their_colour():
    inverse = np.full((20, 30), 0.5, np.float32)
    inverse[:, 25:] = 0
    labels = np.zeros((20, 30), np.uint16)
    labels[5:15, 5:15] = 3
    picture = overlay(inverse, labels)
    assert picture.shape == (20, 30, 3) and picture.dtype == np.uint8
    assert (picture[labels == 0] == grey(inverse)[labels == 0][:, None]).all()
    assert not picture[:, 25:].any()
    inner = picture[6:13, 6:13].reshape(-1, 3)
    assert (inner == inner[0]).all()
    mixed = 0.45 * grey(inverse)[6, 6] + 0.55 * colours([3])[0].astype(float)
    np.testing.assert_allclose(inner[0], mixed, atol=0.51)
    # Colours follow ids, not labels.
    planes = [SimpleNamespace(label=label, id=9) for label in (1, 3)]
    first, second = (overlay(inverse, labels // 3 * plane.label, [plane]) for plane in planes)
    np.testing.assert_array_equal(first, second)
    assert (first != picture).any()


def test_an_id_is_written_where_its_region_is_widest():
    labels = np.zeros((240, 320), np.uint16)
    labels[:220, 20:40] = labels[100:220, 20:140] = 1
    labels[:, 200:206] = 2
    planes = [SimpleNamespace(label=1, id=8), SimpleNamespace(label=2, id=8)]
    picture = overlay(np.full(labels.shape, 0.5, np.float32), labels, planes)
    white = (picture > 200).all(axis=2)
    rows, columns = np.nonzero(white)
    # In every second pixel, the first of four that are as far from the border.
    assert (rows.mean(), columns.mean()) == pytest.approx((158, 78), abs=1)
    (wide, high), _ = cv2.getTextSize('8', cv2.FONT_HERSHEY_SIMPLEX, 0.8, 1)
    assert high / 2 < np.ptp(rows) < high and wide / 3 < np.ptp(columns) < wide
    outline = cv2.dilate(white.astype(np.uint8), np.ones((3, 3), np.uint8)) > white
    assert picture[outline].max(axis=1).mean() < 80, 'dark around'


def test_what_is_near_is_bright_between_the_extremes_of_what_is_measured():
    found = grey(np.r_[np.linspace(1, 2, 1001), [0] * 99][None].astype(np.float32))[0, :1001]
    assert found[0] == found[20] == 60 and found[-1] == found[980] == 235
    assert (np.diff(found.astype(int)) >= 0).all() and found[500] in (147, 148)


@pytest.mark.parametrize('shape', [(1, 1), (1, 7), (424, 3)])
@pytest.mark.parametrize('value', [0.0, 1.0])
def test_any_size_and_no_measurement(shape, value):
    inverse, plane = np.full(shape, value, np.float32), SimpleNamespace(label=1, id=1)
    assert grey(inverse).shape == shape
    assert overlay(inverse, np.ones(shape, np.uint16), [plane]).shape == (*shape, 3)
