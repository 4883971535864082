"""`rangeseg bench` on small frames: what it measures, what it keeps, what it refuses."""

import json

import pytest
from click.testing import CliRunner

from rangeseg_ros.cli import bench
from rangeseg_ros.cli.bench import command
from rangeseg_ros.io.cameras import write_camera
from rangeseg_ros.io.images import write_image
from rangeseg_ros.simulation.kinect import simulate_kinect
from rangeseg_ros.simulation.scenes import kinect_room
from rangeseg_ros.simulation.sensors.kinect import kinect_camera

pytestmark = pytest.mark.slow


@pytest.fixture
def frames(tmp_path):
    """Arguments for two frames of 96x72, and the folder that holds them."""
    camera = kinect_camera(96, 72)
    write_camera(tmp_path / 'camera.yaml', camera)
    paths = []
    for seed in range(2):
        paths.append(tmp_path / f'{seed}.png')
        write_image(paths[-1], simulate_kinect(kinect_room(seed), camera, seed=seed).depth)
    return [*map(str, paths), '--camera', str(tmp_path / 'camera.yaml')]


def run(*arguments):
    result = CliRunner().invoke(command, [*map(str, arguments)])
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def test_figures_of_given_frames_and_cached_exact_energies(frames, tmp_path):
    path, cache = tmp_path / 'figures.json', tmp_path / 'cache'
    arguments = [*frames, '--rounds', 2, '--exact', '--cache', cache, '--json', path]
    params = tmp_path / 'params.yaml'
    params.write_text('min_pixels: 50\ndirection_count: 17\n')
    arguments += ['--method', 'normals', '--params', params, '--threads', 1]
    result = run(*arguments)
    assert result.exit_code == 0
    figures = json.loads(path.read_text())
    assert (figures['frames'], figures['width'], figures['method']) == (2, 96, 'normals')
    assert figures['threads'] == 1
    assert [*figures['stages']] == [
        'image',
        'noise',
        'edges',
        'normals',
        'labels',
        'regions',
        'planes',
    ]
    for stage in (*figures['stages'].values(), figures['total']):
        assert 0 <= stage['median_ms'] <= stage['p95_ms']
    assert figures['total']['p95_ms'] >= max(s['median_ms'] for s in figures['stages'].values())
    assert figures['cpu_ms'] > 0
    # Python with NumPy, SciPy and OpenCV alone takes more than 50 MB.
    assert 50 < figures['peak_memory_mb'] < 1000
    ratio = figures['energy_ratio']
    assert 0.9 < ratio['median'] <= ratio['worst'] < 1.05
    for name in ('labels', 'total', 'peak memory', f'worst {ratio["worst"]:.4f}'):
        assert name in result.output

    kept = [*cache.iterdir()]
    assert len(kept) == 2
    for file in kept:
        file.write_text(json.dumps(2 * json.loads(file.read_text())))
    run(*arguments)
    again = json.loads(path.read_text())['energy_ratio']
    assert again['worst'] == pytest.approx(ratio['worst'] / 2)


def test_sizes_of_simulated_frames(monkeypatch, tmp_path):
    monkeypatch.setattr(bench, 'VGA', (64, 48))
    monkeypatch.setattr(bench, 'SIZES', ((64, 48), (96, 72)))
    path = tmp_path / 'figures.json'
    result = run('--scaling', '--scenes', 1, '--rounds', 1, '--json', path)
    assert result.exit_code == 0
    figures = json.loads(path.read_text())
    series = figures.pop('scaling')
    assert series['64x48'] == {**figures, 'ratio': 1.0}
    other = series['96x72']
    assert (other['width'], other['height'], other['method']) == (96, 72, 'planes')
    assert other['ratio'] == pytest.approx(
        other['total']['median_ms'] / figures['total']['median_ms']
    )
    assert '96x72' in result.output


def test_bad_input(frames, tmp_path):
    assert 'belong together' in run(frames[0]).output
    assert 'belong together' in run(*frames[-2:]).output
    assert '--scaling' in run(*frames, '--scaling').output
    other = tmp_path / 'other.png'
    write_image(other, simulate_kinect(kinect_room(0), kinect_camera(32, 24)).depth)
    with pytest.raises(ValueError, match=r'other\.png: depth image is 32x24, its camera 96x72'):
        run(other, *frames[-2:])
    # The same in the process that measures.
    with pytest.raises(ValueError, match=r'other\.png: depth image is 32x24, its camera 96x72'):
        run(frames[0], other, *frames[-2:], '--rounds', 1)
