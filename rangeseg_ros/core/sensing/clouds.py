"""What the points of an organised cloud tell of its sensor: its camera, its axes, and its rays."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rangeseg_ros.core.arrays import Floats, Indices, Mask, Singles
from rangeseg_ros.core.rotations import quaternions, rotation_matrix
from rangeseg_ros.core.sensing.camera import OPTICAL, Camera, CameraError

# To which intrinsics are rounded, pixels: frames of a sensor share a camera. A power of two, as
# numbers of few decimals are never halfway between two of these.
_STEP = 2.0**-10
_TURN = 2.0**-20  # the same of quaternions: 0.001 pixels in the middle of an image of 1000
# The same of places, metres: 0.001 pixels of a focal length of 1000, a metre away.
_PLACE = 2.0**-20
_ORIGIN = (0.0, 0.0, 0.0)
_CLOSE = 0.01  # largest error of the camera, pixels: less than any sensor's
# Largest standard deviation of a camera's place over its distance from what it sees: half a degree
# of the rays. Rounding leaves 1e-5 of what has any depth, and 1 of a plane or of parallel rays.
_PLACED = 0.01
_SAMPLES = 64  # rows and columns of the sample that the camera is estimated from, about
_DEGREE = 6  # of the polynomial: unit vectors over 120 degrees, to a hundredth of a pixel
_GRID = 80  # rows and columns of the grid of pixels that it is fitted to, at most
_SMOOTH = 0.5  # largest error, in pixels, of a grid that is smooth


def camera_of(points: NDArray[np.floating], valid: Mask) -> Camera | None:
    """The pinhole camera that points (H, W, 3), metres, lie on the rays of where valid (H, W).

    In its optical frame x / z is linear in the column then, and y / z in the row. The camera is at
    the origin where points tell no other place, as those of a single plane. None where points lie
    on no such rays, or fill less than half of the rows or columns.
    """
    height, width = valid.shape
    # Odd steps, as holes come in every second row or column.
    down, across = max(height // _SAMPLES, 1) | 1, max(width // _SAMPLES, 1) | 1
    v, u = np.nonzero(valid[::down, ::across])
    sample = points[::down, ::across][v, u].astype(np.float64)
    u, v = u * across, v * down
    for turn, place in _candidate_frames(sample, u, v, valid.shape):
        axes = rotation_matrix(turn)
        x, y, z = ((sample - place) @ axes).T
        if not (z > 0).all():
            continue
        columns, rows = _fitted_line(u, x / z, width), _fitted_line(v, y / z, height)
        if columns is None or rows is None:
            continue
        focal, centre = zip(columns, rows, strict=True)
        camera = _camera(width, height, *focal, *centre, turn=turn, place=place)
        if camera is not None and _on_rays(points, valid, camera):
            return camera
    return None


def depth_of(points: NDArray[np.floating], camera: Camera) -> NDArray[np.floating]:
    """(H, W) along the optical axis, of points (H, W, 3) in the frame that the camera is in."""
    if camera.turn == OPTICAL and camera.place == _ORIGIN:
        return points[..., 2]
    forward = camera.axes[:, 2]
    with np.errstate(invalid='ignore', over='ignore'):
        depth: NDArray[np.floating] = points @ forward - forward @ camera.place
    return depth


def axes_of_frame(rays: Singles, valid: Mask) -> Floats:
    """(3, 3) which axes of a cloud's frame are nearest to right, down and forward, as columns.

    Of unit rays (H, W, 3) that are known where valid (H, W).
    """
    width = valid.shape[1]
    across = max(width // _SAMPLES, 1)
    # Of a scanner that turns all the way, the other half looks back.
    front = slice(width // 4, width - width // 4, across)
    forward = _nearest_axis(rays[:, front][valid[:, front]].sum(axis=0, dtype=np.float64))
    both = (valid[1:] & valid[:-1])[:, ::across]
    steps = np.diff(rays[:, ::across], axis=0)[both].sum(axis=0, dtype=np.float64)
    down = _nearest_axis(steps, forward)
    return np.stack([np.cross(down, forward), down, forward], axis=1)


def completed_rays(rays: Singles, valid: Mask) -> tuple[Singles, Mask] | None:
    """Rays (H, W, 3) of a cloud; a polynomial through the valid (H, W) ones tells the others.

    Only between these, in their row or column; with the pixels that have a ray then. None where
    rays do not change smoothly over the grid.
    """
    down, across = (max(size // _GRID, 1) for size in valid.shape)
    v, u = np.nonzero(valid[::down, ::across])
    v, u = v * down, u * across
    neighbours = valid[:, 1:] & valid[:, :-1]
    if len(v) < 10 * (_DEGREE + 1) ** 2 or not neighbours.any():
        return None
    known = rays[v, u].astype(np.float64)
    basis = _basis(v, u, valid.shape)
    coefficients = np.linalg.lstsq(basis, known, rcond=None)[0]
    error = np.linalg.norm(basis @ coefficients - known, axis=1)
    pixel = np.median(np.linalg.norm(np.diff(rays, axis=1)[neighbours], axis=1))
    if np.quantile(error, 0.95) > _SMOOTH * pixel:
        return None
    between = np.zeros_like(valid)
    for axis in (0, 1):
        before = np.logical_or.accumulate(valid, axis)
        between |= before & np.flip(np.logical_or.accumulate(np.flip(valid, axis), axis), axis)
    v, u = np.nonzero(between & ~valid)
    if not len(v):  # NumPy makes no polynomials of nothing
        return rays, between
    found = _basis(v, u, valid.shape) @ coefficients
    completed = rays.copy()
    completed[v, u] = found / np.linalg.norm(found, axis=1, keepdims=True)
    return completed, between


def _basis(rows: Indices, columns: Indices, shape: tuple[int, int]) -> NDArray[np.floating]:
    """(N, M) Chebyshev polynomials of both coordinates."""
    v, u = (2 * x / max(size - 1, 1) - 1 for x, size in zip((rows, columns), shape, strict=True))
    basis: NDArray[np.floating] = np.polynomial.chebyshev.chebvander2d(v, u, [_DEGREE, _DEGREE])
    return basis


def _nearest_axis(vector: Floats, other_than: ArrayLike = (0, 0, 0)) -> Floats:
    """Unit vector (3,) of the axis along which `vector` is longest, other than another one."""
    k = int(np.argmax(np.where(np.equal(other_than, 0), np.abs(vector), -1.0)))
    return np.eye(3)[k] * (-1.0 if vector[k] < 0 else 1.0)


def _candidate_frames(
    points: Floats, u: Indices, v: Indices, shape: tuple[int, int]
) -> Iterator[tuple[tuple[float, ...], tuple[float, ...]]]:
    """Turns and places of cameras that points (N, 3) of pixels may be from.

    First those at the origin: optical, then the one whose rays are a homography of the pixels.
    Last, one that is elsewhere: its 3 x 4 matrix takes points to pixels (R. Hartley, A. Zisserman,
    Multiple View Geometry, 4.1, 6.2 and 7.1). The part of either that is a rotation is the turn.
    """
    yield OPTICAL, _ORIGIN
    if not len(points):
        return
    middle, unit = (np.array(shape[::-1]) - 1) / 2, max(shape) / 2
    pixel = np.stack([(u - middle[0]) / unit, (v - middle[1]) / unit, np.ones(len(u))], axis=1)
    size = np.abs(points).max()
    ray = points / np.abs(points).max(axis=1, keepdims=True)  # whose squares are finite
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    _, found = _linear_maps(pixel, ray)
    turn = _rotation(found[0])
    if turn:
        yield turn, _ORIGIN
    # About their middle and of size 1, for the sake of rounding.
    scaled = points / size
    mean = scaled.mean(axis=0)
    scaled -= mean
    spread = np.abs(scaled).max()
    if spread == 0:
        return
    scaled = np.append(scaled / spread, np.ones((len(points), 1)), axis=1)
    pixel /= np.linalg.norm(pixel, axis=1, keepdims=True)
    squares, found = _linear_maps(scaled, pixel)
    back = np.linalg.pinv(found[0, :, :3])
    at = np.append(-back @ found[0, :, 3], 1)
    # How much each of the other matrices moves the camera, by how little it is worse.
    moves = np.linalg.norm(found[1:] @ at @ back.T, axis=1)
    noise = np.maximum(squares, np.finfo(float).eps * squares[-1])
    variance = noise[0] / (2 * len(points)) * (moves**2 / noise[1:]).sum()
    turn = _rotation(back)
    if turn and variance <= _PLACED**2 * (at[:3] @ at[:3]):
        place = (at[:3] * spread + mean) * size
        yield turn, tuple((np.rint(place / _PLACE) * _PLACE).tolist())


def _linear_maps(start: Floats, end: Floats) -> tuple[Floats, Floats]:
    """Matrices (3 K, 3, K) that take vectors (N, K) along unit vectors (N, 3), best ones first.

    Also returns the sums (3 K,) of squares of what is perpendicular to these. The sign of the
    first map is such that its results point along them.
    """
    across = np.eye(3) - end[:, :, None] * end[:, None, :]
    squares = start[:, :, None] * start[:, None, :]
    width = 3 * start.shape[1]
    equations = np.einsum('nab,nij->aibj', across, squares, optimize=True).reshape(width, width)
    values, vectors = np.linalg.eigh(equations)
    found = vectors.T.reshape(width, 3, -1)
    if np.einsum('na,ai,ni->', end, found[0], start) < 0:
        found[0] = -found[0]
    return values, found


def _rotation(rays: NDArray[np.floating]) -> tuple[float, ...] | None:
    """The rotation in a matrix (3, 3) that takes pixels to rays; None for a mirror image."""
    axes, lens = np.linalg.qr(rays)
    axes = axes * np.where(np.diag(lens) < 0, -1.0, 1.0)
    if np.linalg.det(axes) <= 0:
        return None
    turn = np.rint(quaternions(axes) / _TURN)
    turn *= np.sign(turn[turn != 0][-1]) / np.linalg.norm(turn)  # of half a turn, one of two
    return tuple(turn.tolist())


def _fitted_line(place: Indices, slope: Floats, size: int) -> tuple[float, float] | None:
    """Focal length and centre, pixels, of rays of these slopes (N,) in columns or rows."""
    if not len(place) or 2 * (place.max() - place.min()) <= size - 1:
        return None
    away = place - place.mean()
    step = (away @ slope) / (away @ away)
    error = np.abs(slope - slope.mean() - step * away)
    if step <= 0 or error.max() > _CLOSE * step:
        return None
    focal, centre = float(1 / step), float(place.mean() - slope.mean() / step)
    return round(focal / _STEP) * _STEP, round(centre / _STEP) * _STEP


@lru_cache(maxsize=4)
def _camera(*lens: Any, **frame: Any) -> Camera | None:
    """The camera, cached, as its rays are computed once for all frames."""
    try:
        return Camera(*lens, **frame)
    except CameraError:
        return None


def _on_rays(points: NDArray[np.floating], valid: Mask, camera: Camera) -> bool:
    """Whether all points that were measured lie on the rays of a camera."""
    depth = depth_of(points, camera)
    with np.errstate(invalid='ignore', over='ignore'):
        allowed = _CLOSE / max(camera.fx, camera.fy) * depth
        for axis in range(2 if camera.turn == OPTICAL else 3):
            error = np.abs(points[..., axis] - camera.place[axis] - depth * camera.rays[..., axis])
            if (valid & ~(error <= allowed)).any():
                return False
    return True
