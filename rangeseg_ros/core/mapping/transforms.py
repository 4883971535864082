"""Transforms between frames over time, with the semantics of tf2.

References
----------
T. Foote, "tf: the transform library", IEEE TePRA 2013. K. Shoemake, "Animating rotation with
quaternion curves", SIGGRAPH 1985 (slerp). REP 105 for the frames of mobile robots.
"""

from __future__ import annotations

from bisect import bisect_left
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rangeseg_ros.core.arrays import Floats
from rangeseg_ros.core.rotations import rotation_by, rotation_matrix

CACHE_TIME = 10 * 10**9
"""Nanoseconds that the past of a frame is kept, as by default in tf2."""

# What a quaternion's length, or a rotation matrix's product with its transpose, may be off one.
_RIGID = 0.01


class TransformError(ValueError):
    """A transform that is not known: its `reason` in words, the same for all times.

    It `may_come` later: a frame not heard of yet, or a time ahead of the last one.
    """

    def __init__(self, reason: str, detail: str = '', may_come: bool = False) -> None:
        super().__init__(f'{reason}{detail}')
        self.reason = reason
        self.may_come = may_come


class Transform(NamedTuple):
    """Rigid motion p -> rotation p + shift, from the coordinates of one frame to another's.

    Attributes
    ----------
    rotation : (3, 3) float64
    shift : (3,) float64
        Metres.
    """

    rotation: Floats
    shift: Floats

    @classmethod
    def identity(cls) -> Transform:
        """The motion that leaves everything where it is."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> Transform:
        """Motion of a 4x4 matrix, its rotation the nearest one; TransformError if not rigid."""
        try:
            values = np.asarray(matrix, np.float64)
        except (ValueError, TypeError):
            raise TransformError(f'not a 4x4 matrix: {matrix!r:.60}') from None
        if values.shape != (4, 4):
            raise TransformError(f'not a 4x4 matrix: shape {values.shape}')
        if not np.isfinite(values).all():
            raise TransformError('values are not finite')
        turn = values[:3, :3]
        off = np.abs(turn.T @ turn - np.eye(3)).max()
        if off > _RIGID or np.linalg.det(turn) < 0 or (values[3] != (0, 0, 0, 1)).any():
            raise TransformError('not a rigid motion')
        left, _, right = np.linalg.svd(turn)
        return cls(left @ right, values[:3, 3])

    def inverse(self) -> Transform:
        """The motion back."""
        return Transform(self.rotation.T, -self.rotation.T @ self.shift)

    def after(self, first: Transform) -> Transform:
        """This motion after `first`."""
        return Transform(self.rotation @ first.rotation, self.rotation @ first.shift + self.shift)

    def apply(self, points: Floats) -> Floats:
        """Points (N, 3) in the other frame."""
        return points @ self.rotation.T + self.shift

    def by(self, error: Floats) -> Transform:
        """This motion, off by a turn in its own axes, radians, and a shift, metres, (6,)."""
        return Transform(self.rotation @ rotation_by(error[:3]), self.shift + error[3:])


class _Sample(NamedTuple):
    """Where a frame is in its parent: a unit quaternion x, y, z, w and a shift."""

    stamp: int
    parent: str
    rotation: Floats
    shift: Floats


_stamp = itemgetter(0)


class TransformBuffer:
    """The tree of frames as it was in the last seconds.

    Every frame has one parent at a time. Between two samples of a transform, its shift is
    interpolated linearly and its rotation along the shorter arc (slerp); before the first and
    after the last one it is not known. Static transforms hold at any time. As in tf2 a second
    sample of the same stamp is ignored. A sample that is `CACHE_TIME` older than the last one is
    of a time that began anew, as of a looped recording: the past of its frame is forgotten.
    """

    def __init__(self) -> None:
        self._moving: dict[str, list[_Sample]] = {}
        self._static: dict[str, _Sample] = {}
        self._frames: set[str] = set()

    def insert(
        self,
        parent: str,
        child: str,
        stamp: int,
        rotation: ArrayLike,
        shift: ArrayLike,
        static: bool = False,
    ) -> None:
        """Take in where a frame is in its parent at a stamp, nanoseconds.

        The quaternion x, y, z, w turns the child's coordinates to the parent's, the shift is of
        the child's origin in the parent, metres. What is static holds at any time, and replaces
        what was known of the child. Names may have a leading slash. TransformError for no name, a
        frame in itself, values that are not finite, or a quaternion far from unit length.
        """
        parent, child = parent.removeprefix('/'), child.removeprefix('/')
        name = f'transform from {parent!r} to {child!r}'
        if not parent or not child or parent == child:
            raise TransformError(f'{name}: two different frames are needed')
        turn, place = np.array(rotation, np.float64), np.array(shift, np.float64)
        if not (np.isfinite(turn).all() and np.isfinite(place).all()):
            raise TransformError(f'{name}: values are not finite')
        length = float(np.linalg.norm(turn))
        if abs(length - 1) > _RIGID:
            raise TransformError(f'{name}: quaternion of length {length:g}')
        self._frames |= {parent, child}
        sample = _Sample(stamp, parent, turn / length, place)
        if static:
            self._static[child] = sample
            self._moving.pop(child, None)
            return
        self._static.pop(child, None)
        samples = self._moving.setdefault(child, [])
        if samples and stamp < samples[-1].stamp - CACHE_TIME:
            samples.clear()
        at = bisect_left(samples, stamp, key=_stamp)
        if at == len(samples) or samples[at].stamp != stamp:
            samples.insert(at, sample)
            del samples[: bisect_left(samples, samples[-1].stamp - CACHE_TIME, key=_stamp)]

    def clear(self) -> None:
        """Forget all that moves; what is static holds."""
        self._moving.clear()

    def lookup(self, target: str, source: str, stamp: int) -> Transform:
        """The motion that takes coordinates in the frame `source` to those in `target`.

        `stamp` is in nanoseconds, 0 for the last time at which all of the chain is known, as in
        tf2. TransformError for a frame that is not known, frames that are not connected, a loop,
        or a time outside what is known.
        """
        target, source = target.removeprefix('/'), source.removeprefix('/')
        for frame in (target, source):
            if frame not in self._frames:
                raise TransformError(f'frame {frame!r} is not known', may_come=True)
        up, up_ends = self._ancestors(source, stamp)
        down, down_ends = self._ancestors(target, stamp)
        common = next((frame for frame in down if frame in up), None)
        if common is None:
            detail = f'frames {target!r} and {source!r} are not connected'
            raise up_ends or down_ends or TransformError(detail, may_come=True)
        (first, known), (second, also_known) = up[common], down[common]
        if not stamp and 0 < min(known, also_known) < np.inf:
            return self.lookup(target, source, int(min(known, also_known)))
        return second.inverse().after(first)

    def _ancestors(
        self, frame: str, stamp: int
    ) -> tuple[dict[str, tuple[Transform, float]], TransformError | None]:
        """Motions from a frame to itself and all above it, and why it goes no higher.

        With each motion, the last time at which all of it is known.
        """
        motion, known = Transform.identity(), np.inf
        found = {frame: (motion, known)}
        while frame in self._static or frame in self._moving:
            try:
                sample = self._static.get(frame) or self._at(frame, stamp)
            except TransformError as error:
                return found, error
            if sample.parent in found:
                raise TransformError(f'frames form a loop: {" -> ".join([*found, sample.parent])}')
            motion = Transform(rotation_matrix(sample.rotation), sample.shift).after(motion)
            known = known if frame in self._static else min(known, self._moving[frame][-1].stamp)
            frame = sample.parent
            found[frame] = motion, known
        return found, None

    def _at(self, frame: str, stamp: int) -> _Sample:
        """Where a moving frame is in its parent at a time; at last for 0."""
        samples = self._moving[frame]
        if not stamp:
            return samples[-1]
        after = bisect_left(samples, stamp, key=_stamp)
        if after < len(samples) and samples[after].stamp == stamp:
            return samples[after]
        if after == 0:
            behind = (samples[0].stamp - stamp) * 1e-9
            raise TransformError(f'{frame!r} is not known that early', f': {behind:.3f} s before')
        if after == len(samples):
            late = f': {(stamp - samples[-1].stamp) * 1e-9:.3f} s after the last'
            raise TransformError(f'{frame!r} is not known that late', late, True)
        first, second = samples[after - 1 : after + 1]
        if first.parent != second.parent:
            return first
        # Here, as it takes longer to import than to segment a frame.
        from scipy.spatial.transform import Rotation, Slerp

        share = (stamp - first.stamp) / (second.stamp - first.stamp)
        turn = Slerp([0, 1], Rotation.from_quat([first.rotation, second.rotation]))(share)
        shift = first.shift + share * (second.shift - first.shift)
        return _Sample(stamp, first.parent, turn.as_quat(), shift)
