"""The bags that `rangeseg replay` writes, by whom, and when it starts a recording again."""

import os
import signal
import subprocess
from collections import Counter

import numpy as np
import pytest
from mcap.reader import make_reader
from processes import RANGESEG, wait_for
from recordings import record, stamp_of
from replays import DELAY, read, record_walls, replay, results, rows_of, walls
from rosbags import rosbag2

from rangeseg_ros.batch.replay import Replay
from rangeseg_ros.core.config import Config
from rangeseg_ros.io.images import read_labels
from rangeseg_ros.io.recordings import BagError
from rangeseg_ros.messages.clouds import planes_from_message

pytestmark = pytest.mark.slow

TOPICS = [f'/segment_planes/{name}' for name in ('labels', 'planes', 'markers')]


@pytest.fixture(scope='module')
def done(tmp_path_factory):
    """Folder with a recording and its replay, and with a copy of its topics."""
    folder = tmp_path_factory.mktemp('replay')
    record_walls(folder / 'recording')
    replay(folder / 'recording', folder / 'plain')
    replay(folder / 'recording', folder / 'copy', copy=True)
    return folder


def assert_shown(folder, name):
    """Messages of labels or terrain are the pictures in the folder."""
    images = [m for _, topic, m, _ in read(folder / 'bag') if topic.endswith(f'/{name}')]
    pictures = sorted(folder.glob(f'*_{name}.png'))
    assert len(pictures) == 4
    for image, picture in zip(images, pictures, strict=True):
        kind = {'mono16': '<u2', 'mono8': 'u1'}[image.encoding]
        pixels = image.data.view(kind).reshape(image.height, image.width)
        np.testing.assert_array_equal(pixels, read_labels(picture))
    return pictures


def test_messages_agree_with_the_recording_and_the_files(done):
    messages = read(done / 'plain/bag')
    assert [message[:2] for message in messages] == [
        (stamp_of(index) + DELAY, topic) for index in range(4) for topic in TOPICS
    ]
    for recorded, topic, message, _ in messages:
        headers = [m.header for m in getattr(message, 'markers', [message])]
        for header in headers:
            assert header.stamp.sec * 10**9 + header.stamp.nanosec == recorded - DELAY
            assert header.frame_id == 'optical'
        assert len(headers) > (4 if topic.endswith('markers') else 0)
    assert_shown(done / 'plain', 'labels')
    tables = [planes_from_message(m) for _, topic, m, _ in messages if topic.endswith('planes')]
    rows = rows_of(done / 'plain/planes.csv')
    ids = [[int(row['id']) for row in rows if row['frame'] == str(n)] for n in range(4)]
    assert [table['id'].tolist() for table in tables] == ids
    # Two walls, two ids, in every frame.
    assert ids == [ids[0]] * 4 and len(set(ids[0])) == 2
    # Readers of MCAP that know nothing of ROS find them, too.
    with (done / 'plain/bag/bag.mcap').open('rb') as file:
        found = Counter(channel.topic for _, channel, _ in make_reader(file).iter_messages())
    assert found == dict.fromkeys(TOPICS, 4)


def test_copied_topics_are_as_they_were(done):
    replay(done / 'copy/bag', done / 'again', copy=True)
    originals, ours, both, again = (
        [(time, topic, data) for time, topic, _, data in read(done / folder)]
        for folder in ('recording', 'plain/bag', 'copy/bag', 'again/bag')
    )
    # Results in a recording are not copied beside the new ones.
    assert again == both
    assert [m[0] for m in both] == sorted(m[0] for m in both)
    assert sorted(m for m in both if not m[1].startswith('/segment_planes')) == sorted(originals)
    assert [m for m in both if m[1].startswith('/segment_planes')] == ours
    with rosbag2.Reader(done / 'recording') as before, rosbag2.Reader(done / 'copy/bag') as after:
        copies = {(c.topic, c.msgtype, c.msgdef, c.digest) for c in after.connections}
        assert copies >= {(c.topic, c.msgtype, c.msgdef, c.digest) for c in before.connections}


@pytest.mark.parametrize('storage', ['rosbag1', 'mcap'])
def test_copies_need_a_whole_rosbag2(tmp_path, storage):
    path = tmp_path / 'recording.bag'
    file = record(path, storage, walls(3))
    if storage == 'mcap':  # without its end
        os.truncate(file, file.stat().st_size - 100)
    with pytest.raises(BagError, match='not a whole rosbag2 to copy from'):
        replay(path, tmp_path / 'out', copy=True)
    assert not (tmp_path / 'out').exists()
    assert replay(path, tmp_path / 'out').frames == 3


