"""The commands segment, pack, replay and bench, as a user starts them."""

import re

import cv2
import numpy as np
import pytest
import yaml
from recordings import depth_images, record
from replays import rows_of

from rangeseg_ros.cli import segment
from rangeseg_ros.io.bags import DepthBag
from rangeseg_ros.io.images import read_labels, write_image

CAMERA = '--camera', 'camera.yaml'


def files(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob('*') if path.is_file())


def test_segment_writes_labels_overlay_and_planes(folder, run):
    depth = 1500 + np.random.default_rng(0).normal(0, 4, (48, 64))
    write_image(folder / 'depth' / '3.png', np.rint(depth).astype(np.uint16))
    images = [f'depth/{n}.png' for n in (2, 3, 10)]
    code, output, error = run('segment', *images, *CAMERA, '--output', 'out/here', '--sensor')
    assert (code, error) == (0, '')
    kinds = ('height.tiff', 'labels.png', 'overlay.png', 'planes.csv', 'stairs.csv', 'terrain.png')
    assert files(folder / 'out/here') == sorted(f'{n}_{k}' for n in (2, 3, 10) for k in kinds)
    labels = read_labels(folder / 'out/here/2_labels.png')
    found = {int(row['label']) for row in rows_of(folder / 'out/here/2_planes.csv')}
    assert found == set(np.unique(labels)) - {0}
    assert 'depth/10.png: no plane: no valid depth' in output
    assert cv2.imread('out/here/2_overlay.png').shape == (*labels.shape, 3) == (48, 64, 3)
    # What the sensor errs by, measured.
    (said,) = re.findall(r'^depth/3.png: noise ([.\d]+) 1/m', output, re.M)
    assert float(said) == pytest.approx(0.004 / 1.5**2, rel=0.3)


def test_segment_goes_on_after_a_bad_file_and_leaves_its_own_results_out(folder, run):
    (folder / 'depth' / '3.png').write_text('no image')
    segment = 'segment', 'depth', *CAMERA, '--output', 'depth'
    code, output, error = run(*segment)
    assert code == 2 and re.fullmatch(r'rangeseg: depth/3.png: .*\n', error)
    assert re.findall(r'^depth/(\d+).png: ', output, re.M) == ['2', '10']
    (folder / 'depth' / '3.png').unlink()
    assert run(*segment, '--overwrite') == (0, output, '')


def test_segment_compiles_before_the_first_image_and_for_its_parameters(folder, run, monkeypatch):
    def prepare(config, kinds, report, outputs):
        prepared.append((config.method, kinds, files(folder)))

    prepared = []
    monkeypatch.setattr(segment, 'prepare', prepare)
    (folder / 'params.yaml').write_text('method: normals')
    before = files(folder)
    options = '--output', 'out', '--params', 'params.yaml'
    # Nothing for what cannot be read.
    assert run('segment', 'params.yaml', *CAMERA, *options)[0] == 2 and not prepared
    assert run('segment', 'depth/2.png', *CAMERA, *options)[0] == 0
    assert prepared == [('normals', ('image',), before)]


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['none.png'], "Path 'none.png' does not exist"),
        (['depth/2.png', '--depth-scale', '0'], '--depth-scale'),
        (['depth/2.png', '--params', 'params.yaml'], "params.yaml: unknown parameter 'smooth'"),
        (['large.png'], 'large.png: depth image is 65x48, its camera 64x48'),
        (['depth/2.png', 'other/2.png'], '2 images named 2'),
        ([], 'Missing argument'),
    ],
)
def test_bad_input_of_segment_is_one_line_and_code_2(folder, refused, arguments, message):
    (folder / 'params.yaml').write_text('smooth: 3')
    cv2.imwrite('large.png', np.zeros((48, 65), np.uint16))
    write_image(folder / 'other/2.png', np.zeros((48, 64), np.uint16))
    assert message in refused('segment', *arguments, *CAMERA, '--output', 'out')
    assert not (folder / 'out').exists()


def test_pack_and_replay(folder, run):
    assert run('pack', 'depth', *CAMERA, '--output', 'bag', '--rate', 4)[0] == 0
    with DepthBag(folder / 'bag') as bag:
        frames = list(bag)
    assert [frame.stamp for frame in frames] == [1_000_000_000, 1_250_000_000]
    assert [int(frame.depth.max()) for frame in frames] == [1500, 0]  # 2 before 10
    code, output, error = run('replay', 'bag', '--output', 'out')
    assert (code, error) == (0, '')
    stems = ('000000_1.000000000', '000001_1.250000000')
    pictures = [f'{stem}_{kind}.png' for stem in stems for kind in ('labels', 'overlay')]
    bag = ['bag/bag.mcap', 'bag/metadata.yaml']
    assert files(folder / 'out') == [*pictures, *bag, 'planes.csv', 'report.html']
    assert '1 frames without a plane: no valid depth' in output and 'out: 2 frames' in output
    run('segment', 'depth/2.png', *CAMERA, '--output', 'same')
    replayed, same = f'out/{stems[0]}_labels.png', 'same/2_labels.png'
    np.testing.assert_array_equal(read_labels(folder / replayed), read_labels(folder / same))
    rows = [row for row in rows_of(folder / 'out/planes.csv') if row.pop('frame') == '0']
    assert {row.pop('stamp') for row in rows} <= {'1.000000000'}
    assert rows == rows_of(folder / 'same/2_planes.csv')


