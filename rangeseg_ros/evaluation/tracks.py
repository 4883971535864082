"""How well ids persist: switches, fragmentation and lengths of tracks against a known truth.

References
----------
K. Bernardin and R. Stiefelhagen, "Evaluating multiple object tracking performance: the CLEAR MOT
metrics", EURASIP J. Image and Video Processing, 2008. Y. Li, C. Huang and R. Nevatia, "Learning
to associate: HybridBoosted multi-target tracker for crowded scene", CVPR 2009 (fragmentation).
"""

from __future__ import annotations

import time
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.segmenter import Segmenter
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.tracking.tracker import Tracker
from rangeseg_ros.evaluation.overlap import Overlap
from rangeseg_ros.io.corrections import corrected
from rangeseg_ros.simulation.kinect import simulate_kinect
from rangeseg_ros.simulation.scenes import kinect_room


def ids_of_faces(
    labels: NDArray[np.uint16],
    ids: Mapping[int, int],
    truth: NDArray[np.uint16],
    faces: Mapping[int, Hashable],
    min_pixels: int = 1000,
) -> dict[Hashable, list[int]]:
    """Ids of the planes found on each physical face in a frame.

    Parameters
    ----------
    labels : (H, W) uint16
        0 = no plane.
    ids : mapping of label to int
        The id of each plane, or that of its surface.
    truth : (H, W) uint16
        True regions.
    faces : mapping of label to face
        The face, however it is called, that a region of `truth` is part of; regions of no face
        do not count.
    min_pixels : int
        Faces with fewer pixels in the frame do not count.

    Returns
    -------
    dict
        For each face in sight the ids of the planes with more than half their pixels on it,
        that of the largest plane first.
    """
    numbers = list(dict.fromkeys(faces.values()))
    table = np.zeros(65536, np.int64)
    for label, face in faces.items():
        table[label] = 1 + numbers.index(face)
    overlap = Overlap.between(table[truth], labels)
    found: dict[Hashable, list[int]] = {
        numbers[number - 1]: []
        for number, size in zip(overlap.truth, overlap.truth_sizes, strict=True)
        if size >= min_pixels
    }
    for pair in np.argsort(-overlap.shared, kind='stable'):
        g, m = overlap.pairs[pair]
        face, label = numbers[overlap.truth[g] - 1], int(overlap.labels[m])
        if overlap.of_labels[pair] > 0.5 and face in found and label in ids:
            found[face].append(ids[label])
    return found


def track_figures(frames: Sequence[Mapping[Hashable, Sequence[int]]]) -> dict[str, Any]:
    """Figures of the ids in a sequence.

    A face stays with its id as long as any plane on it has that id; otherwise the first id on it
    takes over.

    Parameters
    ----------
    frames : sequence of mapping of face to ids
        As `ids_of_faces` returns them.

    Returns
    -------
    dict
        `frames`; `faces`, in sight in any of them; `switches`, how often a face was taken over
        by another id than it had when last found, also per 100 frames; `transfers`, how often an
        id was found on another face than before; `fragmentations`, how often a face was lost
        while in sight and found again; `ids_per_face`, mean number of ids a face has had in
        turn; `coverage`, share of the faces in sight that were found, over all frames;
        `track_length`, mean number of frames in which a face kept one id.
    """
    current: dict[Hashable, int] = {}
    owner: dict[int, Hashable] = {}
    history: dict[Hashable, list[int]] = {}
    missed: set[Hashable] = set()
    switches = transfers = fragmentations = found = visible = 0
    for frame in frames:
        for face, ids in frame.items():
            visible += 1
            history.setdefault(face, [])
            if not ids:
                missed |= {face} & current.keys()
                continue
            found += 1
            fragmentations += face in missed
            missed.discard(face)
            if current.get(face) not in ids:
                switches += face in current
                current[face] = ids[0]
                history[face].append(ids[0])
            for i in ids:
                transfers += owner.setdefault(i, face) != face
                owner[i] = face
        missed &= frame.keys()
    tracks = {(face, i) for face, ids in history.items() for i in ids}
    seen = [ids for ids in history.values() if ids]
    return {
        'frames': len(frames),
        'faces': len(history),
        'switches': switches,
        'switches_per_100_frames': 100 * switches / max(len(frames), 1),
        'transfers': transfers,
        'fragmentations': fragmentations,
        'ids_per_face': float(np.mean([len(set(ids)) for ids in seen])) if seen else 0.0,
        'coverage': found / max(visible, 1),
        'track_length': found / max(len(tracks), 1),
    }


@dataclass(frozen=True, eq=False)
class RoomFrame:
    """Ids on the faces of a simulated room in one frame.

    Attributes
    ----------
    planes, surfaces : dict
        As `ids_of_faces`, by the ids of the planes and of their surfaces; the faces are
        (room, face).
    milliseconds : float
        The tracker took.
    """

    planes: dict[Hashable, list[int]]
    surfaces: dict[Hashable, list[int]]
    milliseconds: float


def track_rooms(
    rooms: Iterable[int], frames: int, speed: int, config: Config
) -> Iterator[RoomFrame]:
    """Segment and track what a moving Kinect sees of simulated rooms.

    Parameters
    ----------
    rooms : iterable of int
        Seeds of `kinect_room`.
    frames : int
        Number of frames of each room, at 30 Hz.
    speed : int
        Times the speed of `camera_motion`: every `speed`-th of its frames is taken.
    config : Config
    """
    segmenter, tracker = Segmenter(config), Tracker(config)
    for room in rooms:
        scene = kinect_room(room, frames * speed)
        tracker.reset()
        for k in range(frames):
            view = simulate_kinect(scene, frame=k * speed, seed=room)
            image = RangeImage.from_depth(view.depth, view.camera)
            result = segmenter.segment(corrected(image, config))
            begin = time.perf_counter()
            stamp = 10**9 + round(k * speed * 1e9 / 30)
            planes = tracker.track(result.labels, result.planes, stamp)
            milliseconds = 1000 * (time.perf_counter() - begin)
            faces = {plane.label: (room, plane.face) for plane in view.planes}
            by_plane, by_surface = (
                ids_of_faces(result.labels, ids, view.labels, faces)
                for ids in (
                    {plane.label: plane.id for plane in planes},
                    {plane.label: plane.surface for plane in planes},
                )
            )
            yield RoomFrame(by_plane, by_surface, milliseconds)
