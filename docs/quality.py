"""What sets of single images do not show, as shares that are 1 at best.

python docs/quality.py: prints an object of JSON, for `rangeseg experiment sensitivity --script`.
How well ids, map and ground of a walk through a simulated room agree with the truth, how much of a
sensor's fixed error is learned, and how true the standard deviations are that are stated of it.
"""

import json

import numpy as np
from distortion import errors
from measure_frames import CONFIG, face_of, room_of, walked

from rangeseg_ros.core.ground.classes import GROUND
from rangeseg_ros.core.mapping.plane_map import PlaneMap
from rangeseg_ros.core.significance import chi2_quantile
from rangeseg_ros.evaluation.tracks import ids_of_faces, track_figures

ROOM, FRAMES = 100, 24


def main():
    """Print everything."""
    true, error, ratio = errors('kinect', FRAMES)
    names = 'ids', 'map', 'covariances of the map', 'ground'
    figures = dict(zip(names, of_walk(ROOM), strict=True))
    print(json.dumps({**figures, 'calibration': 1 - error / true, 'its deviation': agreed(ratio)}))


def of_walk(seed):
    """Shares of the ids (as CLEAR MOT), of the faces, of the stated errors, of the ground."""
    scene, plane_map, ids = room_of(seed), PlaneMap(CONFIG), []
    truth = np.vstack([solid.planes for solid in scene.solids])
    floor = int((truth[:, 2] - abs(truth[:, 3])).argmax())
    seen, ground = np.zeros(len(truth), int), np.zeros(2)
    for frame in walked(scene, seed):
        plane_map.add(frame.labels, frame.planes, frame.image, frame.pose, frame.stamp)
        own = {plane.label: plane.id for plane in frame.planes}
        numbers = {1 + face: face for face in range(len(truth))}
        ids.append(ids_of_faces(frame.labels, own, 1 + frame.faces, numbers))
        seen += np.bincount(frame.faces[frame.faces >= 0], minlength=len(truth)) >= 1000
        told = frame.terrain[frame.faces == floor]
        ground += (told == GROUND).sum(), told.size
    tracks = track_figures(ids)
    visible = sum(map(len, ids))
    faces = [face_of(plane, scene, truth) for plane in plane_map.planes]
    nees = []
    for plane, face in zip(plane_map.planes, faces, strict=True):
        error = np.append(plane.normal, plane.distance) - truth[face]
        if face >= 0:
            nees.append(error @ np.linalg.pinv(plane.covariance, 1e-10) @ error / 3)
    there = set(np.flatnonzero(seen >= 10).tolist())
    return (
        tracks['coverage'] - (tracks['switches'] + tracks['transfers']) / visible,
        len(there & set(faces)) / (len(there) + faces.count(-1)),
        agreed(np.median(nees) / (chi2_quantile(3, 0.5) / 3)),
        ground[0] / ground[1],
    )


def agreed(ratio):
    """1 where what was stated is as large as what was found, less either way."""
    return float(min(ratio, 1 / ratio))


if __name__ == '__main__':
    main()
