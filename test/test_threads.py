"""Work on strips of rows and beside the caller."""

import multiprocessing
import subprocess
import sys
import threading
import time

import cv2
import numpy as np
import pytest

from rangeseg_ros.core.runtime.threads import map_halves, run_rows, sharing_cores, submit


@pytest.fixture(params=[1, 2, 7])
def threads(request):
    before = cv2.getNumThreads()
    cv2.setNumThreads(request.param)
    yield request.param
    cv2.setNumThreads(before)


@pytest.mark.parametrize('rows', [0, 1, 15, 16, 33, 100, 1000])
def test_every_row_is_in_one_strip(threads, rows):
    visits = np.zeros(rows, int)

    def kernel(first, after, step):
        visits[first:after] += step

    run_rows(kernel, rows, 3)
    assert (visits == 3).all()


def test_halves_do_not_depend_on_the_number_of_threads(threads):
    assert map_halves(lambda first, after, name: (first, after, name), 9, 'x') == (
        (0, 4, 'x'),
        (4, 9, 'x'),
    )


@pytest.mark.parametrize('threads', [2, 7], indirect=True)
def test_strips_are_worked_on_at_the_same_time(threads):
    """As many as there are threads wait for each other; alone they would for ever."""
    barrier = threading.Barrier(min(threads, 4), timeout=20)
    run_rows(lambda first, after: barrier.wait(), 1000)


@pytest.mark.parametrize('threads', [2], indirect=True)
def test_a_thread_that_is_done_takes_more_strips(threads):
    """The caller's first one takes as long as all others together."""
    begun, others_are_done = [], threading.Event()

    def kernel(first, after):
        if first == 0:
            assert others_are_done.wait(20)
            return
        begun.append(first)
        if after == 1000 and len(begun) > 1:
            others_are_done.set()

    run_rows(kernel, 1000)


@pytest.mark.parametrize('threads', [2], indirect=True)
def test_frames_with_a_core_each_have_no_helpers(threads):
    def worker():
        """Who does a task: another thread, given the time to begin it."""
        begun = threading.Event()
        task = submit(lambda: (threading.get_ident(), begun.set()))
        begun.wait(0.5)
        return task.result()[0]

    me = threading.get_ident()
    with sharing_cores():
        assert worker() != me
        with sharing_cores():
            assert worker() == me
        assert worker() != me
    with pytest.raises(ValueError), sharing_cores(), sharing_cores():
        raise ValueError
    assert worker() != me


@pytest.mark.parametrize('threads', [2], indirect=True)
def test_a_task_that_waits_for_a_helper_is_done_by_who_needs_it(threads):
    """The only helper is at work for as long as the other task is not done."""
    begun, free = threading.Event(), threading.Event()
    busy = submit(lambda: (begun.set(), free.wait(20)))
    assert begun.wait(20)
    assert submit(threading.get_ident).result() == threading.get_ident()
    free.set()
    assert busy.result() == (None, True)


@pytest.mark.parametrize('threads', [2], indirect=True)
def test_tasks_may_have_tasks(threads):
    """Also where no helper is free for them."""

    def depth(left):
        return 1 + max(submit(depth, left - 1).result() for _ in range(2)) if left else 0

    assert depth(5) == 5


def test_a_program_ends_after_its_tasks():
    """A kernel that is at work when the interpreter is gone may bring down the process."""
    program = (
        'import time, cv2; from rangeseg_ros.core.runtime.threads import submit\n'
        'cv2.setNumThreads(2); submit(lambda: (time.sleep(0.5), print("over", flush=True)))\n'
        'time.sleep(0.1)'
    )
    ended = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True)
    assert (ended.returncode, ended.stdout) == (0, 'over\n')


def test_errors_come_back():
    def kernel(first, after):
        raise ValueError(str(first))

    with pytest.raises(ValueError, match='0'):
        run_rows(kernel, 100)
    with pytest.raises(ValueError, match='late'):
        submit(lambda: (time.sleep(0.05), int('late'))).result()


def total(queue):
    queue.put(sum(map_halves(lambda first, after: after - first, 100)))


@pytest.mark.skipif('fork' not in multiprocessing.get_all_start_methods(), reason='no fork')
def test_threads_are_started_anew_in_a_forked_process():
    assert sum(map_halves(lambda first, after: after - first, 100)) == 100
    context = multiprocessing.get_context('fork')
    queue = context.Queue()
    child = context.Process(target=total, args=(queue,), daemon=True)
    child.start()
    assert queue.get(timeout=30) == 100
    child.join()
