"""The map of planes: what every frame shows of the planes of a fixed frame, fused over time."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import shapely
from numpy.typing import NDArray

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.mapping.evidence import THERE, find_sightings, may_be_in_sight
from rangeseg_ros.core.mapping.map_outlines import (
    polygon_of,
    simplify,
    unite_outlines,
    valid,
    widened,
)
from rangeseg_ros.core.mapping.map_planes import MapPlane, Record, describe
from rangeseg_ros.core.mapping.observations import (
    Observations,
    PoseNoise,
    Sighting,
    observations,
    views,
)
from rangeseg_ros.core.mapping.plane_filter import PlaneFilters, Step
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel
from rangeseg_ros.core.tracking.plane_errors import FARTHEST, GATE, SURE_TURN, candidates
from rangeseg_ros.core.tracking.tracker import NOMINAL, Jump

# Share of the planes in sight whose outlines a frame adds to: at 30 Hz each has its turn four
# times a second, and the work in a frame is bounded.
_LOOKED_AT = 1 / 8
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
        jump: Jump | None = None,
    ) -> None:
        """Take in a frame.

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
        jump : Jump, optional
            Of the pose, by the tracker. It is noted; the map begins anew where planes are farther
            off now than the same plane may be.
        """
        config = self.config
        noise = PoseNoise(config.pose_noise, np.radians(config.pose_turn_noise))
        self._time += stamp - self._stamp if stamp > self._stamp > 0 else round(NOMINAL * 1e9)
        self._stamp = stamp
        self.sighting = Sighting(pose, [], np.zeros(0, np.int64), np.zeros((0, 0)))
        if planes:
            view = views(labels, planes, config.distortion_length)
            known = self._filters
            if known is not None and known.view.shape[1] != view.shape[1]:
                # Of images of another size, what comes is of other pixels than before.
                known.view = np.zeros((len(self._records), view.shape[1]))
            seen = observations(planes, view, pose, noise)
            match, step = self._associate(planes, seen)
            if jump:
                self.jumps.append((stamp, jump))
                # Beyond what may be one plane everything would be twice in the map.
                if jump.shift > FARTHEST * seen.range.min() or jump.turn > SURE_TURN:
                    now = self._stamp, self._time
                    self.clear('the fixed frame has jumped')
                    self._stamp, self._time = now
                    match, step = np.full(len(planes), -1), None
            if step:
                self._update(planes, seen, step)
            self._fuse(planes, seen, match, pose, stamp)
            ids = np.array([self._records[k].id for k in match.tolist()])
            self.sighting = Sighting(pose, planes, ids, view)
            self._merge(pose.shift)
        self._contradict(image, pose, noise)

    @property
    def doubts(self) -> list[str]:
        """What the planes say against the poses: jumps, by the stamps of their frames."""
        found = [f'{stamp * 1e-9:.3f} s: {jump}' for stamp, jump in self.jumps[:_TOLD]]
        if (more := len(self.jumps) - _TOLD) > 0:
            found.append(f'{more} more frames whose poses the planes contradict')
        return found

    @property
    def planes(self) -> list[MapPlane]:
        """The planes that were seen often enough and are no clutter, in the order of their ids."""
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
        return record.confirmed and record.outline.area > self.config.map_area

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
        reach = np.array([np.hypot(*planes[m].extents) / 2 for m in which.tolist()])
        at = filters.coordinates(index, seen.centroid[which])
        outlines = np.array([self._records[k].outline for k in index.tolist()], object)
        away = shapely.distance(outlines, shapely.points(at))
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
        pose: Transform,
        stamp: int,
    ) -> None:
        """Keep what planes of a frame are known by and their outlines, and begin new ones."""
        count = np.array([plane.count for plane in planes])
        order = np.argsort(-count, kind='stable')
        new = order[match[order] < 0]
        if len(new):
            match[new] = len(self._records) + np.arange(len(new))
            first = PlaneFilters.of(seen.where(new))
            self._filters = self._filters.joined(first) if self._filters else first
            for _ in new:
                self._records.append(Record(self._next, stamp, stamp))
                self._next += 1
        for plane, k in zip(planes, match.tolist(), strict=True):
            self._records[k].add(plane, stamp, self._time)
        # The new ones first, then those that wait the longest.
        due = sorted(set(match.tolist()), key=lambda k: (self._records[k].united, k))
        for k in due[: max(math.ceil(_LOOKED_AT * len(due)), len(new))]:
            self._records[k].united = self._time
            for part in np.flatnonzero(match == k).tolist():
                self._unite(k, planes[part], pose)

    def _unite(self, k: int, plane: Plane, pose: Transform) -> None:
        """Add what is seen of a plane to its outline."""
        filters = self._filters
        assert filters is not None

        def flat(ring: NDArray[np.float64]) -> NDArray[np.float64]:
            world = ring @ pose.rotation.T + pose.shift
            return filters.coordinates(np.full(len(ring), k), world)

        part = polygon_of(flat(plane.hull), [flat(hole) for hole in plane.holes])
        # Corners of pixels are finer than the map, and cost time in every step that follows.
        self._grow(k, part.simplify(self.config.map_resolution / 4))

    def _merge(self, camera: NDArray[np.float64]) -> None:
        """Unite planes of the map that turn out to be one with those that have just grown."""
        filters = self._filters
        assert filters is not None
        gone: list[int] = []
        grown = [k for k, record in enumerate(self._records) if record.united == self._time]
        for k, m in filters.alike(np.array(grown), camera):
            if m in gone or k in gone or self._distinct(k, m) or not self._touch(k, m):
                continue
            kept, lost = sorted((k, m), key=lambda n: -self._records[n].observations)
            filters.absorb(kept, lost)
            first, second = sorted(self._records[n].id for n in (kept, lost))
            self.successors[second] = first
            self._records[kept].absorb(self._records[lost])
            self._grow(kept, self._across(lost, kept))
            gone.append(lost)
        if gone:
            self._keep(np.isin(np.arange(len(self._records)), gone, invert=True))

    def _distinct(self, k: int, m: int) -> bool:
        """Whether this frame has found planes on two surfaces."""
        a, b = self._records[k], self._records[m]
        return a.seen == b.seen == self._time and a.surface != b.surface

    def _touch(self, k: int, m: int) -> bool:
        """Whether outlines are no farther apart than the smaller one is large."""
        a, b = self._records[k].outline, self._across(m, k)
        if a.is_empty or b.is_empty:
            return True
        reach = min(np.hypot(x - u, y - v) for u, v, x, y in (a.bounds, b.bounds))
        return bool(a.distance(b) <= reach)

    def _across(self, source: int, target: int) -> shapely.Geometry:
        """Outline of one plane on another."""
        filters = self._filters
        assert filters is not None
        point, axes = filters.point, filters.axes
        turn = axes[target] @ axes[source].T
        shift = axes[target] @ (point[source] - point[target])
        across = shapely.transform(self._records[source].outline, lambda xy: xy @ turn.T + shift)
        # Corners that touched may cross by what rounding turns them by.
        return valid(across)

    def _grow(self, k: int, part: shapely.Geometry) -> None:
        record, resolution = self._records[k], self.config.map_resolution
        if record.outline.is_empty:
            record.reshape(simplify(part, resolution))
            return
        if record.margin is None:
            record.margin = widened(record.outline, resolution)
        shapely.prepare(record.margin)
        # What reaches no farther is no detail of the map: most looks show nothing new.
        if not record.margin.covers(part):
            record.reshape(*unite_outlines(record.outline, part, resolution))

    def _keep(self, chosen: NDArray[np.bool_]) -> None:
        assert self._filters is not None
        self._filters = self._filters.where(chosen)
        self._records = [r for r, kept in zip(self._records, chosen, strict=True) if kept]

    def _contradict(self, image: RangeImage, pose: Transform, noise: PoseNoise) -> None:
        """Take away what rays pass through."""
        filters = self._filters
        if filters is None or not self._records:
            return
        for record in self._records:
            # What was found once is mostly not found again.
            if not record.followed and record.frames > 1:
                record.evidence.follow(record.outline)
                record.followed = True
        circles = [record.evidence.circle() for record in self._records]
        middles, reaches = (np.array(part) for part in zip(*circles, strict=True))
        middles = filters.points(np.arange(len(middles)), middles)
        middles = (middles - pose.shift) @ pose.rotation
        shown = np.flatnonzero(may_be_in_sight(middles, reaches, image))
        if len(shown):
            self._look(shown, filters, image, pose, noise)
        self._forget()

    def _look(
        self,
        shown: NDArray[np.intp],
        filters: PlaneFilters,
        image: RangeImage,
        pose: Transform,
        noise: PoseNoise,
    ) -> None:
        """Take away what rays pass through of some planes."""
        records = [self._records[k] for k in shown.tolist()]
        evidence = [record.evidence for record in records]
        which = np.repeat(np.arange(len(evidence)), [len(one.centres) for one in evidence])
        owner = shown[which]
        at = np.concatenate([one.centres for one in evidence])
        points = (filters.points(owner, at) - pose.shift) @ pose.rotation
        variance = filters.variances(owner, at)
        variance += noise.shift**2 + noise.turn**2 * (points**2).sum(axis=1)
        found = find_sightings(
            points,
            (filters.normal @ pose.rotation)[owner],
            variance,
            image,
            SensorModel.from_config(self.config),
        )
        for number, record in enumerate(records):
            part = found[which == number]
            record.looks += int(2 * np.count_nonzero(part == THERE) > len(part))
            if record.evidence.see(part):
                record.reshape(record.evidence.remaining(record.outline))

    def _forget(self) -> None:
        """Drop planes of which nothing is left, those not confirmed, and what is too much."""
        trial = 1e9 * self.config.track_time
        kept = [
            not r.outline.is_empty and (r.confirmed or self._time - r.seen <= trial)
            for r in self._records
        ]
        if (surplus := sum(kept) - self.config.map_planes) > 0:
            # Those out of sight the longest are forgotten, and of these the ones hardly seen.
            records = self._records
            order = np.flatnonzero(kept).tolist()
            order.sort(key=lambda k: (records[k].seen, records[k].observations))
            for k in order[:surplus]:
                kept[k] = False
        if not all(kept):
            self._keep(np.array(kept))
