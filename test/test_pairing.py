"""Which camera_info an image gets."""

from rangeseg_ros.ros.pairing import KEPT, Found, StampPairing


def test_one_of_the_same_stamp_wins_over_a_later_one():
    pairing = StampPairing()
    pairing.add(1, 'a')
    pairing.add(2, 'b')
    assert pairing.find(1) == Found('a', True)


def test_an_image_waits_for_its_own_once_a_pair_was_seen():
    pairing = StampPairing()
    assert pairing.find(1) is None
    pairing.add(1, 'a')
    assert pairing.find(1) == Found('a', True)
    assert pairing.find(2) is None
    pairing.add(2, 'b')
    assert pairing.find(2) == Found('b', True)


def test_an_image_whose_own_never_comes_takes_the_last():
    pairing = StampPairing()
    pairing.add(1, 'a')
    pairing.find(1)
    assert pairing.find(2) is None
    pairing.give_up()
    assert pairing.find(2) == Found('a', False)
    # And those after it do not wait, until one turns out to have been too early.
    assert pairing.find(3) == Found('a', False)
    pairing.add(3, 'c')
    assert pairing.find(4) is None


def test_one_sent_per_session_and_none_with_a_stamp():
    pairing = StampPairing()
    pairing.add(1, 'once')
    assert [pairing.find(stamp) for stamp in (5, 6)] == [Found('once', False)] * 2
    pairing = StampPairing()
    pairing.add(0, 'a')
    pairing.add(0, 'b')
    assert pairing.find(0) == pairing.find(0) == Found('b', False)


def test_few_are_kept():
    pairing = StampPairing()
    for stamp in range(1, 100):
        pairing.add(stamp, stamp)
    assert len(pairing._items) == KEPT
