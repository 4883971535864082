"""`rangeseg view`: what is in the Rerun recording, and that nothing leaves the machine."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from replays import record_walls, replay, walls

from rangeseg_ros.cli.main import main
from rangeseg_ros.io.images import read_labels

pytest.importorskip('rerun')


def test_view_logs_every_frame(tmp_path, monkeypatch, capsys):
    reader = pytest.importorskip('rerun.chunk').RrdReader
    record_walls(tmp_path / 'bag', 3)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, 'argv', ['rangeseg', 'view', 'bag', '--output', 'walls.rrd'])
    with pytest.raises(SystemExit) as end:
        main()
    assert not end.value.code
    assert capsys.readouterr().out == 'walls.rrd: 3 frames\n'
    logged = {}
    for chunk in reader(tmp_path / 'walls.rrd').stream():
        if chunk.is_static:
            continue
        batch = chunk.to_record_batch()
        frames = batch.column('frame').to_pylist()
        stamps = batch.column('stamp').cast('int64').to_pylist()
        assert stamps == [10**18 + frame * 33_333_333 for frame in frames]
        for name in batch.schema.names:
            if ':' in name:
                for frame, value in zip(frames, batch.column(name).to_pylist(), strict=True):
                    logged[frame, chunk.entity_path, name] = value
    replay(tmp_path / 'bag', tmp_path / 'out')
    labels = [read_labels(path) for path in sorted((tmp_path / 'out').glob('*_labels.png'))]
    for frame, depth in enumerate(walls(3)):
        points = np.array(logged[frame, '/camera/cloud', 'Points3D:positions'])
        np.testing.assert_allclose(points[:, 2], depth.ravel() / 1000, rtol=1e-6)
        (buffer,) = logged[frame, '/labels', 'SegmentationImage:buffer']
        pixels = np.array(buffer, np.uint8).view(np.uint16)
        np.testing.assert_array_equal(pixels, labels[frame].ravel())
        hulls = logged[frame, '/camera/hulls', 'LineStrips3D:strips']
        assert sorted(round(hull[0][2], 1) for hull in hulls) == [1.5, 2.5]
        assert all(hull[0] == hull[-1] for hull in hulls)
        arrows = np.array(logged[frame, '/camera/normals', 'Arrows3D:vectors'])
        np.testing.assert_allclose(arrows, [[0, 0, -0.2]] * 2, atol=1e-3)


def test_nothing_is_sent_and_nothing_kept(tmp_path):
    record_walls(tmp_path / 'bag', 1)
    code = """
import os, pathlib
from rangeseg_ros.cli.main import main
try:
    main()
finally:
    process = pathlib.Path('/proc/self')
    tables = [process / 'net' / name for name in ('tcp', 'tcp6', 'udp', 'udp6')]
    known = {line.split()[9] for t in tables if t.exists() for line in t.open()}
    files = process / 'fd'
    links = [os.readlink(f) for f in files.iterdir() if f.is_symlink()] if files.exists() else []
    print('connections', [link for link in links if link[8:-1] in known])
"""
    home = tmp_path / 'home'
    home.mkdir()
    environment = {k: v for k, v in os.environ.items() if not k.startswith('XDG_')}
    done = subprocess.run(
        [sys.executable, '-c', code, 'view', 'bag', '--output', 'a.rrd'],
        cwd=tmp_path,
        env={**environment, 'HOME': str(home), 'PYTHONPATH': str(Path(__file__).parents[1])},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == 'connections []'
    assert not [path for path in home.rglob('*') if 'rerun' in path.name.lower()]


def test_a_view_of_nothing_leaves_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, 'argv', ['rangeseg', 'view', 'none', '--output', 'a.rrd'])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2
    assert capsys.readouterr().err == 'rangeseg: none: No such file or directory\n'
    assert not list(tmp_path.iterdir())


def test_without_rerun_view_says_what_is_missing(tmp_path, monkeypatch, capsys):
    record_walls(tmp_path / 'bag', 1)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, 'rerun', None)
    monkeypatch.setattr(sys, 'argv', ['rangeseg', 'view', 'bag', '--output', 'a.rrd'])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2
    told = "rangeseg: rerun is not installed: pip install 'rangeseg_ros[view]'\n"
    assert capsys.readouterr().err == told


def test_view_shows_the_map(tmp_path, monkeypatch):
    reader = pytest.importorskip('rerun.chunk').RrdReader
    record_walls(tmp_path / 'bag', 4)
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'p.yaml').write_text('odometry: true\n')
    arguments = ['view', 'bag', '--output', 'walls.rrd', '--params', 'p.yaml']
    monkeypatch.setattr(sys, 'argv', ['rangeseg', *arguments])
    with pytest.raises(SystemExit) as end:
        main()
    assert not end.value.code
    chunks = list(reader(tmp_path / 'walls.rrd').stream())
    (strips,) = [
        chunk.to_record_batch().column('LineStrips3D:strips').to_pylist()[0]
        for chunk in chunks
        if chunk.is_static and chunk.entity_path == '/map'
    ]
    # x is forward in the frame of the odometry.
    assert sorted(round(strip[0][0], 1) for strip in strips) == [1.5, 2.5]
    assert any('Transform3D:translation' in c.to_record_batch().schema.names for c in chunks)
