"""A recording to a floor plan and its files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from rangeseg_ros.batch.locator import Locator
from rangeseg_ros.batch.replay import Progress, segment_frames
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.mapping.floor_plan import FloorPlan, Up, estimate_up, make_plan
from rangeseg_ros.core.mapping.map_planes import MapPlane
from rangeseg_ros.core.mapping.occupancy import VoxelCounts
from rangeseg_ros.core.sensing.sensor import SensorModel
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.io.bags import DepthBag
from rangeseg_ros.io.files import NotReplacedError
from rangeseg_ros.io.plans import plan_files, write_plan
from rangeseg_ros.io.recordings import BagError
from rangeseg_ros.io.transforms import fixed_frame_of
from rangeseg_ros.report.plan import write_plan_page

PAGE = 'plan.html'


@dataclass(frozen=True)
class PlanOutcome:
    """What became of a recording.

    Attributes
    ----------
    frames, located : int
        Number of frames, and of those whose place was known.
    frame : str
        Fixed frame of the plan.
    planes, walls, openings, squared : int
        Numbers in the plan; of planes with exact right angles.
    up : str
        What tells which way is up.
    warnings : list of str
    """

    frames: int
    located: int
    frame: str
    planes: int
    walls: int
    openings: int
    squared: int
    up: str
    warnings: list[str] = field(default_factory=list)


@dataclass
class _Stretch:
    """What was seen while the map was one: it begins anew where the fixed frame jumps."""

    voxels: VoxelCounts
    planes: list[MapPlane] = field(default_factory=list)
    looked: np.ndarray = field(default_factory=lambda: np.zeros(3))
    told: np.ndarray = field(default_factory=lambda: np.zeros(3))
    frames: int = 0

    @property
    def area(self) -> float:
        """Of its planes."""
        return sum(plane.area for plane in self.planes)


@dataclass(frozen=True)
class PlanTask:
    """The plan of one recording.

    Attributes
    ----------
    recording, folder : Path
    config : Config
        Without `fixed_frame`, the frame that the recording's tf moves in counts, and without tf
        that of the odometry.
    headroom : float
        Metres above the ground up to which things are in the way.
    resolution : float
        Side of a cell of the grid, metres.
    overwrite : bool
        Replace files of these names.
    depth_topic, camera_topic : str or None
    """

    recording: Path
    folder: Path
    config: Config
    headroom: float
    resolution: float
    overwrite: bool = False
    depth_topic: str | None = None
    camera_topic: str | None = None

    def check(self) -> None:
        """BagError or NotReplacedError when the recording or the folder will not do."""
        with self._open():
            pass
        for name in (*plan_files(), PAGE):
            if (self.folder / name).exists() and not self.overwrite:
                raise NotReplacedError(self.folder / name)

    def run(self, progress: Progress | None = None) -> PlanOutcome:
        """Map the recording and write the files.

        Raises
        ------
        ValueError
            As `check`; a recording in which no plane was found, or the camera's place is unknown.
        """
        self.check()
        config = self.config
        if not config.map_frame:
            frame = fixed_frame_of(self.recording)
            config = (
                replace(config, fixed_frame=frame) if frame else replace(config, odometry=True)
            )
        frames, best, warnings = self._map(config, progress)
        if not best.frames:
            raise BagError(
                f'{self.recording}: where the camera was in {config.map_frame!r} is not known for '
                f'any of {frames} frames: {"; ".join(warnings) or "no tf"}'
            )
        if not best.planes:
            raise BagError(f'{self.recording}: no planes in {best.frames} frames')
        plan = self._plan(best, config)
        self.folder.mkdir(parents=True, exist_ok=True)
        write_plan(self.folder, plan)
        write_plan_page(self.folder / PAGE, self.recording.name, plan, warnings)
        return PlanOutcome(
            frames,
            best.frames,
            config.map_frame,
            len(plan.planes),
            len(plan.walls),
            len(plan.openings),
            sum(squared.exact == 'square' for squared in plan.planes),
            plan.up.source,
            warnings,
        )

    def _map(self, config: Config, progress: Progress | None) -> tuple[int, _Stretch, list[str]]:
        """Number of frames, the stretch with the largest map, and what is to be told."""
        sequence, sensor = SequenceSegmenter(config), SensorModel.from_config(config)
        now = best = _Stretch(VoxelCounts(self.resolution, sensor))
        frames, warnings, epoch = 0, [], sequence.map.epoch
        with self._open() as source, Locator(self.recording, config) as located:
            found = segment_frames(source, sequence, located.place, progress)
            for _, _, image, _ in found:
                frames += 1
                if sequence.map.epoch != epoch:
                    epoch = sequence.map.epoch
                    now.planes = sequence.map.planes_before
                    warnings.append(f'frame {frames - 1}: {sequence.map.begun_anew}')
                    best = max(best, now, key=lambda stretch: stretch.area)
                    now = _Stretch(VoxelCounts(self.resolution, sensor))
                if sequence.pose is None:
                    continue
                now.frames += 1
                now.voxels.add(image, sequence.pose)
                turn = sequence.pose.rotation
                now.looked += turn @ (config.up_x, config.up_y, config.up_z)
                if located.last.up is not None:
                    now.told += turn @ located.last.up
            warnings += [f'{n} frames without the {why}' for why, n in located.problems.items()]
            if source.damage:
                warnings.append(source.damage)
        now.planes = sequence.map.planes
        best = max(best, now, key=lambda stretch: (stretch.area, stretch.frames))
        warnings += sequence.map.doubts
        return frames, best, warnings

    def _plan(self, best: _Stretch, config: Config) -> FloorPlan:
        tolerance = np.radians(config.role_tolerance)
        if best.told.any():
            source = config.gravity_frame or 'the accelerometer'
            up = Up(best.told / np.linalg.norm(best.told), 0.0, source)
        else:
            up = estimate_up(best.planes, best.looked, tolerance)
        return make_plan(
            best.planes,
            config.map_frame,
            up,
            best.voxels.points(),
            config,
            self.headroom,
            self.resolution,
        )

    @contextmanager
    def _open(self) -> Iterator[DepthBag]:
        with DepthBag(self.recording, self.depth_topic, self.camera_topic) as source:
            yield source
