"""Turns of threads in the order in which they lined up."""

import threading

import pytest

from rangeseg_ros.ros.order import Order


def test_turns_are_in_order_whoever_is_ready_first():
    order, had = Order(), []
    places = [order.line_up() for _ in range(5)]

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
    order = Order()
    first, second = order.line_up(), order.line_up()
    with pytest.raises(ValueError), order.turn(first):
        raise ValueError
    with order.turn(second):
        pass
