"""Replays on a Dask cluster."""

import os
import signal
import subprocess
import sys
import time

import pytest
from replays import record_walls, replay, results

pytestmark = pytest.mark.slow

COMMAND = [sys.executable, '-c', 'from rangeseg_ros.cli.main import main; main()']


def test_the_recording_of_a_lost_worker_is_done_by_another(tmp_path):
    distributed = pytest.importorskip('distributed')
    names = ['a', 'b', 'c']
    for name, count in zip(names, (20, 21, 22), strict=True):
        record_walls(tmp_path / name, count)
        replay(tmp_path / name, tmp_path / 'local' / name)
    options = {'n_workers': 2, 'threads_per_worker': 1, 'processes': True}
    options |= {'dashboard_address': None, 'local_directory': tmp_path / 'dask'}
    with (
        distributed.LocalCluster(**options) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        victim = next(iter(client.run(os.getpid).values()))
        words = *COMMAND, 'replay', *names, '--output', 'out'
        command = subprocess.Popen(
            [*words, '--scheduler', cluster.scheduler_address],
            cwd=tmp_path,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            # Each process has its name on the folder that it has begun.
            deadline = time.monotonic() + 120
            half_way = f'out/*/.rangeseg-{victim}/*_labels.png'
            while len(list(tmp_path.glob(half_way))) <= 5:
                assert command.poll() is None
                assert time.monotonic() < deadline
                time.sleep(0.005)
            os.kill(victim, signal.SIGKILL)
            output, error = command.communicate(timeout=240)
        finally:
            command.kill()
    assert command.returncode == 0, error
    assert [f'{count} frames' in output for count in (20, 21, 22)] == [True] * 3
    for name in names:
        assert results(tmp_path / 'out' / name) == results(tmp_path / 'local' / name)
        assert not list((tmp_path / 'out' / name).glob('.*'))
