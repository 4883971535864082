"""Rotations and quantiles: as SciPy has them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, f

from rangeseg_ros.core.rotations import quaternions, rotation_by, rotation_matrix
from rangeseg_ros.core.significance import LEVEL, chi2_quantile, f_quantile

TURNS = np.concatenate(
    [
        Rotation.random(1000, random_state=0).as_rotvec(),
        np.eye(3)[:, None].repeat(3, 1).reshape(-1, 3) * np.tile([1e-9, 1e-4, np.pi], 3)[:, None],
        np.zeros((1, 3)),
    ]
)


def test_quaternions():
    found = quaternions(Rotation.from_rotvec(TURNS).as_matrix())
    truth = Rotation.from_rotvec(TURNS).as_quat()
    assert (found[:, 3] >= 0).all()
    assert np.allclose(np.linalg.norm(found, axis=1), 1, rtol=0, atol=1e-15)
    # Of half a turn both signs are right.
    apart = np.minimum(np.abs(found - truth).max(axis=1), np.abs(found + truth).max(axis=1))
    assert apart.max() < 1e-15


def test_a_quaternion_alone_is_that_of_many():
    turns = Rotation.from_rotvec(TURNS[:9]).as_matrix()
    assert [quaternions(turn).tolist() for turn in turns] == quaternions(turns).tolist()
    assert quaternions(turns[:0]).shape == (0, 4)


def test_matrices_of_quaternions_and_of_turns():
    for turn in TURNS:
        truth = Rotation.from_rotvec(turn)
        assert np.abs(rotation_matrix(truth.as_quat()) - truth.as_matrix()).max() < 1e-15
        assert np.abs(rotation_by(turn) - truth.as_matrix()).max() < 1e-15


@pytest.mark.parametrize('level', [0.05, 0.5, 0.99, LEVEL])
def test_quantiles(level):
    for freedom in (0.5, 1, 2, 3, 6, 9, 13, 15.7, 60):
        expected = chi2.ppf(level, freedom)
        assert chi2_quantile(freedom, level) == pytest.approx(expected, rel=1e-10)
    for freedom, others in ((0.5, 100), (3, 2), (6, 22), (13, 9.5)):
        expected = f.ppf(level, freedom, others)
        assert f_quantile(freedom, others, level) == pytest.approx(expected, rel=1e-8)
