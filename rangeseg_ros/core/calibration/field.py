r"""One field over the image and the planes of all frames, solved jointly.

A cell c that plane p covers has the inverse depth y = theta_p . r_c + b . m_c + noise, where m_c
are the coefficients of the field at the cell and b its basis at this sighting: 1, and for a field
that depends on the distance a second one. The planes are eliminated: with W the weights, R the
rays of a plane's cells and P = W - W R (R^T W R)^-1 R^T W, the field solves

    (sum_p P_p + smoothness S) m = sum_p P_p y_p,

S the squared second differences of the cells (bending energy; of a slope the first differences),
with a smoothness for each coefficient. It is solved by conjugate gradients, as no matrix but those
of single planes is ever formed, preconditioned with W in place of P. Weights fall as 1 / s^2 with
the robust standard deviation s of a plane's residuals (where ranges err, near planes are much
noisier in inverse depth), and as 1 / (1 + (e / (k s))^2) with the residual e (Cauchy), so that
wrong regions do not bend the field.

A plane in inverse depth over the whole image is in the null space of P, and of S: any of it may be
added to m, which makes the field no less smooth. So is a slope that is the same everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from rangeseg_ros.core.calibration.sightings import Sightings

# Cauchy's constant: 95 % efficient for normal errors (Holland and Welsch 1977).
_CAUCHY = 2.385
# Relative error of the solution, far below its uncertainty, and iterations that always suffice.
_TOLERANCE, _ITERATIONS = 1e-3, 1000
# Added to the normal matrices, whose entries are numbers of cells: a row of cells is no plane.
_RIDGE = 1e-9


def solve(
    seen: Sightings,
    basis: NDArray[np.float64],
    weight: NDArray[np.float64],
    grid: tuple[int, int],
    smoothness: Sequence[float],
    start: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Coefficients of the field.

    Parameters
    ----------
    seen : Sightings
        N cells.
    basis : (K, N) float64
        Factors of the coefficients.
    weight : (N,) float64
    grid : (int, int)
        Rows and columns of cells.
    smoothness : (K,) float
        Weight of the squared differences, in sightings of a cell.
    start : (K, rows * columns) float64, optional
        Where to begin.

    Returns
    -------
    (K, rows * columns) float64
        1/m for the basis 1.
    """
    size = grid[0] * grid[1]
    field = np.zeros((len(basis), size)) if start is None else start.copy()
    inverses, residual = _planes(seen.start, seen.ray, seen.inverse, weight)
    target: NDArray[np.float64] = np.stack(
        [np.bincount(seen.cell, weight * b * residual, size) for b in basis]
    )
    smoothing = [
        strength * _roughness(grid, place) + _RIDGE * sparse.eye(size)
        for place, strength in enumerate(smoothness)
    ]
    alone = [
        splu((sparse.diags(np.bincount(seen.cell, weight * b * b, size)) + part).tocsc())
        for b, part in zip(basis, smoothing, strict=True)
    ]

    def product(vector: NDArray[np.float64]) -> NDArray[np.float64]:
        result = np.stack([part @ image for part, image in zip(smoothing, vector, strict=True)])
        sums = seen.start, seen.cell, seen.ray, weight, basis, inverses
        _add_normal_product(*sums, vector, result)
        return result

    def preconditioned(vector: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack([part.solve(image) for part, image in zip(alone, vector, strict=True)])

    rest = target - product(field)
    step = preconditioned(rest)
    direction, rest_size = step.copy(), float((rest * step).sum())
    enough = _TOLERANCE**2 * float((target * preconditioned(target)).sum())
    for _ in range(_ITERATIONS):
        if rest_size <= enough:
            break
        image = product(direction)
        length = rest_size / float((direction * image).sum())
        field += length * direction
        rest -= length * image
        step = preconditioned(rest)
        before, rest_size = rest_size, float((rest * step).sum())
        direction = step + rest_size / before * direction
    return field


def _roughness(grid: tuple[int, int], place: int) -> sparse.csr_matrix:
    """Sum of squares of differences of cells (G,), as a matrix (G, G).

    Second differences for the offset, which a plane leaves as it is, and first ones for the slope,
    which a constant does: neither punishes what is free.
    """
    (one_v, first_v, second_v), (one_u, first_u, second_u) = (
        [sparse.csr_matrix(np.diff(np.eye(n), order, axis=0)) for order in range(3)] for n in grid
    )
    if place == 0:
        parts = [
            sparse.kron(second_v, one_u),
            sparse.kron(one_v, second_u),
            np.sqrt(2) * sparse.kron(first_v, first_u),
        ]
    else:
        parts = [sparse.kron(first_v, one_u), sparse.kron(one_v, first_u)]
    rows = sparse.vstack(parts)
    return (rows.T @ rows).tocsr()


def robust_weights(seen: Sightings, error: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights (N,), at most 1, of cells whose inverse depth is wrong by `error` (N,)."""
    residual = residuals(seen, seen.inverse - error)
    size = np.abs(residual)
    typical = max(float(np.median(size)), 1e-9)
    # A plane that looks better than most is as likely too small to show its errors.
    middle = [max(float(np.median(size[a:b])), typical) for a, b in pairwise(seen.start)]
    spread = 1.4826 * np.array(middle)[seen.plane()]
    weight: NDArray[np.float64] = (1.4826 * typical / spread) ** 2
    weight /= 1 + (residual / (_CAUCHY * spread)) ** 2
    return weight


def residuals(seen: Sightings, inverse: NDArray[np.float64]) -> NDArray[np.float64]:
    """What least-squares planes leave of inverse depths (N,), 1/m."""
    residual: NDArray[np.float64]
    _, residual = _planes(seen.start, seen.ray, inverse, np.ones(len(inverse)))
    return residual


@njit(cache=True, nogil=True)
def _planes(
    start: NDArray[np.intp],
    ray: NDArray[np.float64],
    inverse: NDArray[np.float64],
    weight: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Inverses (P, 3, 3) of the planes' normal matrices, and residuals (N,)."""
    inverses = np.zeros((len(start) - 1, 3, 3))
    residual = np.empty(len(inverse))
    for p in range(len(start) - 1):
        matrix, vector = _RIDGE * np.eye(3), np.zeros(3)
        for i in range(start[p], start[p + 1]):
            for a in range(3):
                vector[a] += weight[i] * ray[i, a] * inverse[i]
                for b in range(3):
                    matrix[a, b] += weight[i] * ray[i, a] * ray[i, b]
        inverses[p] = np.linalg.inv(matrix)
        theta = np.zeros(3)
        for a in range(3):
            for b in range(3):
                theta[a] += inverses[p, a, b] * vector[b]
        for i in range(start[p], start[p + 1]):
            plane = theta[0] * ray[i, 0] + theta[1] * ray[i, 1] + theta[2] * ray[i, 2]
            residual[i] = inverse[i] - plane
    return inverses, residual


@njit(cache=True, nogil=True)
def _add_normal_product(
    start: NDArray[np.intp],
    cell: NDArray[np.intp],
    ray: NDArray[np.float64],
    weight: NDArray[np.float64],
    basis: NDArray[np.float64],
    inverses: NDArray[np.float64],
    field: NDArray[np.float64],
    result: NDArray[np.float64],
) -> None:
    """Add B^T P B m to `result` (K, G): eight arguments, as the sums run over all of them."""
    count = len(basis)
    for p in range(len(start) - 1):
        a0 = a1 = a2 = 0.0
        for i in range(start[p], start[p + 1]):
            value = 0.0
            for k in range(count):
                value += basis[k, i] * field[k, cell[i]]
            value *= weight[i]
            a0, a1, a2 = a0 + value * ray[i, 0], a1 + value * ray[i, 1], a2 + value * ray[i, 2]
        m = inverses[p]
        t0 = m[0, 0] * a0 + m[0, 1] * a1 + m[0, 2] * a2
        t1 = m[1, 0] * a0 + m[1, 1] * a1 + m[1, 2] * a2
        t2 = m[2, 0] * a0 + m[2, 1] * a1 + m[2, 2] * a2
        for i in range(start[p], start[p + 1]):
            value = -(t0 * ray[i, 0] + t1 * ray[i, 1] + t2 * ray[i, 2])
            for k in range(count):
                value += basis[k, i] * field[k, cell[i]]
            for k in range(count):
                result[k, cell[i]] += weight[i] * basis[k, i] * value
