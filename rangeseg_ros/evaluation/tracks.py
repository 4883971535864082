"""How well ids persist: switches, fragmentation and lengths of tracks against a known truth.

References
----------
K. Bernardin and R. Stiefelhagen, "Evaluating multiple object tracking performance: the CLEAR MOT
metrics", EURASIP J. Image and Video Processing, 2008. Y. Li, C. Huang and R. Nevatia, "Learning
to associate: HybridBoosted multi-target tracker for crowded scene", CVPR 2009 (fragmentation).
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.evaluation.overlap import Overlap


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
