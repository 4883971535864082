r"""Planes and poses of a recording, solved together by least squares.

A bundle adjustment with planes instead of points (Kaess, "Simultaneous localization and mapping
with infinite planes", ICRA 2015). What a frame f shows of plane p differs from the plane as it is
estimated by the three numbers (`plane_errors`)

    z = x_p + D s_f + P b + S u_r + v,

x_p the error of the plane, s_f that of the pose (a turn about the camera and a shift), P b what
the distortion b of the sensor, an inverse range for each cell of the image, makes of a plane in
these pixels, and v what is new in the frame. What else lasts of the sensor's errors
(`observations`) is u_r in the run of frames in which the same pixels see the plane, in standard
deviations S. Poses err by s_f = (0, w_f d) + e_f: a drift d over the way w_f of the camera, and
noise e_f; those before a jump (`plane_filter`) moreover by what the jump was taken for wrongly.
The errors of an odometry add up: e_f - e_(f-1) is its noise, and it has no other drift. A drift
that is not significant is none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse
from scipy.linalg import block_diag
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from rangeseg_ros.core.arrays import Floats, Indices
from rangeseg_ros.core.mapping.map_planes import MapPlane, moved_onto
from rangeseg_ros.core.mapping.observations import (
    LASTING,
    PlaneSet,
    PoseNoise,
    cell_rays,
    field_in_pixels,
)
from rangeseg_ros.core.mapping.plane_filter import Jump
from rangeseg_ros.core.mapping.plane_map import Sighting
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.rotations import cross_matrix
from rangeseg_ros.core.sensing.distortion import DistortionMap
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.significance import OUTLIER, chi2_quantile
from rangeseg_ros.core.tracking.plane_errors import GATE, from_errors

_ROUNDS = 6  # until weights settle
_SYMMETRIC = {'SymmetricMode': True}
# Columns of the inverse that are worked out at a time.
_COLUMNS = 64
# Poses without stated errors err by so much, metres and radians, so that equations are finite.
_LEAST = 1e-5


class Solution(NamedTuple):
    """Planes, with outlines on them, and poses of the frames as they were most probably.

    `covariance` (4 P, 4 P) is of normal and distance of all planes in turn. `drift` (3,) is of the
    poses as they were given, metres per metre of the `way` of the camera, metres; where it is more
    than chance makes it (chi-squared, 0.999), the camera `drifts`, and it is taken off. `field`
    (C,), 1/m, is the distortion in the cells of the image.
    """

    planes: list[MapPlane]
    covariance: Floats
    poses: list[Transform]
    drift: Floats
    drift_covariance: Floats
    way: float
    drifts: bool
    field: Floats

    def corrected(self, image: RangeImage, distortion_length: float) -> RangeImage:
        """An image of a camera, of the same cells, without the field; any other one as it is."""
        if image.camera is None or len(cell_rays(image, distortion_length)) != len(self.field):
            return image
        error = field_in_pixels(self.field, image.shape, distortion_length)
        return DistortionMap(error.astype(np.float32)).corrected(image)

    def drift_text(self) -> str:
        """The drift in words."""
        size = float(np.linalg.norm(self.drift))
        along = self.drift / max(size, 1e-12)
        deviation = float(np.sqrt(along @ self.drift_covariance @ along))
        return (
            f'the poses drift by {100 * size:.1f} +- {100 * deviation:.1f} % of the way '
            f'({self.way:.1f} m)'
        )


class Adjustment:
    """Collects what the frames of a recording show of the planes of its map.

    `noise` is that of the poses that are given or, where their errors add up as those of an
    odometry do, of their changes from frame to frame.
    """

    def __init__(self, noise: PoseNoise, odometry: bool = False) -> None:
        self._noise = np.maximum(noise.deviations, _LEAST)
        self._odometry = odometry
        self._poses: list[Transform] = []
        self._planes: list[PlaneSet] = []
        # Of their covariances, and in their units what the distortion makes of them.
        self._root: list[Floats] = []
        self._effects: list[sparse.csr_array] = []
        # Number of its frame, id of its plane and number of its run, for each observation.
        self._index: list[tuple[int, int, int]] = []
        self._runs: dict[int, int] = {}
        # Number of the frame after each jump of the poses.
        self._jumps: list[tuple[int, Jump]] = []

    def add(self, frame: Sighting) -> None:
        """Take in a frame."""
        if frame.jump:
            self._poses = [frame.jump.motion.after(pose) for pose in self._poses]
            self._jumps.append((len(self._poses), frame.jump))
        for number, begins in zip(frame.ids.tolist(), frame.begins.tolist(), strict=True):
            if begins or number not in self._runs:
                self._runs[number] = len(self._index)
            self._index.append((len(self._poses), number, self._runs[number]))
        self._poses.append(frame.pose)
        # As the camera sees them.
        planes = frame.seen.planes.moved(frame.pose.inverse())
        self._planes.append(planes)
        self._root.append(np.linalg.cholesky(frame.seen.covariance))
        effects = np.linalg.solve(self._root[-1], planes.by_field(frame.seen.view, frame.rays))
        effects = sparse.csr_array(effects.reshape(-1, len(frame.rays)))
        # Images of another size would have a field of their own.
        if self._effects and effects.shape[1] != (cells := self._effects[0].shape[1]):
            effects = sparse.csr_array((effects.shape[0], cells))
        self._effects.append(effects)

    def solve(self, planes: Sequence[MapPlane], successors: Mapping[int, int]) -> Solution:
        """Planes and poses of all frames, of these planes of the map.

        `successors` are the ids that planes have now, by those they had when they were observed.
        """
        number = {plane.id: k for k, plane in enumerate(planes)}

        def now(own: int) -> int:
            while own in successors:
                own = successors[own]
            return number.get(own, -1)

        index = [(at, now(own), run) for at, own, run in self._index]
        frame, plane, runs = np.array(index, np.intp).reshape(-1, 3).T
        used = plane >= 0
        _, runs = np.unique(runs[used], return_inverse=True)
        seen = PlaneSet(*map(np.concatenate, zip(*self._planes, strict=True))).where(used)
        root = np.concatenate(self._root)[used]
        field = sparse.vstack(self._effects).tocsr()[np.repeat(used, 3)]
        own = _blocks(np.eye(3) + 0 * root, runs, int(runs.max(initial=-1)) + 1)
        lasting = sparse.hstack([own, field]) / (1 - LASTING) ** 0.5
        # How much of what lasts is of the field is not known: all of it may be, or none. What no
        # plane shows has to be something.
        sizes = np.asarray(field.power(2).sum(axis=1)).reshape(-1, 3).mean(axis=1)
        size = max(float(np.median(sizes)), 1.0) if len(sizes) else 1.0
        precision = np.repeat([1.0, size], [own.shape[1], field.shape[1]]) / LASTING
        given = _State(PlaneSet.of(planes), *map(np.array, zip(*self._poses, strict=True)))
        sightings = _Measurements(frame[used], plane[used], seen, root, lasting, precision)
        state, rest, covariance = self._solved(given, sightings, drifts=not self._odometry)
        drift = rest[-3:]
        drift_covariance = covariance[-3:, -3:]
        drifts = drift @ np.linalg.solve(drift_covariance, drift) > chi2_quantile(3)
        if not drifts:
            state, rest, covariance = self._solved(given, sightings, drifts=False)
        jacobian = block_diag(*from_errors(state.planes.axes, state.planes.point))
        joint = jacobian @ covariance[:-3, :-3] @ jacobian.T
        return Solution(
            moved_onto(planes, state.planes.equations, joint),
            joint,
            [Transform(*pose) for pose in zip(state.turn, state.shift, strict=True)],
            drift,
            drift_covariance,
            float(self._way()[-1]),
            bool(drifts),
            rest[own.shape[1] :][: field.shape[1]],
        )

    def _solved(
        self, given: _State, sightings: _Measurements, drifts: bool
    ) -> tuple[_State, Floats, Floats]:
        """The most probable state and all else, and the covariance of all planes and the drift."""
        # What lasts, what jumps were taken for wrongly, and the drift.
        state, rest = given, np.zeros(sightings.lasting.shape[1] + 6 * len(self._jumps) + 3)
        first, last = np.cumsum([3 * len(given.planes.normal), 6 * len(given.turn)]).tolist()
        prior = self._prior(first, sightings.precision, drifts)
        for _ in range(_ROUNDS):
            design, gap = state.equations(sightings, rest)
            known = np.concatenate([np.zeros(first), state.pose_errors(given), rest])
            # Cauchy's weights: things that move by themselves are not to move the camera.
            scale = np.repeat(1 / np.sqrt(1 + (gap.reshape(-1, 3) ** 2).sum(axis=1) / GATE), 3)
            rows = sparse.vstack([sparse.diags(scale) @ design, prior]).tocsr()
            factors = splu((rows.T @ rows).tocsc(), 'MMD_AT_PLUS_A', 0.0, options=_SYMMETRIC)
            step = factors.solve(rows.T @ np.concatenate([scale * gap, -prior @ known]))
            state, rest = state.corrected(step[:first], step[first:last]), rest + step[last:]
        # Of the inverse, what is of the planes and the drift.
        chosen = np.r_[:first, len(step) - 3 : len(step)]
        unit = sparse.eye(len(step), format='csc')
        blocks = np.split(chosen, range(_COLUMNS, len(chosen), _COLUMNS))
        parts = [factors.solve(unit[:, block].toarray())[chosen] for block in blocks]
        return state, rest, np.hstack(parts)

    def _way(self) -> Floats:
        """(F,) way of the camera up to each frame; less than the noise of poses is no way."""
        way, total, place = [], 0.0, self._poses[0].shift
        for pose in self._poses:
            step = float(np.linalg.norm(pose.shift - place))
            if step > OUTLIER * self._noise[-1]:
                total, place = total + step, pose.shift
            way.append(total)
        return np.array(way)

    def _prior(self, planes: int, precision: Floats, drifts: bool) -> Any:
        """What is known beforehand of all but the planes, as equations of unit variance."""
        frames, way = len(self._poses), self._way()
        change = sparse.eye(frames)
        if self._odometry:
            change -= sparse.eye(frames, k=-1)
        poses = sparse.kron(change, sparse.diags(1 / self._noise))
        shift = np.vstack([np.zeros((3, 3)), np.eye(3)])
        effects, known = [np.kron(way[:, None], shift)], []
        for after, jump in self._jumps:
            design = np.tile(np.eye(6), (frames, 1, 1))
            for at, pose in enumerate(self._poses):
                design[at, 3:, :3] = -cross_matrix(pose.shift - jump.camera)
            design[after:] = 0
            effects.insert(-1, design.reshape(-1, 6))
            known.append(sparse.csr_array(np.linalg.inv(np.linalg.cholesky(jump.covariance))))
        # No drift is longer than the way.
        known.append(sparse.eye(3) / (1.0 if drifts else _LEAST))
        rest = -poses @ sparse.csr_array(np.hstack(effects))
        rows = sparse.bmat([
            [poses, None, rest],
            [None, sparse.diags(np.sqrt(precision)), None],
            [None, None, sparse.block_diag(known)],
        ])  # fmt: skip
        return sparse.hstack([sparse.csr_array((rows.shape[0], planes)), rows]).tocsr()


def _blocks(values: Floats, column: Indices, count: int) -> sparse.csr_array:
    """Matrices (N, 3, K) one below the other, each at one of `count` columns of matrices."""
    size = values.shape[2]
    columns = np.repeat(size * column[:, None] + np.arange(size), 3, axis=0).ravel()
    begin = np.arange(0, values.size + 1, size)
    return sparse.csr_array((values.ravel(), columns, begin), (3 * len(values), size * count))


class _Measurements(NamedTuple):
    """N planes as cameras saw them, with the roots (N, 3, 3) of the covariances of their errors.

    Of each the numbers of its frame and plane. `lasting` (3 N, L) is what lasts of each run and of
    the field, in what is new of the errors, `precision` (L,) its inverse variance beforehand.
    """

    frame: Indices
    plane: Indices
    seen: PlaneSet
    root: Floats
    lasting: sparse.csr_array
    precision: Floats


class _State(NamedTuple):
    """Planes and poses as they are estimated."""

    planes: PlaneSet
    turn: Floats
    shift: Floats

    def pose_errors(self, given: _State) -> Floats:
        """(6 F,) what poses that were given err by."""
        turn = Rotation.from_matrix(given.turn @ self.turn.transpose(0, 2, 1)).as_rotvec()
        return np.column_stack([turn, given.shift - self.shift]).ravel()

    def corrected(self, planes: Floats, poses: Floats) -> _State:
        """Without these errors, (3 P,) and (6 F,)."""
        turn, shift = np.split(poses.reshape(-1, 6), 2, axis=1)
        back = Rotation.from_rotvec(-turn).as_matrix()
        return _State(
            self.planes.without(planes.reshape(-1, 3)), back @ self.turn, self.shift - shift
        )

    def equations(self, sightings: _Measurements, rest: Floats) -> tuple[sparse.csr_array, Floats]:
        """Derivatives (3 N, D) of observations by all unknowns, and the gaps (3 N,), whitened.

        Of the `rest`, the first are what lasts of the errors; the others are of the poses only.
        """
        frame, plane, seen, root, lasting, _ = sightings
        pose = Transform(self.turn[frame], self.shift[frame])
        planes = self.planes.where(plane)
        gap, turned = planes.apart(seen.moved(pose))
        whiten = np.linalg.inv(turned @ root) / (1 - LASTING) ** 0.5
        design = sparse.hstack([
            _blocks(whiten, plane, len(self.planes.normal)),
            _blocks(-whiten @ planes.by_motion(pose.shift), frame, len(self.turn)),
            lasting,
            sparse.csr_array((gap.size, len(rest) - lasting.shape[1])),
        ])  # fmt: skip
        gap = (whiten @ gap[..., None]).ravel() - lasting @ rest[: lasting.shape[1]]
        return design.tocsr(), gap