def test_the_largest_of_16_bits_stays_unmeasured_when_it_is_packed(folder, run):
    write_image(folder / 'depth' / '2.png', np.full((48, 64), 65535, np.uint16))
    for scale, kind in (('0.001', np.uint16), ('0.0002', np.float32)):
        bag = f'bag{scale}'
        run('pack', 'depth', *CAMERA, '--output', bag, '--depth-scale', scale)
        with DepthBag(folder / bag) as frames:
            (frame, _) = frames
        assert frame.depth.dtype == kind and not frame.range_image().valid.any()
    write_image(folder / 'depth' / '2.png', np.full((48, 64), 100, np.uint8))
    run('pack', 'depth', *CAMERA, '--output', 'bag8')
    with DepthBag(folder / 'bag8') as frames:
        assert next(iter(frames)).depth.max() == np.float32(0.1)


def test_a_lens_is_not_ignored_in_silence(folder, run, recwarn):
    calibration = yaml.safe_load((folder / 'camera.yaml').read_text())
    calibration['distortion_coefficients']['data'] = [-0.2, 0.05, 0, 0, 0]
    (folder / 'camera.yaml').write_text(yaml.safe_dump(calibration))
    command = 'segment', 'depth/2.png', *CAMERA, '--output'
    code, _, error = run(*command, 'rectified')
    assert code == 0 and error.count('D beside P is left out') == 1 and error.count('\n') == 1
    assert run(*command, 'raw', '--raw')[::2] == (0, '')
    del calibration['projection_matrix']
    (folder / 'camera.yaml').write_text(yaml.safe_dump(calibration))
    assert run(*command, 'no_p')[::2] == (0, '')
    tables = {name: (folder / name / '2_planes.csv').read_text() for name in ('raw', 'no_p')}
    assert tables['raw'] == tables['no_p'] != (folder / 'rectified/2_planes.csv').read_text()


def test_bad_input_of_pack(folder, refused):
    (folder / 'empty').mkdir()
    write_image(folder / 'sizes/1.png', np.zeros((48, 64), np.uint16))
    write_image(folder / 'sizes/2.png', np.zeros((48, 65), np.uint16))
    files = *CAMERA, '--output', 'bag'
    for message, *arguments in (
        ("Directory 'none' does not exist", 'none'),
        ('empty: no .png', 'empty'),
        ('sizes/2.png: depth image is 65x48, its camera 64x48', 'sizes'),
        *(('--depth-scale', 'depth', '--depth-scale', v) for v in ('nan', 'inf', '1e300', 0)),
        *(('--rate', 'depth', '--rate', v) for v in ('nan', 'inf', '1e-12', '1e300', 0)),
    ):
        assert message in refused('pack', *arguments, *files)
        assert not list(folder.glob('*bag*'))
    (folder / 'bag').mkdir()
    assert refused('pack', 'depth', *files) == 'rangeseg: bag: exists already, not overwritten\n'


def test_bad_input_of_replay_leaves_nothing(folder, refused):
    for name in ('good', 'other/good'):
        record(folder / name, 'mcap', depth_images(1))
    for arguments, message in (
        (['good', 'none'], 'none: No such file'),
        (['good', '--depth-topic', '/x'], 'no depth image on /x; topics: '),
        (['good', '--camera-topic', '/x'], 'no camera_info on /x; topics: '),
        (['good', 'other/good/good.mcap'], '2 recordings named good would write the same results'),
    ):
        assert message in refused('replay', *arguments, '--output', 'out')
        assert not (folder / 'out').exists()


@pytest.mark.slow
def test_figures_of_given_frames(folder, figures_of):
    (folder / 'params.yaml').write_text('min_pixels: 50\ndirection_count: 17\n')
    options = '--rounds', 2, '--method', 'normals', '--params', 'params.yaml', '--threads', 1
    code, figures, output, _ = figures_of('bench', *2 * ['depth/2.png'], *CAMERA, *options)
    told = {'frames': 2, 'rounds': 2, 'width': 64, 'height': 48, 'method': 'normals', 'threads': 1}
    assert code == 0 and told.items() <= figures.items()
    assert {'image', 'edges', 'normals', 'labels', 'planes'} <= figures['stages'].keys()
    for stage in (*figures['stages'].values(), figures['total']):
        assert 0 <= stage['median_ms'] <= stage['p95_ms']
    assert figures['total']['p95_ms'] >= max(s['median_ms'] for s in figures['stages'].values())
    # One thread, and what those of libraries spin beside it.
    assert 0 < figures['cpu_ms'] < 4 * figures['total']['p95_ms']
    # Python with NumPy, SciPy and OpenCV alone takes more than 50 MB.
    assert 50 < figures['peak_memory_mb'] < 1000
    assert all(name in output for name in ('labels', 'total', 'peak memory'))


@pytest.mark.slow
def test_bad_input_of_bench(folder, run):
    assert 'belong together' in run('bench', 'depth/2.png')[2]
    write_image(folder / 'other.png', np.full((24, 32), 1500, np.uint16))
    # Before and in the process that measures.
    for paths in (('other.png',), ('depth/2.png', 'other.png')):
        code, _, error = run('bench', *paths, *CAMERA, '--rounds', 1)
        assert code == 2 and re.search(r'other\.png: .* 32x24, its camera 64x48', error)
