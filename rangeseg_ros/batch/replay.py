"""A recording segmented: pictures, a table, a bag and a report, in a folder."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from rangeseg_ros.batch.frame_files import write_frame
from rangeseg_ros.batch.locator import Locator
from rangeseg_ros.batch.result_bag import ResultBag, Timed, open_source, read_record
from rangeseg_ros.batch.result_folder import LEADING, PICTURES, TERRAIN, ResultFolder
from rangeseg_ros.compilation.preparation import prepare
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.description.tilt import Tilt
from rangeseg_ros.core.mapping.map_planes import MapPlane
from rangeseg_ros.core.mapping.odometry import Motion
from rangeseg_ros.core.mapping.placement import Placement
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.segmentation import Segmentation
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.digest import result_key
from rangeseg_ros.io import tables
from rangeseg_ros.io.bags import DamagedBagError, DepthBag
from rangeseg_ros.io.corrections import corrected, correction_files
from rangeseg_ros.io.meshes import write_mesh
from rangeseg_ros.io.poses import seconds_of, write_trajectory
from rangeseg_ros.io.recordings import BagError
from rangeseg_ros.messages.frames import DepthFrame
from rangeseg_ros.report.replay import ReplayReport

# Of the files of a rosbag2.
_SUFFIXES = ('.mcap', '.db3', '.yaml', '.zstd')

Progress = Callable[[Iterable[DepthFrame], int], Iterable[DepthFrame]]


@dataclass(frozen=True)
class Outcome:
    """What became of a recording: frames, those of them without planes, and planes in the map.

    `figures` are those of `ReplayReport`; `notes` and `warnings` tell of frames, `damage` what of
    the recording could not be read.
    """

    frames: int
    empty: int
    figures: dict[str, float]
    mapped: int = 0
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    damage: str = ''
    already_done: bool = False


@dataclass(frozen=True)
class Replay:
    """Segmentation of one recording.

    The bag among the results gets its name when all else is complete. It marks the recording as
    done, and a further `run` leaves it alone as long as recording, parameters, code and the other
    results are the same; any other state is started anew, as ids depend on all frames before.

    `topics` are names of `OUTPUTS` to record, and with `copy` those of the recording as well; see
    `DepthBag` for where the images are. With `terrain` terrain and height of every frame are
    written, and the tables of ground and stairs; with `overwrite` also files are replaced that
    have the names of results and that no replay has written.
    """

    recording: Path
    folder: Path
    config: Config
    depth_topic: str | None = None
    camera_topic: str | None = None
    camera: Camera | None = None
    topics: tuple[str, ...] = ('labels', 'planes', 'markers')
    copy: bool = False
    raw: bool = False
    overwrite: bool = False
    terrain: bool = False

    def check(self) -> str:
        """Topics that will be read; BagError when the recording or the folder will not do."""
        ResultFolder(self.folder).check(self.recording, self.overwrite)
        with self._open() as source:
            if self.copy:
                open_source(self.recording).close()
            return ', '.join(filter(None, (source.depth_topic, source.camera_topic)))

    def run(self, progress: Progress | None = None) -> Outcome:
        """Write the results, or find that they are there; BagError as `check`."""
        key, results_folder = self._key(), ResultFolder(self.folder)
        record = read_record(results_folder.bag)
        whole = results_folder.whole()
        if whole and record.get('key') == key:
            return Outcome(**record['outcome'] | {'already_done': True})
        if whole and not self.overwrite:
            raise BagError(
                f'{self.folder}: has results of other input, parameters or code, not overwritten '
                '(see --overwrite)'
            )
        self.check()
        with (
            results_folder.replacing() as made,
            self._open() as source,
            Locator(self.recording, self.config) as located,
            tables.open_table(
                made.path / 'planes.csv', [*LEADING, *tables.columns()]
            ) as add_planes,
            ResultBag(made.bag, self.topics, self.config.odometry) as bag,
            ExitStack() as stack,
        ):
            results = _Results(self, made.path, add_planes, bag, located)
            streams = [results.messages(source, progress)]
            if self.copy:
                streams.append(bag.copies(stack.enter_context(open_source(self.recording))))
            bag.write_merged(*streams)
            outcome = results.finish(source)
            bag.record({'key': key, 'outcome': asdict(outcome), 'files': made.digest()})
        return outcome

    def _open(self) -> DepthBag:
        topics = self.depth_topic, self.camera_topic
        return DepthBag(self.recording, *topics, self.raw, self.camera)

    def _key(self) -> str:
        """Digest of all that the results depend on: code, parameters, the recording's files."""
        settings = replace(self, recording=Path(), folder=Path(), overwrite=False)
        parts = [self.recording]
        if self.recording.is_dir():
            parts = [path for path in self.recording.iterdir() if path.suffix in _SUFFIXES]
        return result_key(settings, correction_files(self.config), parts)


