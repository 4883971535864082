"""Work on strips of rows and beside the caller."""

import multiprocessing
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
    """Each waits for another; alone they would for ever."""
    barrier = threading.Barrier(min(threads, 4), timeout=20)
    run_rows(lambda first, after: barrier.wait(), 100)


@pytest.mark.parametrize('threads', [1], indirect=True)
def test_one_thread_is_the_callers_own(threads):
    workers = set()
    run_rows(lambda first, after: workers.add(threading.get_ident()), 100)
    assert workers == {threading.get_ident()}


@pytest.mark.parametrize('threads', [2], indirect=True)
def test_frames_with_a_core_each_have_no_helpers(threads):
    def workers():
        found = set()
        run_rows(lambda first, after: found.add(threading.get_ident()), 100)
        found.add(submit(threading.get_ident).result())
        return found

    me = {threading.get_ident()}
    with sharing_cores():
        assert workers() > me
        with sharing_cores():
            assert workers() == me
        assert workers() > me
    with pytest.raises(ValueError), sharing_cores(), sharing_cores():
        raise ValueError
    assert workers() > me


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
