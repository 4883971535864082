"""Threads get the lock in the order of their tickets."""

import threading

import pytest

from rangeseg_ros.ros.ticket_lock import TicketLock


def test_turns_are_in_order_whoever_is_ready_first():
    order, had = TicketLock(), []
    places = [order.take_ticket() for _ in range(5)]

    def work(place):
        with order.turn(place):
            had.append(place)

    threads = [threading.Thread(target=work, args=(place,)) for place in reversed(places)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert had == places


def test_a_turn_that_fails_is_over():
    order = TicketLock()
    first, second = order.take_ticket(), order.take_ticket()
    with pytest.raises(ValueError), order.turn(first):
        raise ValueError
    with order.turn(second):
        pass
