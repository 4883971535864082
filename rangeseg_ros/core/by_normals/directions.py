"""The discretised hemisphere of surface normals: what the labels of method `normals` stand for.

They face the sensor: unit vectors with z < 0 in the optical frame. The equator is left out, as a
surface seen edge-on does not appear in an image.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats
from rangeseg_ros.core.config import DIRECTION_COUNTS

_EQUATOR = 1e-9  # rounding


@lru_cache(maxsize=8)
def directions(count: int) -> Floats:
    """Unit vectors (count, 3) over the hemisphere, not to be written to.

    Vertices of an icosahedron after Loop subdivision (thesis 5.2.2, appendix A.2), those strictly
    on one side of a plane through an edge and the edge opposite to it. `count` is one of
    `DIRECTION_COUNTS` (table A.3).
    """
    golden = (1 + 5**0.5) / 2
    # The edges between the vertices (+-1, +-golden, 0) lie in the plane z = 0.
    corners = [(0.0, s, t * golden) for s in (-1, 1) for t in (-1, 1)]
    vertices = np.array([np.roll(corner, k) for k in (0, 1, 2) for corner in corners])
    near = np.linalg.norm(vertices[:, None] - vertices[None], axis=2) < 2.1
    faces = np.array([f for f in combinations(range(12), 3) if near[np.ix_(f, f)].all()])
    vertices /= np.linalg.norm(vertices[0])
    for _ in range(DIRECTION_COUNTS.index(count)):
        vertices, faces = _subdivide(vertices, faces)
    found = vertices[vertices[:, 2] < -_EQUATOR]
    found.setflags(write=False)
    return found


def _subdivide(vertices: Floats, faces: NDArray[np.int64]) -> tuple[Floats, NDArray[np.int64]]:
    """Split every triangle in four by new vertices at the middles of its edges."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
    unique, inverse = np.unique(edges.reshape(-1, 2), axis=0, return_inverse=True)
    middle = vertices[unique].sum(axis=1)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    ab, bc, ca = (len(vertices) + inverse.reshape(-1, 3)).T
    a, b, c = faces.T
    split = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], 1).reshape(-1, 3)
    return np.vstack([vertices, middle]), split
