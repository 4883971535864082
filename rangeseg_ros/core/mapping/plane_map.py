"""The map of planes: what every frame shows of the planes of a fixed frame, fused over time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.mapping.map_planes import MapPlane, Record, describe
from rangeseg_ros.core.mapping.observations import (
    Observations,
    PoseNoise,
    Sighting,
    observations,
    views,
)
from rangeseg_ros.core.mapping.plane_filter import PlaneFilters, Step
from rangeseg_ros.core.mapping.plane_grid import PlaneGrid
from rangeseg_ros.core.mapping.pose_jumps import Jump, find_jump
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.mapping.visibility import THROUGH, in_image, may_be_in_sight, ray_evidence
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel
from rangeseg_ros.core.tracking.plane_errors import GATE, candidates
from rangeseg_ros.core.tracking.tracker import NOMINAL

# Jumps of the poses that are told one by one.
_TOLD = 10


class PlaneMap:
    """Planes of a fixed frame, from the planes of frames whose poses are known.

    Attributes
    ----------
    begun_anew : str
        Why the map was begun anew; empty when it was not.
    epoch : int
        How often it was begun, the first time included.
    planes_before : list of MapPlane
        What was known when it was begun anew.
    successors_before : dict of int
        `successors` then.
    jumps : list of (int, Jump)
        Stamps of frames whose poses the planes contradict, and by how much.
    sighting : Sighting or None
        What the last frame shows of it.
    successors : dict of int
        Ids of planes that turned out to be another one -> the id of that one.

    Examples
    --------
    >>> plane_map = PlaneMap(config)
    >>> plane_map.add(result.labels, result.planes, image, pose, stamp)
    >>> plane_map.planes
    """

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or Config()
        self._next = 1
        self.epoch = 0
        self.jumps: list[tuple[int, Jump]] = []
        self.clear()

    def clear(self, why: str = '') -> None:
        """Begin anew; ids are not given twice."""
        self.begun_anew = why
        self.planes_before = self.planes if self.epoch else []
        self.successors_before = self.successors if self.epoch else {}
        self.epoch += 1
        self.sighting: Sighting | None = None
        self.successors: dict[int, int] = {}
        self._records: list[Record] = []
        self._filters: PlaneFilters | None = None
        self._stamp = self._time = 0

    def __len__(self) -> int:
        return sum(map(self._told, self._records))

    def add(
        self,
        labels: NDArray[np.uint16],
        planes: Sequence[Plane],
        image: RangeImage,
        pose: Transform,
        stamp: int,
    ) -> None:
        """Take in a frame. Where the fixed frame jumps, planes move along as far as they tell.

        Parameters
        ----------
        labels : (H, W) uint16
        planes : sequence of Plane
            Of these labels, in the frame of the image, tracked and with their roles.
        image : RangeImage
            What was measured: its rays tell which planes are gone.
        pose : Transform
            Fixed frame from the frame of the image.
        stamp : int
            Nanoseconds.
        """
        config = self.config
        noise = PoseNoise(config.pose_noise, np.radians(config.pose_turn_noise))
        self._time += stamp - self._stamp if stamp > self._stamp > 0 else round(NOMINAL * 1e9)
        self._stamp = stamp
        self.sighting = Sighting(pose, [], np.zeros(0, np.int64), np.zeros((0, 0)))
        match = np.zeros(0, np.intp)
        if planes:
            view = views(labels, planes, config.distortion_length)
            known = self._filters
            if known is not None and known.view.shape[1] != view.shape[1]:
                # Of images of another size, what comes is of other pixels than before.
                known.view = np.zeros((len(self._records), view.shape[1]))
            seen = observations(planes, view, pose, noise)
            jump = self._jump(planes, seen, pose, noise)
            match, step = self._associate(planes, seen)
            if step:
                self._update(planes, seen, step)
            self._fuse(planes, seen, match, stamp)
            ids = np.array([self._records[k].id for k in match.tolist()])
            self.sighting = Sighting(pose, planes, ids, view, jump)
        self._look(self._outlines(planes, match, pose), image, pose, noise)
        if len(match):
            self._merge(np.unique(match), pose.shift)
        self._forget()

    def _jump(
        self, planes: Sequence[Plane], seen: Observations, pose: Transform, noise: PoseNoise
    ) -> Jump | None:
        """Find a jump of the fixed frame by planes that were followed through it; follow it."""
        known = {record.track: k for k, record in enumerate(self._records)}
        both = [m for m, plane in enumerate(planes) if plane.id in known]
        # Odometry never jumps.
        odometry = self.config.odometry and not self.config.fixed_frame
        if self._filters is None or not both or odometry:
            return None
        index = np.array([known[planes[m].id] for m in both])
        jump = find_jump(self._filters.where(index), seen.where(both), pose.shift, noise)
        if jump:
            self.jumps.append((self._stamp, jump))
            self._filters = self._filters.moved(jump.motion).with_motion_error(
                jump.covariance, pose.shift
            )
        return jump

    @property
    def doubts(self) -> list[str]:
        """What the planes say against the poses: jumps, by the stamps of their frames."""
        found = [f'{stamp * 1e-9:.3f} s: {jump}' for stamp, jump in self.jumps[:_TOLD]]
        if (more := len(self.jumps) - _TOLD) > 0:
            found.append(f'{more} more frames whose poses the planes contradict')
        return found

    @property
    def planes(self) -> list[MapPlane]:
        """The planes whose sure parts are no clutter, in the order of their ids."""
        if self._filters is None:
            return []
        filters = self._filters
        covariance = filters.plane_covariance
        found = [
            describe(record, filters.normal[k], filters.point[k], filters.axes[k], covariance[k])
            for k, record in enumerate(self._records)
            if self._told(record)
        ]
        return sorted(found, key=lambda plane: plane.id)

    def _told(self, record: Record) -> bool:
        """Whether there is enough of a plane to tell it: no clutter."""
        return record.grid.sure_area > self.config.map_area

    def _associate(
        self, planes: Sequence[Plane], seen: Observations
    ) -> tuple[NDArray[np.intp], Step | None]:
        """Find out which planes of the map the planes of a frame are.

        Returns
        -------
        (M,) int
            Numbers of the planes of the map, -1 for none.
        Step or None
            Of those that are known.
        """
        match = np.full(len(planes), -1)
        filters = self._filters
        if filters is None:
            return match, None
        planes_known = filters.normal, filters.distance
        close = candidates(planes_known, (seen.plane[:, :3], seen.centroid), seen.range)
        index, which = np.nonzero(close)
        if not len(index):
            return match, None
        step = filters.expected(index, seen, which)
        value = filters.gate(step, seen)
        fits = np.flatnonzero(value < GATE)
        index, which, value = index[fits], which[fits], value[fits]
        at = filters.coordinates(index, seen.centroid[which])
        away = np.array(
            [self._records[k].grid.distance(p) for k, p in zip(index.tolist(), at, strict=True)]
        )
        reach = np.array([np.hypot(*planes[m].extents) / 2 for m in which.tolist()])
        # The one it lies on, or else the likeliest.
        order = np.lexsort([value, away > 0])
        # What one frame finds on two surfaces is not one plane, however badly its pose is known.
        surface: dict[int, int] = {}
        taken = []
        for n in order[away[order] <= 2 * reach[order]].tolist():
            k, m = int(index[n]), int(which[n])
            if match[m] < 0 and surface.setdefault(k, planes[m].surface) == planes[m].surface:
                match[m] = k
                taken.append(n)
        return match, step.where(fits[taken]) if taken else None

    def _update(self, planes: Sequence[Plane], seen: Observations, step: Step) -> None:
        """Take in planes that are known: of parts of one plane, the largest decides on it."""
        assert self._filters is not None
        count = np.array([planes[m].count for m in step.observation.tolist()])
        order = np.lexsort([step.observation, -count, step.plane])
        largest = order[np.unique(step.plane[order], return_index=True)[1]]
        self._filters.update(step.where(largest), seen)

    def _fuse(
        self,
        planes: Sequence[Plane],
        seen: Observations,
        match: NDArray[np.intp],
        stamp: int,
    ) -> None:
        """Keep what planes of a frame are known by, and begin new ones."""
        new = np.flatnonzero(match < 0)
        if len(new):
            match[new] = len(self._records) + np.arange(len(new))
            first = PlaneFilters.of(seen.where(new))
            self._filters = self._filters.joined(first) if self._filters else first
            for _ in new:
                grid = PlaneGrid(self.config.map_resolution)
                self._records.append(Record(self._next, stamp, grid))
                self._next += 1
        for plane, k in zip(planes, match.tolist(), strict=True):
            self._records[k].add(plane, stamp, self._time)

    def _outlines(
        self, planes: Sequence[Plane], match: NDArray[np.intp], pose: Transform
    ) -> dict[int, NDArray[np.bool_]]:
        """Cells of the planes of the map that a frame has found."""
        found = {}
        for k in np.unique(match).tolist():
            parts = []
            for m in np.flatnonzero(match == k).tolist():
                rings = [planes[m].hull, *planes[m].holes]
                parts.append([self._flat(k, r @ pose.rotation.T + pose.shift) for r in rings])
            found[k] = self._records[k].grid.see([part for part in parts if len(part[0]) > 2])
        return found

    def _flat(self, k: int, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Coordinates (N, 2) of points (N, 3) on a plane."""
        assert self._filters is not None
        return self._filters.coordinates(np.full(len(points), k), points)

    def _look(
        self,
        found: dict[int, NDArray[np.bool_]],
        image: RangeImage,
        pose: Transform,
        noise: PoseNoise,
    ) -> None:
        """Take in that cells were looked at, and no plane was found there."""
        filters = self._filters
        if filters is None or not self._records:
            return
        circles = [record.grid.circle() for record in self._records]
        middles, reaches = (np.array(part) for part in zip(*circles, strict=True))
        middles = filters.points(np.arange(len(middles)), middles)
        middles = (middles - pose.shift) @ pose.rotation
        shown = np.flatnonzero(may_be_in_sight(middles, reaches, image)).tolist()
        cells = [self._records[k].grid.odds > 0 for k in shown]
        for k, own in zip(shown, cells, strict=True):
            own &= ~found.get(k, np.False_)
        at = [self._records[k].grid.centres(own) for k, own in zip(shown, cells, strict=True)]
        owner = np.repeat(shown, list(map(len, at))).astype(np.intp)
        place = np.concatenate([np.zeros((0, 2)), *at])
        points = (filters.points(owner, place) - pose.shift) @ pose.rotation
        within = np.flatnonzero(in_image(points, image))
        variance = filters.variances(owner[within], place[within])
        variance += noise.shift**2 + noise.turn**2 * (points[within] ** 2).sum(axis=1)
        normals = (filters.normal @ pose.rotation)[owner[within]]
        sensor = SensorModel.from_config(self.config)
        through = np.zeros(len(owner), np.bool_)
        through[within] = ray_evidence(points[within], normals, variance, image, sensor) == THROUGH
        for k, own in zip(shown, cells, strict=True):
            own[own] = through[owner == k]
            self._records[k].grid.miss(own)

    def _merge(self, some: NDArray[np.intp], camera: NDArray[np.float64]) -> None:
        """Unite planes of the map that turn out to be one with some of this frame."""
        filters = self._filters
        assert filters is not None
        gone: list[int] = []
        for k, m in filters.alike(some, camera):
            if m in gone or k in gone or self._distinct(k, m):
                continue
            kept, lost = sorted((k, m), key=lambda n: -self._records[n].observations)
            cells = self._records[lost].grid
            odds = cells.odds[cells.odds > 0]
            own = cells.centres()
            centres = self._flat(kept, filters.points(np.full(len(own), lost), own))
            reach = cells.circle()[1]
            if not len(own) or self._records[kept].grid.distance(centres.mean(axis=0)) > 2 * reach:
                continue
            self._records[kept].grid.absorb(centres, odds)
            filters.absorb(kept, lost)
            first, second = sorted(self._records[n].id for n in (kept, lost))
            self.successors[second] = first
            self._records[kept].absorb(self._records[lost])
            gone.append(lost)
        if gone:
            self._keep(np.isin(np.arange(len(self._records)), gone, invert=True))

    def _distinct(self, k: int, m: int) -> bool:
        """Whether this frame has found planes on two surfaces."""
        a, b = self._records[k], self._records[m]
        return a.seen == b.seen == self._time and a.surface != b.surface

    def _keep(self, chosen: NDArray[np.bool_]) -> None:
        assert self._filters is not None
        self._filters = self._filters.where(chosen)
        self._records = [r for r, kept in zip(self._records, chosen, strict=True) if kept]

    def _forget(self) -> None:
        """Drop planes of which nothing is left, clutter out of sight, and what is too much."""
        records, trial = self._records, 1e9 * self.config.track_time
        kept = np.array(
            [r.grid.area > 0 and (self._told(r) or self._time - r.seen <= trial) for r in records],
            np.bool_,
        )
        # Those out of sight the longest are forgotten first, and of these the ones hardly seen.
        order = sorted(
            range(len(records)), key=lambda k: (-records[k].seen, -records[k].observations)
        )
        surplus = [k for k in order if kept[k]][self.config.map_planes :]
        kept[surplus] = False
        if not kept.all():
            self._keep(kept)