def test_a_finished_recording_is_not_done_again(tmp_path):
    path = record_walls(tmp_path / 'recording', 2)
    out = tmp_path / 'out'
    first = replay(path, out)
    assert (first.frames, first.already_done) == (2, False)
    bag = (out / 'bag').stat().st_ino
    (path / 'notes.txt').touch()  # not of the recording
    again = replay(path, out)
    assert (again.frames, again.notes, again.already_done) == (2, first.notes, True)
    assert (out / 'bag').stat().st_ino == bag
    # Other parameters, other topics and another recording are other results, not replaced unasked.
    other = Config(min_pixels=499)
    with pytest.raises(BagError, match='results of other input, parameters or code, not over'):
        Replay(path, out, other).run()
    assert not Replay(path, out, other, overwrite=True).run().already_done
    assert not replay(path, out, overwrite=True).already_done
    assert not replay(path, out, overwrite=True, topics=('planes',)).already_done
    os.utime(next(path.glob('*.mcap')), ns=(0, 0))
    assert not replay(path, out, overwrite=True, topics=('planes',)).already_done


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGKILL])
def test_an_interrupted_or_killed_replay_is_started_again(done, tmp_path, number):
    path = record_walls(tmp_path / 'recording', 200)
    words = *RANGESEG, 'replay', path, '--output', 'out'
    streams = {'stdout': subprocess.DEVNULL, 'stderr': subprocess.PIPE}
    process = subprocess.Popen(words, cwd=tmp_path, start_new_session=True, **streams)
    try:
        wait_for(lambda: len([*tmp_path.glob('out/.*/*_labels.png')]) > 2, process)
        process.send_signal(number)
        _, error = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == (130 if number == signal.SIGINT else -number), error
    assert b'Traceback' not in error
    left = [path.name[0] for path in (tmp_path / 'out').iterdir()]
    assert left == ([] if number == signal.SIGINT else ['.'])
    replay(done / 'recording', tmp_path / 'out')
    assert results(tmp_path / 'out') == results(done / 'plain')
    assert not list(tmp_path.glob('out/.*'))


def test_a_recording_that_fails_costs_no_other_in_many_processes(tmp_path, monkeypatch, run):
    monkeypatch.chdir(tmp_path)
    for name in 'abc':
        replay(record_walls(tmp_path / name, 2), tmp_path / 'local' / name)
    (tmp_path / 'out').mkdir()
    (tmp_path / 'out/b').touch()
    code, output, error = run('replay', *'abc', '--output', 'out', '--jobs', 2)
    assert code == 2 and error.startswith('rangeseg: b: ') and error.count('\n') == 1
    assert 'out/a: 2 frames' in output and 'out/c: 2 frames' in output
    page = (tmp_path / 'out/index.html').read_text()
    assert 'a/report.html' in page and 'b/report.html' not in page and 'c/report.html' in page
    for name in 'ac':
        assert results(tmp_path / 'out' / name) == results(tmp_path / 'local' / name)


def test_terrain_of_every_frame_is_that_of_the_messages(done):
    folder = done / 'terrain'
    outcome = replay(done / 'recording', folder, terrain=True, topics=('terrain', 'stairs'))
    assert not outcome.warnings
    pictures = assert_shown(folder, 'terrain')
    assert len(list(folder.glob('*_height.tiff'))) == 4
    rows = rows_of(folder / 'ground.csv')
    assert list(rows[0]) == ['frame', 'stamp', 'found', 'height', 'confidence', 'tilt']
    assert [row['frame'] for row in rows] == ['0', '1', '2', '3']
    # Two walls: no ground, and no stairs.
    assert {row['found'] for row in rows} == {'0'}
    assert len((folder / 'stairs.csv').read_text().splitlines()) == 1
    # Where the recording does not tell which way is up, nothing is an obstacle either.
    assert all(read_labels(picture).any() for picture in pictures)
    config, lost = Config(gravity_frame='base_footprint'), done / 'lost'
    Replay(done / 'recording', lost, config, terrain=True).run()
    assert not any(read_labels(picture).any() for picture in lost.glob('*_terrain.png'))
    # Without terrain, none of it stays behind.
    replay(done / 'recording', folder, overwrite=True)
    assert not list(folder.glob('*_terrain.png')) and not (folder / 'ground.csv').exists()


def test_the_recording_of_a_lost_worker_is_done_by_another(tmp_path):
    distributed = pytest.importorskip('distributed')
    counts = {'a': 20, 'b': 21, 'c': 22}
    for name, count in counts.items():
        record_walls(tmp_path / name, count)
        replay(tmp_path / name, tmp_path / 'local' / name)
    options = {'n_workers': 2, 'threads_per_worker': 1, 'processes': True}
    options |= {'dashboard_address': None, 'local_directory': tmp_path / 'dask'}
    with (
        distributed.LocalCluster(**options) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        victim = next(iter(client.run(os.getpid).values()))
        words = *RANGESEG, 'replay', *counts, '--output', 'out', '--scheduler'
        words += (cluster.scheduler_address,)
        streams = {'stdout': subprocess.PIPE, 'stderr': subprocess.PIPE, 'text': True}
        command = subprocess.Popen(words, cwd=tmp_path, **streams)
        try:
            # Each process has its name on the folder that it has begun.
            half_way = f'out/*/.rangeseg-{victim}/*_labels.png'
            wait_for(lambda: len([*tmp_path.glob(half_way)]) > 5, command)
            os.kill(victim, signal.SIGKILL)
            output, error = command.communicate(timeout=240)
        finally:
            command.kill()
    assert command.returncode == 0, error
    assert all(f'{count} frames' in output for count in counts.values())
    assert results(tmp_path / 'out') == results(tmp_path / 'local')
    assert not list(tmp_path.glob('out/*/.*'))
