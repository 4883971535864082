"""`rangeseg bench` on small frames: what it measures, what it refuses."""

import json
import re

import pytest

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


def test_figures_of_given_frames(frames, tmp_path, run):
    path = tmp_path / 'figures.json'
    params = tmp_path / 'params.yaml'
    params.write_text('min_pixels: 50\ndirection_count: 17\n')
    arguments = [*frames, '--rounds', 2, '--json', path, '--method', 'normals']
    code, output, _ = run('bench', *arguments, '--params', params, '--threads', 1)
    assert code == 0
    figures = json.loads(path.read_text())
    assert (figures['frames'], figures['width'], figures['method']) == (2, 96, 'normals')
    assert figures['threads'] == 1
    assert {'image', 'edges', 'normals', 'labels', 'planes'} <= figures['stages'].keys()
    for stage in (*figures['stages'].values(), figures['total']):
        assert 0 <= stage['median_ms'] <= stage['p95_ms']
    assert figures['total']['p95_ms'] >= max(s['median_ms'] for s in figures['stages'].values())
    assert figures['cpu_ms'] > 0
    # Python with NumPy, SciPy and OpenCV alone takes more than 50 MB.
    assert 50 < figures['peak_memory_mb'] < 1000
    for name in ('labels', 'total', 'peak memory'):
        assert name in output


def test_bad_input(frames, tmp_path, run):
    assert 'belong together' in run('bench', frames[0])[2]
    other = tmp_path / 'other.png'
    write_image(other, simulate_kinect(kinect_room(0), kinect_camera(32, 24)).depth)
    # Before and in the process that measures.
    for paths in ((other,), (frames[0], other)):
        code, _, error = run('bench', *paths, *frames[-2:], '--rounds', 1)
        assert code == 2 and re.search(r'other\.png: .* 32x24, its camera 96x72', error)
