"""What is there already: kept, replaced when that is said, repaired when it is our own."""

import json
import os
import shutil
import stat
from pathlib import Path

import numpy as np
import pytest
from replays import record_walls, results

from rangeseg_ros.io.files import FileError, replacing
from rangeseg_ros.io.images import write_image

pytestmark = pytest.mark.slow


def write(path, text='new'):
    with replacing(path) as partial:
        partial.write_text(text)


def test_links_are_followed_and_pipes_and_devices_stay(tmp_path):
    (tmp_path / 'there').write_text('old')
    (tmp_path / 'there').chmod(0o640)
    (tmp_path / 'soft').symlink_to('there')
    (tmp_path / 'hard').hardlink_to(tmp_path / 'there')
    (tmp_path / 'dangling').symlink_to('elsewhere')
    write(tmp_path / 'soft', 'one')
    assert (tmp_path / 'there').read_text() == 'one' and (tmp_path / 'soft').is_symlink()
    # As of an input, say: what replaces a file is whole at any time, so it is another one.
    assert (tmp_path / 'hard').read_text() == 'old'
    assert stat.S_IMODE((tmp_path / 'there').stat().st_mode) == 0o640
    write(tmp_path / 'dangling', 'two')
    assert (tmp_path / 'elsewhere').read_text() == 'two'
    os.mkfifo(tmp_path / 'pipe')
    before = sorted(tmp_path.iterdir())
    for path in (tmp_path / 'pipe', Path('/dev/null')):
        mode = path.stat().st_mode
        with pytest.raises(FileError, match='not a regular file'):
            write(path)
        assert path.stat().st_mode == mode
    assert sorted(tmp_path.iterdir()) == before


def test_segment_replaces_no_input_and_nothing_without_being_told(folder, run, refused):
    segment = ('segment', 'depth/2.png', '--camera', 'camera.yaml', '--output')
    labels, planes = Path('depth/2_labels.png'), Path('out/2_planes.csv')
    before = shutil.copy('depth/10.png', labels).read_bytes()
    for more in ((), ('--overwrite',)):
        assert '2_labels.png: is an input' in refused(*segment, 'depth', labels, *more)
    assert labels.read_bytes() == before
    assert run(*segment, 'out')[0] == 0
    planes.write_text('mine')
    assert '--overwrite' in refused(*segment, 'out')
    assert planes.read_text() == 'mine'
    assert run(*segment, 'out', '--overwrite')[0] == 0
    assert planes.read_text() != 'mine'


def test_figures_replace_figures_alone(folder, run, refused):
    compare = ('compare', 'depth/2.png', 'depth/2.png', '--json')
    before = Path('depth/10.png').read_bytes()
    assert 'exists already' in refused(*compare, 'depth/10.png')
    assert Path('depth/10.png').read_bytes() == before
    Path('camera.json').write_text(json.dumps({'width': 64}, indent=2))
    assert 'exists already' in refused(*compare, 'camera.json')
    assert 'no such folder' in refused(*compare, 'nowhere/x.json')
    assert not Path('nowhere').exists()
    # What begins as figures do may be replaced, and what is empty.
    Path('x.json').touch()
    for _ in range(2):
        assert run(*compare, 'x.json')[0] == 0
    assert json.loads(Path('x.json').read_text())['images'] == 1


@pytest.fixture
def walls(tmp_path):
    record_walls(tmp_path / 'walls', 3)
    return tmp_path / 'walls', tmp_path / 'out'


@pytest.mark.parametrize('name', ['planes.csv', '000000_1.000000000_labels.png'])
def test_replay_leaves_what_no_replay_has_written(walls, run, refused, name):
    recording, out = walls
    out.mkdir()
    (out / name).write_text('mine')
    assert f'{name}: exists already' in refused('replay', recording, '--output', out)
    assert [path.name for path in out.iterdir()] == [name]
    assert run('replay', recording, '--output', out, '--overwrite')[0] == 0
    assert (out / 'bag').exists() and not list(out.glob('.*'))


def test_replay_leaves_the_overview_of_somebody_else(walls, refused):
    recording, out = walls
    more = shutil.copytree(recording, recording.with_name('more'))
    out.mkdir()
    (out / 'index.html').write_text('mine')
    assert 'index.html: exists already' in refused('replay', recording, more, '--output', out)
    assert [path.name for path in out.iterdir()] == ['index.html']


def test_results_that_are_gone_or_changed_are_made_again(walls, run):
    recording, out = walls
    run('replay', recording, '--output', out)
    expected = results(out)
    for spoil in (
        lambda: next(out.glob('*_labels.png')).unlink(),
        lambda: (out / 'planes.csv').write_text('frame'),
        lambda: next(out.glob('bag/*.mcap')).write_bytes(b''),
        lambda: next(out.glob('bag/*.mcap')).unlink(),
    ):
        spoil()
        code, output, _ = run('replay', recording, '--output', out)
        assert code == 0 and 'done before' not in output
        assert results(out) == expected
    assert 'done before' in run('replay', recording, '--output', out)[1]


def test_a_recording_is_not_replaced_by_its_own_results(walls, refused):
    recording, out = walls
    out.mkdir()
    shutil.move(recording, out / 'bag')
    for more in ((), ('--overwrite',)):
        assert 'it is the recording' in refused('replay', out / 'bag', '--output', out, *more)
    assert list((out / 'bag').glob('*.mcap'))


def test_images_of_like_names_are_told_apart(tmp_path, monkeypatch, run, refused):
    monkeypatch.chdir(tmp_path)
    for name in ('set/a/b', 'set/a_b', 'set/c'):
        folder = tmp_path / name
        write_image(folder / 'depth.png', np.full((48, 64), 1000, np.uint16))
        write_image(folder / 'truth.png', np.ones((48, 64), np.uint16))
        (folder / 'camera.txt').write_text('50 50 31.5 23.5')
    evaluate = ('evaluate', 'set', '--json', 'x.json', '--output', 'out', '--jobs', 1)
    assert run(*evaluate)[0] == 0
    figures = json.loads(Path('x.json').read_text())
    assert figures['images'] == 3 and len(figures['per_image']) == 3
    assert len(list(Path('out').glob('*_labels.png'))) == 3
    assert 'exists already' in refused(*evaluate)
    # They are of no part of a set, and so of any.
    assert run(*evaluate, '--overwrite', '--split', 'test')[0] == 0
