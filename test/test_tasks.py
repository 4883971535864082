"""Tasks in many processes, and signals: results, failures, workers and parents that die."""

import os
import select
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import pytest
from processes import python, wait_for

from rangeseg_ros.tasks import Failure, SchedulerError, attempt_all, check_scheduler, run_all

pytestmark = pytest.mark.slow


@dataclass(frozen=True)
class Square:
    """Its workers die so many times where its `runs` are counted, by the size of a file."""

    number: int
    runs: Path | None = None
    deaths: int = 1

    def run(self):
        if self.runs:
            with self.runs.open('a') as file:
                print(file=file)
            if self.runs.stat().st_size <= self.deaths:
                os.kill(os.getpid(), signal.SIGKILL)
        return self.number**2


@dataclass(frozen=True)
class Fails:
    """Raises an error or, without one, kills its worker; once another has made a file."""

    error: Exception | None = None
    after: Path = Path()

    def run(self):
        wait_for(self.after.exists)
        if not self.error:
            os.kill(os.getpid(), signal.SIGKILL)
        raise self.error


class Sleeps:
    def run(self):
        time.sleep(600)


@dataclass(frozen=True)
class LosesSignals:
    """Loses what the first raises, and takes longer to put away than until the third."""

    folder: Path

    def run(self):
        if (self.folder / 'begun').exists():
            return
        with suppress(SystemExit):
            (self.folder / 'begun').touch()
            time.sleep(600)
        try:
            time.sleep(600)
        finally:
            with suppress(ValueError):
                try:
                    raise ValueError
                finally:
                    time.sleep(2)
            (self.folder / 'put away').touch()


def test_a_worker_that_loses_a_signal_is_told_again_but_not_while_it_puts_away(tmp_path):
    with pytest.raises(KeyError, match='fault'):
        tasks = [LosesSignals(tmp_path), Fails(KeyError('fault'), tmp_path / 'begun')]
        list(attempt_all(tasks, 2))
    assert (tmp_path / 'put away').exists()


def test_a_worker_that_loses_a_signal_ends_where_another_dies(tmp_path):
    # A result first: the pool waits for a worker just started only from its next result on.
    tasks = [LosesSignals(tmp_path), Square(2), Fails(after=tmp_path / 'begun')]
    assert [type(result) for result in attempt_all(tasks, 2)] == [type(None), int, Failure]
    assert (tmp_path / 'put away').exists()


def test_results_come_in_order_whatever_workers_die(tmp_path):
    tasks = [Square(0), Square(1, tmp_path / '1'), Square(2), Square(3, tmp_path / '3'), Square(4)]
    assert list(attempt_all(tasks, 2)) == [0, 1, 4, 9, 16]
    # What kills every worker is given up: once beside another task, and twice alone.
    deadly = Square(5, tmp_path / '5', deaths=9)
    given_up, other = attempt_all([deadly, Square(6)], 2)
    assert isinstance(given_up, Failure) and '2 workers' in str(given_up.error) and other == 36
    assert deadly.runs.stat().st_size == 3


@pytest.mark.parametrize('jobs', [1, 2])
def test_a_failure_costs_its_task_and_no_other(jobs):
    tasks = [Square(2), Fails(ValueError('bad')), Fails(MemoryError()), Square(3)]
    results = list(attempt_all(tasks, jobs))
    assert results[0] == 4 and results[3] == 9
    assert [type(result.error) for result in results[1:3]] == [ValueError, MemoryError]
    with pytest.raises(ValueError, match='bad'):
        list(run_all(tasks, jobs))


PARENT = """
import sys
sys.path.insert(0, {folder!r})
from test_tasks import Sleeps
from rangeseg_ros.tasks import run_all
if __name__ == '__main__':
    list(run_all([Sleeps(), Sleeps()], 2))
"""


@pytest.mark.parametrize('name', ['SIGTERM', 'SIGKILL', 'SIGINT'])
def test_workers_end_with_their_parent(tmp_path, name):
    program = tmp_path / 'parent.py'
    program.write_text(PARENT.format(folder=str(Path(__file__).parent)))
    parent = subprocess.Popen([sys.executable, program], stderr=subprocess.DEVNULL)
    try:
        children = Path(f'/proc/{parent.pid}/task/{parent.pid}/children')
        workers = wait_for(lambda: len(found := children.read_text().split()) >= 2 and found)
        ends = [os.pidfd_open(int(worker)) for worker in workers]
        time.sleep(2)
        parent.send_signal(getattr(signal, name))
        parent.wait(20)
        assert all(select.select([end], [], [], 120)[0] for end in ends)
    finally:
        parent.kill()


def test_addresses_of_schedulers():
    for address in ('tcp://host:8786', 'host:1', 'tls://[::1]:8786'):
        check_scheduler(address)
    for address in ('foo', 'xyz://h:1', 'tcp://h', 'tcp://h:0', 'h:99999', ''):
        with pytest.raises(SchedulerError, match='no address'):
            check_scheduler(address)


PRELUDE = """
import ctypes, os, signal, threading
import click
from rangeseg_ros.cli import main, options
def loop():
    for item in options.progress(range(3), 3, 'item'):
        print(item, flush=True)
        BODY
main.rangeseg = click.Command('rangeseg', callback=loop)
main.main()
"""
KILLED = """try: os.kill(os.getpid(), signal.SIGINT); sum(range(9))
        except KeyboardInterrupt as error: {}"""
LOST = KILLED.format('pass')
IN_A_CALLBACK = """ctypes.CFUNCTYPE(None)(lambda: os.kill(os.getpid(), signal.SIGINT))()"""
BESIDE_A_THREAD_THAT_WAITS = """threading.Thread(target=threading.Event().wait).start()
        os.kill(os.getpid(), signal.SIGINT)"""


@pytest.mark.parametrize(
    ('body', 'name', 'code'),
    [
        (LOST, 'SIGINT', 130),
        (KILLED.format("raise SystemError('in a kernel') from error"), 'SIGINT', 130),
        (KILLED.format("raise ValueError('not a bag')"), 'SIGTERM', 143),
        (IN_A_CALLBACK, 'SIGTERM', 143),
        (LOST, 'SIGHUP', 129),
        (BESIDE_A_THREAD_THAT_WAITS, 'SIGINT', 130),
    ],
)
def test_a_signal_ends_the_command(body, name, code):
    body = body.replace('SIGINT', name).replace('KeyboardInterrupt', 'BaseException')
    done = python(PRELUDE.replace('BODY', body))
    assert (done.returncode, done.stdout, done.stderr.strip()) == (code, '0\n', '')


def test_who_ignores_interrupts_still_does_and_other_system_errors_are_shown():
    code = 'import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)' + PRELUDE
    done = python(code.replace('BODY', 'os.kill(os.getpid(), signal.SIGINT)'))
    assert (done.returncode, done.stdout) == (0, '0\n1\n2\n')
    done = python(PRELUDE.replace('BODY', "raise SystemError('without a reason')"))
    assert done.returncode == 1 and 'without a reason' in done.stderr
