"""How well ids persist, against a known truth.

K. Bernardin and R. Stiefelhagen, "Evaluating multiple object tracking performance: the CLEAR MOT
metrics", EURASIP J. Image and Video Processing, 2008.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.evaluation.overlap import Overlap


def ids_of_faces(
    labels: NDArray[np.uint16],
    ids: Mapping[int, int],
    truth: NDArray[np.uint16],
    faces: Mapping[int, int],
    min_pixels: int = 1000,
) -> dict[int, list[int]]:
    """Ids of the planes found on each physical face in a frame, that of the largest one first.

    `ids` are those of the labels (H, W) of planes, or of their surfaces; `faces` those (0 or more)
    that the regions `truth` (H, W) are parts of. A plane lies on a face with more than half of
    its pixels. Faces with fewer than `min_pixels` in the frame do not count.
    """
    table = np.zeros(65536, np.int64)
    table[list(faces)] = np.array(list(faces.values()), np.int64) + 1
    overlap = Overlap.between(table[truth], labels)
    sizes = zip((overlap.truth - 1).tolist(), overlap.truth_sizes, strict=True)
    found: dict[int, list[int]] = {face: [] for face, size in sizes if size >= min_pixels}
    on, which = np.nonzero(overlap.of_labels > 0.5)
    for pair in np.argsort(-overlap.shared[on, which], kind='stable'):
        face, label = int(overlap.truth[on[pair]]) - 1, int(overlap.labels[which[pair]])
        if face in found and label in ids:
            found[face].append(ids[label])
    return found


def track_figures(frames: Sequence[Mapping[int, Sequence[int]]]) -> dict[str, float]:
    """Figures of the ids in a sequence, of faces as `ids_of_faces` returns them.

    A face stays with its id as long as any plane on it has that id; otherwise the first id on it
    takes over. `switches` tells how often a face was taken over by another id than it had when
    last found; `transfers`, how often an id was found on another face than before; `coverage`, the
    share of the faces in sight that were found, over all frames; `track_length`, the mean number
    of frames in which a face kept one id.
    """
    current: dict[int, int] = {}
    owner: dict[int, int] = {}
    switches = transfers = found = 0
    tracks = set()
    for frame in frames:
        for face, ids in frame.items():
            if not ids:
                continue
            found += 1
            if current.get(face) not in ids:
                switches += face in current
                current[face] = ids[0]
            tracks.add((face, current[face]))
            for i in ids:
                transfers += owner.setdefault(i, face) != face
                owner[i] = face
    return {
        'switches': switches,
        'transfers': transfers,
        'coverage': found / max(sum(map(len, frames)), 1),
        'track_length': found / max(len(tracks), 1),
    }
