"""Transforms against motions in closed form, rotations and quantiles as SciPy has them."""

from itertools import cycle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, f

from rangeseg_ros import Transform
from rangeseg_ros.core.mapping.transforms import CACHE_TIME, TransformBuffer, TransformError
from rangeseg_ros.core.rotations import quaternions, rotation_by, rotation_matrix
from rangeseg_ros.core.significance import LEVEL, chi2_quantile, f_quantile

SECOND = 10**9


class Motion:
    """Constant velocity and turning, the motion that linear interpolation and slerp follow."""

    def __init__(self, seed):
        random = np.random.default_rng(seed)
        self.start = Rotation.from_quat(random.standard_normal(4))
        self.turning = random.uniform(-3, 3, 3)
        self.place, self.velocity = random.uniform(-5, 5, (2, 3))

    def at(self, seconds):
        turn = Rotation.from_rotvec(self.turning * seconds) * self.start
        return turn, self.place + self.velocity * seconds

    def matrix(self, seconds):
        turn, place = self.at(seconds)
        return matrix_of((turn.as_matrix(), place))


def matrix_of(transform):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = transform
    return matrix


def fill(buffer, parent, child, motion, stamps, signs=(1,), static=False):
    """Take in samples of a motion; q and -q are one rotation."""
    for stamp, sign in zip(stamps, cycle(signs), strict=False):
        turn, place = motion.at(stamp / SECOND)
        buffer.insert(parent, child, stamp, sign * turn.as_quat(), place, static)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_lookups_in_random_trees_equal_the_closed_form(data):
    count = data.draw(st.integers(2, 8))
    parents = [data.draw(st.integers(0, k - 1)) for k in range(1, count)]
    signs = data.draw(st.lists(st.sampled_from([1, -1]), min_size=1, max_size=5))
    seed = data.draw(st.integers(0, 10**6))
    times = data.draw(st.lists(st.integers(1, 5 * SECOND), min_size=1, max_size=12, unique=True))
    # A fifth of a second apart, so that no turn is near half a revolution; in any order.
    stamps = sorted({*range(1, 5 * SECOND, SECOND // 5), *times, 5 * SECOND})
    order = np.random.default_rng(seed).permutation(stamps).tolist()
    buffer, motions = TransformBuffer(), {}
    for k, parent in enumerate(parents, start=1):
        motion, static = Motion([seed, k]), data.draw(st.booleans())
        if static:
            motion.turning[:], motion.velocity[:] = 0, 0
        motions[k] = motion
        fill(buffer, f'f{parent}', f'f{k}', motion, [0] if static else order, signs, static)

    def to_root(k, seconds):
        matrix = np.eye(4)
        while k:
            matrix = motions[k].matrix(seconds) @ matrix
            k = parents[k - 1]
        return matrix

    stamp = data.draw(st.integers(1, 5 * SECOND))
    a, b = data.draw(st.integers(0, count - 1)), data.draw(st.integers(0, count - 1))
    expected = np.linalg.solve(to_root(a, stamp / SECOND), to_root(b, stamp / SECOND))
    found = buffer.lookup(f'f{a}', f'f{b}', stamp)
    np.testing.assert_allclose(matrix_of(found), expected, rtol=0, atol=1e-9)
    back = buffer.lookup(f'f{b}', f'f{a}', stamp)
    np.testing.assert_allclose(matrix_of(found.after(back)), np.eye(4), atol=1e-9)


def test_time_0_is_the_last_that_all_of_the_chain_knows():
    buffer = TransformBuffer()
    slow, fast = Motion(1), Motion(2)
    fill(buffer, 'map', 'odom', slow, range(SECOND, 3 * SECOND, SECOND // 10))
    fill(buffer, 'odom', 'base', fast, range(SECOND, 4 * SECOND, SECOND // 50))
    buffer.insert('base', 'camera', 0, (0, 0, 0, 1), (0, 0, 1), static=True)
    expected = slow.matrix(2.9) @ fast.matrix(2.9)
    expected[:3, 3] += expected[:3, 2]
    np.testing.assert_allclose(matrix_of(buffer.lookup('map', 'camera', 0)), expected, atol=1e-9)
    # What is above both does not count.
    found = buffer.lookup('odom', 'camera', 0)
    np.testing.assert_allclose(found.rotation, fast.matrix(3.98)[:3, :3], atol=1e-9)
    buffer.insert('dock', 'shelf', 0, (0, 0, 0, 1), (0, 0, 1))
    assert buffer.lookup('dock', 'shelf', 0).shift[2] == 1


def test_errors_in_words():
    buffer = TransformBuffer()
    fill(buffer, 'odom', 'base', Motion(0), [SECOND, 2 * SECOND])
    fill(buffer, 'elsewhere', 'other', Motion(0), [SECOND, 2 * SECOND])
    # Ancestors that are not needed need not be known.
    fill(buffer, 'map', 'elsewhere', Motion(1), [SECOND])
    buffer.lookup('elsewhere', 'other', 3 * SECOND // 2)
    for wrong, frames, stamp, may_come in (
        ("'elsewhere' is not known that late", ('map', 'other'), 3 * SECOND // 2, True),
        ("'nowhere' is not known", ('odom', 'nowhere'), SECOND, True),
        ('not connected', ('odom', 'other'), SECOND, True),
        ('that late: 0.500 s after', ('odom', 'base'), 5 * SECOND // 2, True),
        ('that early: 0.500 s before', ('odom', 'base'), SECOND // 2, False),
    ):
        with pytest.raises(TransformError, match=wrong) as failed:
            buffer.lookup(*frames, stamp)
        assert failed.value.may_come == may_come
    fill(buffer, 'base', 'odom', Motion(0), [SECOND, 2 * SECOND])
    with pytest.raises(TransformError, match='loop: base -> odom -> base'):
        buffer.lookup('base', 'elsewhere', SECOND)
    identity, nothing = (0, 0, 0, 1), (0, 0, 0)
    for wrong, insert in (
        ('two different frames', ('base', 'base', 1, identity, nothing)),
        ('two different frames', ('', 'base', 1, identity, nothing)),
        ('length 0', ('odom', 'base', 1, (0, 0, 0, 0), nothing)),
        ('length 2', ('odom', 'base', 1, (0, 0, 0, 2), nothing)),
        ('finite', ('odom', 'base', 1, (0, 0, 0, np.nan), nothing)),
        ('finite', ('odom', 'base', 1, identity, (np.inf, 0, 0))),
    ):
        with pytest.raises(TransformError, match=wrong):
            buffer.insert(*insert)


def test_late_and_repeated_samples_a_new_parent_and_a_time_that_begins_anew():
    buffer, motion = TransformBuffer(), Motion(3)
    fill(buffer, 'odom', 'base', motion, [3 * SECOND // 2, SECOND])
    buffer.insert('odom', 'base', SECOND, (0, 0, 0, 1), (9, 9, 9))  # ignored
    found = buffer.lookup('odom', 'base', 5 * SECOND // 4)
    np.testing.assert_allclose(matrix_of(found), motion.matrix(1.25), atol=1e-9)
    # Between samples in two parents, the first one holds.
    buffer.insert('dock', 'base', 2 * SECOND, (0, 0, 0, 1), (0, 0, 0))
    held = buffer.lookup('odom', 'base', 7 * SECOND // 4)
    np.testing.assert_allclose(matrix_of(held), motion.matrix(1.5), atol=1e-9)
    buffer.lookup('dock', 'base', 2 * SECOND)
    # The past is bounded, and ends where time begins anew.
    fill(buffer, 'odom', 'base', motion, range(SECOND, 60 * SECOND, SECOND // 10))
    with pytest.raises(TransformError, match='that early'):
        buffer.lookup('odom', 'base', 60 * SECOND - CACHE_TIME - SECOND)
    fill(buffer, 'odom', 'base', motion, [SECOND, 6 * SECOND // 5])
    found = buffer.lookup('odom', 'base', 11 * SECOND // 10)
    np.testing.assert_allclose(matrix_of(found), motion.matrix(1.1), atol=1e-9)
    with pytest.raises(TransformError, match='that late'):
        buffer.lookup('odom', 'base', 55 * SECOND)


def test_matrices_that_are_no_motion_are_refused():
    good = Motion(4).matrix(0)
    np.testing.assert_allclose(matrix_of(Transform.from_matrix(good)), good, atol=1e-12)
    unknown, larger, mirrored, projective = np.tile(good, (4, 1, 1))
    unknown[0, 3], projective[3, 0] = np.nan, 0.5
    larger[:3] *= 1.2
    mirrored[:, 0] *= -1
    wrong = [('finite', unknown), ('rigid', larger), ('rigid', mirrored), ('rigid', projective)]
    wrong += [('4x4', matrix) for matrix in (np.eye(3), 'a', [[1], [2, 3]])]
    for what, matrix in wrong:
        with pytest.raises(TransformError, match=what):
            Transform.from_matrix(matrix)


def test_quaternions_and_matrices_of_turns():
    about_axes = np.kron([[1e-9], [1e-4], [np.pi], [0.0]], np.eye(3))
    vectors = np.concatenate([Rotation.random(1000, random_state=0).as_rotvec(), about_axes])
    rotations = Rotation.from_rotvec(vectors)
    turns, truth = rotations.as_matrix(), rotations.as_quat()
    found = quaternions(turns)
    assert (found[:, 3] >= 0).all()
    assert np.allclose(np.linalg.norm(found, axis=1), 1, rtol=0, atol=1e-15)
    # Of half a turn both signs are right.
    apart = np.minimum(np.abs(found - truth).max(axis=1), np.abs(found + truth).max(axis=1))
    assert apart.max() < 1e-15
    # One alone is that of many.
    assert [quaternions(turn).tolist() for turn in turns] == found.tolist()
    assert quaternions(turns[:0]).shape == (0, 4)
    for function, arguments in ((rotation_matrix, truth), (rotation_by, vectors)):
        assert np.abs(np.stack([function(v) for v in arguments]) - turns).max() < 1e-15


@pytest.mark.parametrize('level', [0.05, 0.5, 0.99, LEVEL])
def test_quantiles(level):
    for n in (0.5, 1, 2, 3, 6, 9, 13, 15.7, 60):
        assert chi2_quantile(n, level) == pytest.approx(chi2.ppf(level, n), rel=1e-10)
    for n, m in ((0.5, 100), (3, 2), (6, 22), (13, 9.5)):
        assert f_quantile(n, m, level) == pytest.approx(f.ppf(level, n, m), rel=1e-8)
