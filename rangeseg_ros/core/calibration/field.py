r"""One field over the image and the planes of all frames, solved jointly.

A cell c that plane p covers has the inverse depth y = theta_p . r_c + b . m_c + noise, where m_c
are the coefficients of the field at the cell and b its basis at this sighting: 1, and for a field
that depends on the distance the deviation of the inverse depth from its median. With the sparse
matrices B of the basis and R of the rays of the planes, W the weights and S the roughness of the
field, the planes are eliminated from the normal equations:

    (B^T W B - C Q^-1 C^T + smoothness S) m = B^T W (y - R Q^-1 R^T W y),

C = B^T W R and Q = R^T W R. They are solved by conjugate gradients, preconditioned without the
planes. S are squared second differences of the cells (bending energy; of a slope the first
differences), with a smoothness for each coefficient. Weights fall as 1 / s^2 with the robust
standard deviation s of a plane's residuals (where ranges err, near planes are much noisier in
inverse depth), and as 1 / (1 + (e / (k s))^2) with the residual e (Cauchy), so that wrong regions
do not bend the field.

A plane in inverse depth over the whole image is in the null space of the planes, and of S: any of
it may be added to m, which makes the field no less smooth. So is a slope that is the same
everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg, splu

from rangeseg_ros.core.arrays import Floats
from rangeseg_ros.core.calibration.sightings import Sightings
from rangeseg_ros.core.significance import CAUCHY

# Relative error of the solution, far below its uncertainty, and iterations that always suffice.
_TOLERANCE, _ITERATIONS = 1e-3, 1000
# Added to the normal matrices, whose entries are numbers of cells: a row of cells is no plane.
_RIDGE = 1e-9


def solve(
    seen: Sightings,
    basis: Floats,
    weight: Floats,
    grid: tuple[int, int],
    smoothness: Sequence[float],
) -> Floats:
    """Coefficients (K, rows * columns) of the field on the grid, 1/m for the basis 1.

    `basis` (K, N) are their factors at the N cells that were seen, `weight` (N,); `smoothness`
    (K,) is the weight of the squared differences, in sightings of a cell.
    """
    size, count = grid[0] * grid[1], len(basis)
    columns = np.concatenate([seen.cell + k * size for k in range(count)])
    rows = np.tile(np.arange(len(weight)), count)
    cells = sparse.csr_array((basis.ravel(), (rows, columns)), (len(weight), count * size))
    weighted = (cells.T * weight).tocsr()
    coupling = weighted @ seen.rays()
    inverses = _plane_inverses(seen, weight)
    target = weighted @ residuals(seen, seen.inverse, weight)
    smoothing = sparse.block_diag(
        [strength * _roughness(grid, place) for place, strength in enumerate(smoothness)]
    )
    own = (weighted @ cells + smoothing + _RIDGE * sparse.eye(count * size)).tocsc()

    def product(vector: Floats) -> Floats:
        planes = (inverses @ (coupling.T @ vector).reshape(-1, 3, 1)).ravel()
        return np.asarray(own @ vector - coupling @ planes)

    matrix, alone = (LinearOperator(own.shape, f) for f in (product, splu(own).solve))
    # The tolerance that is relative has another name before SciPy 1.12.
    close = _TOLERANCE * np.linalg.norm(target)
    field, _ = cg(matrix, target, atol=close, maxiter=_ITERATIONS, M=alone)
    return np.asarray(field).reshape(count, size)


def _roughness(grid: tuple[int, int], place: int) -> sparse.csr_matrix:
    """Sum of squares of differences of cells (G,), as a matrix (G, G).

    Second differences for the offset, which a plane leaves as it is, and first ones for the slope,
    which a constant does: neither punishes what is free.
    """
    (one_v, first_v, second_v), (one_u, first_u, second_u) = (
        [sparse.csr_matrix(np.diff(np.eye(n), order, axis=0)) for order in range(3)] for n in grid
    )
    parts = [sparse.kron(first_v, one_u), sparse.kron(one_v, first_u)]
    if place == 0:
        parts = [sparse.kron(second_v, one_u), sparse.kron(one_v, second_u)]
        parts.append(np.sqrt(2) * sparse.kron(first_v, first_u))
    rows = sparse.vstack(parts)
    return (rows.T @ rows).tocsr()


def robust_weights(seen: Sightings, error: Floats | float) -> Floats:
    """Weights (N,), at most 1, of cells whose inverse depth is wrong by `error` (N,)."""
    residual = residuals(seen, seen.inverse - error)
    size = np.abs(residual)
    typical = max(float(np.median(size)), 1e-9)
    # A plane that looks better than most is as likely too small to show its errors.
    middle = [max(float(np.median(part)), typical) for part in np.split(size, seen.start[1:-1])]
    spread = 1.4826 * np.array(middle)[seen.plane()]
    weight: Floats = (1.4826 * typical / spread) ** 2
    weight /= 1 + (residual / (CAUCHY * spread)) ** 2
    return weight


def residuals(seen: Sightings, inverse: Floats, weight: Floats | None = None) -> Floats:
    """What least-squares planes leave of inverse depths (N,), 1/m."""
    weight = np.ones(len(inverse)) if weight is None else weight
    rays = seen.rays()
    sums = (rays.T @ (weight * inverse)).reshape(-1, 3, 1)
    return np.asarray(inverse - rays @ (_plane_inverses(seen, weight) @ sums).ravel())


def _plane_inverses(seen: Sightings, weight: Floats) -> Floats:
    """Inverses (P, 3, 3) of the planes' normal matrices."""
    products = weight[:, None, None] * seen.ray[:, :, None] * seen.ray[:, None]
    sums = np.add.reduceat(products, seen.start[:-1]) + _RIDGE * np.eye(3)
    return np.asarray(np.linalg.inv(sums), np.float64)