@dataclass
class _Results:
    """Writes what a replay leaves of every frame, and of all of them."""

    replay: Replay
    folder: Path
    add_planes: Callable[[Iterable[Iterable[Any]]], None]
    bag: ResultBag
    located: Locator
    trajectory: list[tuple[int, Transform]] = field(default_factory=list)
    ground: list[list[Any]] = field(default_factory=list)
    stairs: list[list[Any]] = field(default_factory=list)
    tilts: list[Tilt] = field(default_factory=list)
    doubts: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self.config = self.replay.config
        self.report = ReplayReport(self.replay.recording.name, self.config)
        self.sequence = SequenceSegmenter(self.config)

    def messages(self, source: DepthBag, progress: Progress | None) -> Iterator[Timed]:
        """Segment the frames and write their files; the messages for the bag."""
        sequence, target_frame = self.sequence, self.config.target_frame
        for index, frame, image, result in segment_frames(
            source, sequence, self.located.place, progress
        ):
            self._write(index, frame.stamp, image, result)
            to_target = self.located.last.target
            target = (target_frame, to_target) if to_target else None
            yield from self.bag.messages(frame, image, result, target, sequence.motion)

    def _write(self, index: int, stamp: int, image: RangeImage, result: Segmentation) -> None:
        leading = [str(index), seconds_of(stamp)]
        kinds = PICTURES + TERRAIN if self.replay.terrain else PICTURES
        files = write_frame(self.folder, f'{index:06d}_{leading[1]}', image, result, kinds)
        self.add_planes([*leading, *tables.values(plane)] for plane in result.planes)
        self.report.add(stamp, result, files['overlay'])
        if image.valid.any():
            self.doubts.update(result.verdict.details)
        if result.tilt:
            self.tilts.append(result.tilt)
        if self.replay.terrain:
            self.ground.append([*leading, *tables.ground_values(result)])
            self.stairs += [[*leading, *tables.stairs_values(seen)] for seen in result.stairs]
        if self.sequence.motion:
            self.trajectory.append((stamp, self.sequence.motion.pose))

    def finish(self, source: DepthBag) -> Outcome:
        """Write what is of all frames."""
        folder, config, mapped = self.folder, self.config, self.sequence.map
        if self.replay.terrain:
            tables.write_table(folder / 'ground.csv', [*LEADING, *tables.GROUND], self.ground)
            tables.write_table(folder / 'stairs.csv', [*LEADING, *tables.STAIRS], self.stairs)
        if config.odometry:
            write_trajectory(folder / 'trajectory.txt', self.trajectory)
        if config.map_frame:
            without = ('label',)
            rows = [[*tables.values(p, without), tables.parts_value(p)] for p in mapped.planes]
            columns = [*tables.columns(MapPlane, without), 'parts']
            tables.write_table(folder / 'map.csv', columns, rows)
            write_mesh(folder / 'map.ply', mapped.planes)
        damage = [source.damage, source.loss()]
        if lost := self.bag.lost:
            reason, count = lost.most_common(1)[0]
            damage.append(f'{lost.total()} messages not copied, {count} of {reason}')
        report, contradicted = self.report, mapped.doubts if config.map_frame else []
        notes = [f'{n} frames without a plane: {why}' for why, n in report.reasons.items()]
        notes += [f'{n} frames without the {what}' for what, n in self.located.problems.items()]
        warnings = [f'{n} frames: {doubt}' for doubt, n in self.doubts.items()]
        if self.tilts:
            worst = max(self.tilts, key=lambda tilt: tilt.degrees)
            warnings.append(f'{len(self.tilts)} frames: {worst}')
        warnings += [f'poses: {doubt}' for doubt in contradicted]
        outcome = Outcome(
            report.frames,
            report.reasons.total(),
            report.figures(),
            len(mapped.planes),
            notes,
            warnings,
            '; '.join(filter(None, damage)),
        )
        report.write(folder / 'report.html', outcome.damage, contradicted)
        return outcome


def segment_frames(
    source: DepthBag,
    sequence: SequenceSegmenter,
    place: Callable[[DepthFrame, Motion | None], Placement],
    progress: Progress | None = None,
) -> Iterator[tuple[int, DepthFrame, RangeImage, Segmentation]]:
    """Segment the frames of a recording, with persistent ids and roles; `place` locates them.

    Yields their numbers among the frames of the recording, of which those that cannot be read are
    left out and counted by `source.lost`.
    """
    # Or the times of the first frame would be those of the compiler.
    kinds = ('image',) if source.has_images else ('points',)
    prepare(sequence.config, kinds, report=lambda progress: None)
    done = 0
    try:
        for frame in progress(source, len(source)) if progress else source:
            try:
                image = frame.range_image()
            except ValueError as error:
                source.lose(str(error))
                continue
            image = corrected(image, sequence.config)
            at = place(frame, sequence.motion)
            result = sequence.segment(image, frame.stamp, at.up, at.pose, at.height, at.up_sd)
            if at.lost:
                result = replace(result, source=None)
            yield done + source.lost.total(), frame, image, result
            done += 1
    except DamagedBagError as error:
        source.damage = str(error)
