"""The map of planes: what every frame shows of the planes of a fixed frame, fused over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats, Indices, Labels, Mask
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.mapping.map_planes import MapPlane, Record, describe
from rangeseg_ros.core.mapping.observations import (
    Observations,
    PoseNoise,
    cell_rays,
    observations,
    views,
)
from rangeseg_ros.core.mapping.plane_filter import Jump, PlaneFilters, find_jump
from rangeseg_ros.core.mapping.plane_grid import PlaneGrid, in_sight, passed_through, seen_cells
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel
from rangeseg_ros.core.significance import HIT, MISS
from rangeseg_ros.core.tracking.tracker import NOMINAL

_NOWHERE = Transform.identity(), PoseNoise(0.0, 0.0)
# Jumps of the poses that are told one by one.
_LISTED = 10


class Sighting(NamedTuple):
    """What a frame shows of the planes of a map: M planes, of parts of one the largest.

    `pose` takes the frame of the image to the fixed frame, `ids` (M,) are of the planes of the
    map, and `begins` (M,) tells whether other pixels than before see them. `rays` (C, 3) are of
    the cells that `seen` has views of; `jump` is that of the fixed frame since the frame before.
    """

    pose: Transform
    seen: Observations
    ids: NDArray[np.int64]
    begins: Mask
    rays: Floats
    jump: Jump | None = None


class PlaneMap:
    """Planes of a fixed frame, from the planes of frames whose poses are known.

    Attributes
    ----------
    begun_anew : str
        Why this map was begun after another one; empty when it was not.
    jumps : list of (int, Jump)
        Stamps of frames whose poses the planes contradict, and by how much, of all maps.
    sighting : Sighting or None
        What the last frame shows of it.
    successors : dict of int
        Ids of planes that turned out to be another one -> the id of that one.
    """

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or Config()
        self.begun_anew = ''
        self.jumps: list[tuple[int, Jump]] = []
        self.sighting: Sighting | None = None
        self.successors: dict[int, int] = {}
        self._records: list[Record] = []
        self._filters = PlaneFilters.of(observations([], np.zeros((0, 0)), *_NOWHERE))
        self._rays = np.zeros((0, 3))
        self._next = 1
        self._stamp = self._time = self._frames = 0

    def restarted(self, why: str) -> PlaneMap:
        """An empty map that follows this one: ids are not given twice."""
        other = PlaneMap(self.config)
        other.begun_anew, other.jumps, other._next = why, self.jumps, self._next
        return other

    def __len__(self) -> int:
        return sum(map(self._reported, self._records))

    def __repr__(self) -> str:
        return f'<PlaneMap of {len(self)} planes>'

    @property
    def doubts(self) -> list[str]:
        """What the planes say against the poses: jumps, by the stamps of their frames."""
        found = [f'{stamp * 1e-9:.3f} s: {jump}' for stamp, jump in self.jumps[:_LISTED]]
        if (more := len(self.jumps) - _LISTED) > 0:
            found.append(f'{more} more frames whose poses the planes contradict')
        return found

    @property
    def planes(self) -> list[MapPlane]:
        """The planes whose sure parts are no clutter, in the order of their ids."""
        planes = self._filters.planes
        covariance = planes.covariances(self._filters.covariance)
        found = [
            describe(record, planes.where([k]), covariance[k])
            for k, record in enumerate(self._records)
            if self._reported(record)
        ]
        return sorted(found, key=lambda plane: plane.id)

    def _reported(self, record: Record) -> bool:
        """Whether the sure part of a plane is large enough for the output, and no clutter."""
        return record.grid.sure_area > self.config.map_area

    def add(
        self,
        labels: Labels,
        planes: Sequence[Plane],
        image: RangeImage,
        pose: Transform,
        stamp: int,
    ) -> None:
        """Add a frame. If the fixed frame jumps, planes move along as far as they show the jump.

        The planes, of these labels (H, W), are in the frame of the image, tracked and with their
        roles; what was measured in the image tells which planes are gone. The pose takes that
        frame to the fixed one; the stamp is in nanoseconds.
        """
        config, camera = self.config, pose.shift
        noise = PoseNoise(config.pose_noise, np.radians(config.pose_turn_noise))
        self._time += stamp - self._stamp if stamp > self._stamp > 0 else round(NOMINAL * 1e9)
        self._stamp, self._frames = stamp, self._frames + 1
        seen = observations(planes, views(labels, planes, config.distortion_length), pose, noise)
        if self._filters.view.shape[1] != seen.view.shape[1]:
            # Of images of another size, what comes is of other pixels than before.
            view = np.zeros((len(self._records), seen.view.shape[1]))
            self._filters = self._filters._replace(view=view)
            self._rays = cell_rays(image, config.distortion_length)
        jump = self._followed(planes, seen, camera, noise)
        match = self._associate(planes, seen, camera)
        new = match < 0
        match[new] = len(self._records) + np.arange(np.count_nonzero(new))
        self._filters = self._filters.joined(PlaneFilters.of(seen.where(new)))
        for _ in range(np.count_nonzero(new)):
            self._records.append(Record(self._next, stamp, PlaneGrid(config.map_resolution)))
            self._next += 1
        for plane, k in zip(planes, match.tolist(), strict=True):
            self._records[k].add(plane, stamp, self._time)
        # Of parts of one plane, the largest decides on it.
        order = np.argsort([-plane.count for plane in planes], kind='stable')
        index, first = np.unique(match[order], return_index=True)
        largest = order[first]
        begins = self._filters.update(index, seen.where(largest))
        ids = np.array([self._records[k].id for k in index.tolist()], np.int64)
        self.sighting = Sighting(pose, seen.where(largest), ids, begins, self._rays, jump)
        self._find(labels, planes, match, image, pose, noise)
        self._merge(index, camera)
        self._forget()

    def _followed(
        self, planes: Sequence[Plane], seen: Observations, camera: Floats, noise: PoseNoise
    ) -> Jump | None:
        """Find a jump of the fixed frame by planes that were followed through it; follow it."""
        known = {record.track: k for k, record in enumerate(self._records)}
        both = [m for m, plane in enumerate(planes) if plane.id in known]
        # Odometry never jumps.
        if not both or (self.config.odometry and not self.config.fixed_frame):
            return None
        same = self._filters.where([known[planes[m].id] for m in both])
        jump = find_jump(same, seen.where(both), camera, noise)
        if not jump:
            return None
        after = self._filters.moved(jump.motion, jump.camera, np.zeros((6, 6)))
        pixels, scores = np.array([plane.count for plane in planes]), []
        for filters in (self._filters, after):
            _, which, value = filters.matches(seen.planes, seen.spread, camera)
            likely = np.zeros(len(planes))
            np.maximum.at(likely, which, np.exp(-value / 2))
            scores.append(likely @ pixels)
        # Treads look alike: a tread matched to its neighbour must not count as a jump of a step.
        if scores[1] <= scores[0]:
            return None
        self.jumps.append((self._stamp, jump))
        self._filters = self._filters.moved(jump.motion, jump.camera, jump.covariance)
        return jump

    def _associate(self, planes: Sequence[Plane], seen: Observations, camera: Floats) -> Indices:
        """Numbers (M,) of the planes of the map that the planes of a frame are, -1 for none."""
        index, which, value = self._filters.matches(seen.planes, seen.spread, camera)
        at = self._filters.planes.where(index).coordinates(seen.planes.point[which])
        far = np.array([np.hypot(*plane.extents) for plane in planes])[which]
        pairs = zip(index.tolist(), at, far.tolist(), strict=True)
        away = [self._records[k].grid.distance(p, limit) for k, p, limit in pairs]
        match = np.full(len(planes), -1)
        # What one frame finds on two surfaces is not one plane, however badly its pose is known.
        surface: dict[int, int] = {}
        # The one it lies on, or else the likeliest.
        for n in np.lexsort([value, np.array(away) > 0]).tolist():
            k, m = int(index[n]), int(which[n])
            near = match[m] < 0 and away[n] <= far[n]
            if near and surface.setdefault(k, planes[m].surface) == planes[m].surface:
                match[m] = k
        return match

    def _find(
        self,
        labels: Labels,
        planes: Sequence[Plane],
        match: Indices,
        image: RangeImage,
        pose: Transform,
        noise: PoseNoise,
    ) -> None:
        """Take in the cells of planes of the map that a frame finds, and those it sees through."""
        camera, grids = image.camera, [record.grid for record in self._records]
        known = self._filters.planes.moved(pose.inverse())
        parts: dict[int, list[Plane]] = {}
        for plane, k in zip(planes, match.tolist(), strict=True):
            parts.setdefault(k, []).append(plane)
        for k, some in parts.items():
            corners = np.concatenate([part.corners for part in some])
            grids[k].extend_to(known.where([k]).coordinates(corners))
        # Through a lens, or in a cloud, no homography leads from cells to pixels.
        pinhole = camera if camera and not camera.distortion_model else None
        looked_at = in_sight(grids, known, image) if camera else {}
        if not pinhole:
            looked_at = {k: grids[k] for k in looked_at | parts}
        others, centres, points = {}, [np.zeros((0, 2))], [np.zeros((0, 3))]
        for k, grid in looked_at.items():
            own, found = known.where([k]), np.zeros(grid.odds.shape, np.bool_)
            if pinhole:
                for part in parts.get(k, []):
                    found |= seen_cells(grid, own, part, labels, pinhole)
            else:
                borders = [[p.hull, *p.holes] for p in parts.get(k, []) if len(p.hull) > 2]
                found = grid.fill([[own.coordinates(r) for r in rings] for rings in borders])
            # In turns, every second frame: what is gone is seldom, and to look for it takes long.
            if camera and (self._records[k].id + self._frames) % 2:
                others[k] = (grid.odds > 0) & ~found
                centres.append(grid.centres(others[k]))
                points.append(own.points(centres[-1]))
            grid.add(found, HIT)
        if not camera:
            return
        errors = np.zeros(3), np.diag(noise.deviations**2)
        seen = self._filters.where([*others]).moved(pose.inverse(), *errors)
        owner = np.repeat(range(len(others)), [len(own) for own in centres[1:]]).astype(np.intp)
        at, sensor = np.concatenate(centres), SensorModel.from_config(self.config)
        passed = passed_through(
            np.concatenate(points),
            seen.planes.distance[owner],
            lambda some: seen.variances(owner[some], at[some]),
            image,
            sensor,
        )
        for k, cells in others.items():
            cells[cells], passed = np.split(passed, [np.count_nonzero(cells)])
            looked_at[k].add(cells, 2 * MISS)

    def _merge(self, some: Indices, camera: Floats) -> None:
        """Unite planes of the map that turn out to be one with `some` of this frame."""
        filters = self._filters
        number, others, _ = filters.where(some).matches(filters.planes, filters.covariance, camera)
        kept = np.ones(len(self._records), np.bool_)
        for k, m in zip(some[number].tolist(), others.tolist(), strict=True):
            a, b = self._records[k], self._records[m]
            # Not what this frame finds on two surfaces.
            distinct = a.seen == b.seen == self._time and a.surface != b.surface
            if k == m or distinct or not (kept[k] and kept[m]):
                continue
            (k, a), (m, b) = sorted(((k, a), (m, b)), key=lambda pair: -pair[1].observations)
            own = filters.planes.where([m]).points(b.grid.centres())
            centres = filters.planes.where([k]).coordinates(own)
            across = np.hypot(*b.grid.odds.shape) * b.grid.side
            if not len(own) or a.grid.distance(centres.mean(axis=0), across) > across:
                continue
            a.grid.absorb(centres, b.grid.odds[b.grid.odds > 0])
            first, second = sorted((a.id, b.id))
            self.successors[second] = first
            a.absorb(b)
            filters.absorb(k, m)
            kept[m] = False
        self._keep(kept)

    def _keep(self, chosen: Mask) -> None:
        if not chosen.all():
            self._filters = self._filters.where(chosen)
            self._records = [r for r, kept in zip(self._records, chosen, strict=True) if kept]

    def _forget(self) -> None:
        """Drop planes of which nothing is left, clutter out of sight, and what is too much."""
        trial, least = self._time - 1e9 * self.config.track_time, self.config.map_area
        enough = (
            r.grid.sure_area > least or (r.seen >= trial and r.grid.area > 0)
            for r in self._records
        )
        kept = np.fromiter(enough, np.bool_, len(self._records))
        # Those out of sight the longest are forgotten first, and of these the ones hardly seen.
        if kept.sum() > self.config.map_planes:
            rank = [(k, r.seen, r.observations) for k, r in zip(kept, self._records, strict=True)]
            order = sorted(range(len(rank)), key=rank.__getitem__, reverse=True)
            kept = np.isin(range(len(rank)), order[: self.config.map_planes])
        self._keep(kept)
