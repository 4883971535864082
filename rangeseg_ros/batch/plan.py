"""A recording to a floor plan and its files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from rangeseg_ros.batch.locator import Locator
from rangeseg_ros.batch.replay import Progress, segment_frames
from rangeseg_ros.core.arrays import Floats
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.ground.stairs import Stairs
from rangeseg_ros.core.mapping.adjustment import Adjustment, Solution
from rangeseg_ros.core.mapping.observations import PoseNoise
from rangeseg_ros.core.mapping.plane_map import PlaneMap
from rangeseg_ros.core.sensing.sensor import SensorModel
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.io.bags import DamagedBagError, DepthBag
from rangeseg_ros.io.corrections import corrected
from rangeseg_ros.io.files import NotReplacedError
from rangeseg_ros.io.plans import plan_files, write_plan
from rangeseg_ros.io.recordings import BagError
from rangeseg_ros.io.transforms import fixed_frame_of
from rangeseg_ros.plan.floor_plan import PlanUp, estimate_up, make_plan, points_within
from rangeseg_ros.report.plan import write_picture, write_plan_page

PICTURE, PAGE = 'plan.svg', 'plan.html'


@dataclass(frozen=True)
class PlanOutcome:
    """What became of a recording.

    Numbers of its frames and of those whose place was known, its fixed `frame`, what tells which
    way is `up`, and what is in the plan, in words.
    """

    frames: int
    located: int
    frame: str
    up: str
    content: str
    warnings: list[str] = field(default_factory=list)


@dataclass
class _MapSession:
    """Frames that share one map; a new one begins where the fixed frame jumps.

    `frames` are the numbers of its frames, `heights` of the sensor in them, metres, NaN where not
    known; `stairs` that they show, with their places among the frames; `parameter_up` and
    `gravity_up` sums of the directions of up in the images, by the parameters and that frame.
    """

    map: PlaneMap
    seen: Adjustment
    frames: list[int] = field(default_factory=list)
    heights: list[float] = field(default_factory=list)
    stairs: list[tuple[Stairs, int]] = field(default_factory=list)
    parameter_up: np.ndarray = field(default_factory=lambda: np.zeros(3))
    gravity_up: np.ndarray = field(default_factory=lambda: np.zeros(3))

    @property
    def extent(self) -> tuple[float, int]:
        """Area of its planes, and number of frames."""
        return sum(plane.area for plane in self.map.planes), len(self.frames)


@dataclass(frozen=True)
class PlanTask:
    """The plan of one recording.

    Without `fixed_frame` in the config, the frame that the recording's tf moves in counts, and
    without tf that of the odometry. Things up to the headroom above the ground are in the way;
    the resolution is the side of a cell of the grid, both in metres.
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
        for name in (PICTURE, PAGE, *plan_files()):
            if (self.folder / name).exists() and not self.overwrite:
                raise NotReplacedError(self.folder / name)

    def run(self, progress: Progress | None = None) -> PlanOutcome:
        """Map the recording and write the files.

        ValueError as `check`, and where no plane was found or the camera's place is unknown.
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
        if not (planes := best.map.planes):
            raise BagError(f'{self.recording}: no planes in {len(best.frames)} frames')
        solution = best.seen.solve(planes, best.map.successors)
        if solution.drifts:
            warnings.append(solution.drift_text())
        points = self._points(best.frames, solution, config)
        up = estimate_up(solution.planes, best.parameter_up, np.radians(config.role_tolerance))
        if best.gravity_up.any():
            direction = best.gravity_up / np.linalg.norm(best.gravity_up)
            up = PlanUp(direction, 0.0, config.gravity_frame)
        grid = self.headroom, self.resolution
        stairs = [(each, solution.poses[k]) for each, k in best.stairs]
        heights = np.array(best.heights)[:, None] * up.direction
        stood = np.array([pose.shift for pose in solution.poses]) - heights
        plan = make_plan(solution, config.map_frame, up, points, stairs, stood, config, *grid)
        self.folder.mkdir(parents=True, exist_ok=True)
        write_plan(self.folder, plan)
        write_picture(self.folder / PICTURE, plan)
        write_plan_page(self.folder / PAGE, self.recording.name, plan, warnings)
        square = sum(plane.exact == 'square' for plane in plan.planes)
        content = f'{len(plan.planes)} planes, {len(plan.walls)} upright, {square} of them square'
        content += f', {len(plan.openings)} openings, {len(plan.stairs)} stairs'
        parts = config.map_frame, up.source, content, warnings
        return PlanOutcome(frames, len(best.frames), *parts)

    def _map(
        self, config: Config, progress: Progress | None
    ) -> tuple[int, _MapSession, list[str]]:
        """Number of frames, the session with the largest map, and warnings."""
        sequence = SequenceSegmenter(config)
        noise = PoseNoise(config.pose_noise, np.radians(config.pose_turn_noise))

        def begin() -> _MapSession:
            return _MapSession(sequence.map, Adjustment(noise, odometry=not config.fixed_frame))

        stretches, frames, warnings = [begin()], 0, []
        with self._open() as source, Locator(self.recording, config) as located:
            for k, _, image, found in segment_frames(source, sequence, located.place, progress):
                frames += 1
                if stretches[-1].map is not sequence.map:
                    warnings.append(f'frame {k}: {sequence.map.begun_anew}')
                    stretches.append(begin())
                now = stretches[-1]
                if sequence.map.sighting and sequence.pose:
                    # As the poses, from where the sensor is.
                    for s in [] if found.tilt else found.stairs:
                        now.stairs.append((replace(s, edge=s.edge - image.place), len(now.frames)))
                    now.frames.append(k)
                    now.heights.append(getattr(found.source, 'sensor_height', 0) or np.nan)
                    now.seen.add(sequence.map.sighting)
                    turn = sequence.pose.rotation
                    now.parameter_up += turn @ (config.up_x, config.up_y, config.up_z)
                    if located.last.up is not None:
                        now.gravity_up += turn @ located.last.up
            warnings += [f'{n} frames without the {why}' for why, n in located.problems.items()]
            if source.damage:
                warnings.append(source.damage)
        best = max(stretches, key=lambda stretch: stretch.extent)
        return frames, best, warnings + sequence.map.doubts

    def _points(self, frames: list[int], solution: Solution, config: Config) -> Iterator[Floats]:
        """Points of the frames of these numbers, at their poses and without the distortion."""
        sensor = SensorModel.from_config(config)
        poses = dict(zip(frames, solution.poses, strict=True))
        # What comes after damage has no poses.
        with self._open() as source, suppress(DamagedBagError):
            for done, frame in enumerate(source):
                if pose := poses.get(done + source.lost.total()):
                    image = corrected(frame.range_image(), config)
                    image = solution.corrected(image, config.distortion_length)
                    yield pose.apply(points_within(image, sensor, self.resolution) - image.place)

    def _open(self) -> DepthBag:
        return DepthBag(self.recording, self.depth_topic, self.camera_topic)
