"""Measure what docs/frames.md says.

python docs/measure_frames.py map SEED...         walks through simulated rooms, against the truth
python docs/measure_frames.py lies SEED...        poses that drift or jump
python docs/measure_frames.py loops SEED...       ends of walks by odometry, and solved
python docs/measure_frames.py odometry SEED...    a second of odometry, against the truth
python docs/measure_frames.py mount COUNT SEED    cameras in simulated rooms
python docs/measure_frames.py hour FRAMES         a walk along a corridor, 10 frames a second
python docs/measure_frames.py real IMAGES POSES CAMERA    frames about their map
"""

import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely
from scipy.spatial.transform import Rotation

from rangeseg_ros import Config, RangeImage
from rangeseg_ros.core.mapping.adjustment import Adjustment
from rangeseg_ros.core.mapping.edges import JumpPoints
from rangeseg_ros.core.mapping.mount import mount_of
from rangeseg_ros.core.mapping.observations import PoseNoise, views
from rangeseg_ros.core.mapping.odometry import PlaneOdometry
from rangeseg_ros.core.mapping.plane_map import PlaneMap
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.core.tracking.plane_errors import tangents
from rangeseg_ros.io.cameras import read_camera
from rangeseg_ros.io.images import read_depth
from rangeseg_ros.simulation.render import simulate
from rangeseg_ros.simulation.scenes import Pose, Scene, kinect_room, walk
from rangeseg_ros.simulation.sensors.kinect import Kinect, kinect_camera
from rangeseg_ros.simulation.solids import box, cast, half_space

FRAMES, STEP, SECOND = 120, 3, 10**9
CONFIG = Config()


class Frame(NamedTuple):
    """A frame of a walk; `faces` (H, W) are numbers of true faces, -1 for none."""

    stamp: int
    image: RangeImage
    labels: np.ndarray
    planes: list
    terrain: np.ndarray
    pose: Transform
    faces: np.ndarray
    edges: JumpPoints


def walked(scene: Scene, seed: int) -> Iterator[Frame]:
    """A walk at 10 Hz, segmented."""
    sequence = SequenceSegmenter(CONFIG)
    for k in range(0, FRAMES * STEP, STEP):
        view = simulate(scene, Kinect(seed), frame=k, seed=seed)
        pose = Transform(scene.poses[k].rotation, scene.poses[k].position)
        image = RangeImage.from_depth(view.depth, view.camera)
        stamp = SECOND + k * SECOND // 30
        found = sequence.segment(image, stamp, up=pose.rotation[2])
        number = np.full(int(view.labels.max()) + 1, -1)
        for plane in view.planes:
            number[plane.label] = plane.face
        seen = found.labels, found.planes, found.terrain
        edges = JumpPoints.of(image, found.jumps, found.cells)
        yield Frame(stamp, image, *seen, pose, number[view.labels], edges)


def measure_map(*seeds: str) -> None:
    """Planes per face, faces missed, errors, NEES and time, before and after the solution."""
    rows, solved, poses, single, found, seen, ghosts = [], [], [], [], 0, 0, 0
    for seed in map(int, seeds):
        scene, random = kinect_room(seed, FRAMES * STEP, walk), np.random.default_rng(seed)
        truth = np.vstack([solid.planes for solid in scene.solids])
        plane_map, spent, pixels = PlaneMap(CONFIG), [], np.zeros(len(truth), int)
        adjustment, walls = Adjustment(PoseNoise(0.005, np.radians(0.3))), []
        for frame in walked(scene, seed):
            off = Rotation.from_rotvec(random.normal(0, np.radians(0.3), 3)).as_matrix()
            shift = frame.pose.shift + random.normal(0, 0.005, 3)
            told = Transform(off @ frame.pose.rotation, shift)
            begin = time.thread_time()
            plane_map.add(frame.labels, frame.planes, frame.image, told, frame.stamp)
            spent.append(1e3 * (time.thread_time() - begin))
            adjustment.add(plane_map.sighting)
            walls.append((frame.image, frame.faces, told, frame.pose))
            pixels += np.bincount(frame.faces[frame.faces >= 0], minlength=len(truth)) >= 1000
            for plane in frame.planes:
                under = frame.faces[frame.labels == plane.label]
                count = np.bincount(under[under >= 0], minlength=len(truth))
                if count.max() > len(under) / 2:
                    face = truth[count.argmax()]
                    normal = told.rotation @ plane.normal
                    distance = plane.distance - normal @ told.shift
                    at = frame.pose.rotation @ plane.centroid + frame.pose.shift
                    single.append(errors(normal, distance, at, face))
        faces = [face_of(plane, scene, truth) for plane in plane_map.planes]
        solution = adjustment.solve(plane_map.planes, plane_map.successors)
        for into, planes in ((rows, plane_map.planes), (solved, solution.planes)):
            for plane, face in zip(planes, faces, strict=True):
                if face >= 0:
                    error = np.append(plane.normal, plane.distance) - truth[face]
                    nees = error @ np.linalg.pinv(plane.covariance, 1e-10) @ error / 3
                    at = plane.centroid
                    into.append((*errors(plane.normal, plane.distance, at, truth[face]), nees))
        flat = [(solution.corrected(image, 0.0), *rest) for image, *rest in walls]
        both = (walls, 'told'), (walls, 'true'), (walls, solution.poses), (flat, solution.poses)
        poses.append([thickness(*each) for each in both])
        there = set(np.flatnonzero(pixels >= 10).tolist())
        found, seen = found + len(set(faces) - {-1}), seen + len(there)
        ghosts += faces.count(-1)
        missed = sorted(there - set(faces))
        print(f'{seed}: {len(there)} faces, missed {missed}, {np.median(spent):.2f} ms a frame')
    alone = np.median(single, axis=0)
    print(f'planes per face {len(rows) / found:.3f} of {seen}; {ghosts} on no face')
    print(f'single frames: normals {alone[0]:.3f} degrees, offsets {alone[1]:.2f} mm')
    for name, each in (('map', rows), ('solution', solved)):
        angle, offset, nees = np.array(each).T
        print(
            f'{name}: normals {np.median(angle):.3f} degrees, offsets {np.median(offset):.2f} mm'
        )
        print(f'{name}: NEES {nees.mean():.2f} in the mean, {np.median(nees):.2f} in the median')
    print('walls are thick by (mm): poses as told, true, solved, and without the distortion')
    print(np.median(poses, axis=0))


def measure_lies(*seeds: str) -> None:
    """Poses that drift by 1 %, or jump by 7 or 36 cm in the middle: found, and after solving."""
    rows: dict[str, list] = {'true': [], 'drift': [], '7 cm': [], '36 cm': []}
    for seed in map(int, seeds):
        scene, random = kinect_room(seed, FRAMES * STEP, walk), np.random.default_rng(seed)
        frames = list(walked(scene, seed))
        noise = random.normal(0, [[np.radians(0.3)] * 3 + [0.005] * 3], (len(frames), 6))
        aside = random.normal(size=3)
        aside /= np.linalg.norm(aside)
        for lie, into in rows.items():
            plane_map, adjustment = PlaneMap(CONFIG), Adjustment(PoseNoise(0.005, np.radians(0.3)))
            way, place, told = 0.0, frames[0].pose.shift, []
            for k, frame in enumerate(frames):
                way += float(np.linalg.norm(frame.pose.shift - place))
                place = frame.pose.shift
                off = {'drift': 0.01 * way, '7 cm': 0.07 * (k > 60), '36 cm': 0.36 * (k > 60)}
                told.append(frame.pose.by(noise[k] + [0, 0, 0, *off.get(lie, 0.0) * aside]))
                plane_map.add(frame.labels, frame.planes, frame.image, told[-1], frame.stamp)
                adjustment.add(plane_map.sighting)
            solution = adjustment.solve(plane_map.planes, plane_map.successors)
            jumps = [1e3 * np.linalg.norm(jump.error[3:]) for _, jump in plane_map.jumps]
            before, after = (
                1e3 * np.sqrt(np.mean([best_fit(frames, each) ** 2]))
                for each in (told, solution.poses)
            )
            drift = 100 * np.linalg.norm(solution.drift) * solution.drifts
            into.append((len(jumps), sum(jumps), drift, before, after))
    print('jumps found, mm in all, drift found (%), poses before and after solving (mm): medians')
    for lie, each in rows.items():
        print(f'{lie}:', np.round(np.median(each, axis=0), 1), 'jumps', [int(r[0]) for r in each])


def measure_loops(*seeds: str) -> None:
    """How far the ends of a walk are off each other by odometry, and after solving."""
    rows = []
    for seed in map(int, seeds):
        config = Config(odometry=True)
        odometry, plane_map = PlaneOdometry(config), PlaneMap(config)
        adjustment = Adjustment(PoseNoise(0.005, np.radians(0.3)), odometry=True)
        frames, told = list(walked(kinect_room(seed, FRAMES * STEP, walk), seed)), []
        for frame in frames:
            seen = views(frame.labels, frame.planes, CONFIG.distortion_length)
            up = frames[0].pose.rotation[2]
            motion = odometry.add(frame.planes, seen, frame.stamp, up, edges=frame.edges)
            told.append(motion.pose)
            plane_map.add(frame.labels, frame.planes, frame.image, told[-1], frame.stamp)
            adjustment.add(plane_map.sighting)
        solution = adjustment.solve(plane_map.planes, plane_map.successors)
        truth = frames[0].pose.inverse().after(frames[-1].pose)
        rows.append([])
        for poses in (told, solution.poses):
            error = truth.inverse().after(poses[0].inverse().after(poses[-1]))
            turn = Rotation.from_matrix(error.rotation).magnitude()
            rows[-1] += [1e3 * np.linalg.norm(error.shift), np.degrees(turn)]
    print('ends of the walk: mm and degrees by odometry, then solved; medians')
    print(np.round(np.median(rows, axis=0), 2), np.round(rows, 1).tolist())


def best_fit(frames: list[Frame], poses: list[Transform]) -> float:
    """Root mean square distance of the places from the true ones, metres, after alignment."""
    true = np.array([frame.pose.shift for frame in frames])
    told = np.array([pose.shift for pose in poses])
    _, left = Rotation.align_vectors(true - true.mean(axis=0), told - told.mean(axis=0))
    return float(left / len(true) ** 0.5)


def thickness(walls: list, poses) -> float:
    """Root mean square distance of the points of faces from their planes, millimetres."""
    points: dict[int, list] = {}
    for k in range(0, len(walls), 3):
        image, faces, told, true = walls[k]
        turn, shift = {'told': told, 'true': true}[poses] if isinstance(poses, str) else poses[k]
        near = image.valid & (image.inverse > 1 / 3)
        for face in np.unique(faces[near & (faces >= 0)]).tolist():
            some = image.points[near & (faces == face)][::40]
            if len(some) > 25:
                points.setdefault(face, []).append(some @ turn.T + shift)
    squares = []
    for parts in (np.concatenate(p) for p in points.values() if len(p) > 4):
        left = parts - parts.mean(axis=0)
        off = left @ np.linalg.eigh(left.T @ left)[1][:, 0]
        squares.append(off[np.abs(off) < 0.05] ** 2)
    return 1e3 * float(np.sqrt(np.concatenate(squares).mean()))


def errors(normal, distance, at, face) -> tuple[float, float]:
    """Angle to a true plane, degrees, and offset from it at a place, millimetres."""
    angle = np.degrees(np.arccos(min(1.0, normal @ face[:3])))
    return angle, 1e3 * abs((normal - face[:3]) @ at + distance - face[3])


def face_of(plane, scene: Scene, truth) -> int:
    """Number of the face that most of a plane lies on, -1 for none."""
    axes = tangents(plane.normal[None])[0]
    outline = flat(plane, axes)
    left, low, right, high = outline.bounds
    x, y = np.meshgrid(np.linspace(left, right, 14), np.linspace(low, high, 14))
    inside = shapely.contains_xy(outline, x, y)
    points = np.stack([x[inside], y[inside]], axis=1) @ axes - plane.distance * plane.normal
    ahead = np.broadcast_to(-plane.normal, points.shape)
    reach, face = cast(scene.solids, points + 0.06 * plane.normal, ahead)
    on = (reach < 0.12) & (face >= 0)
    on &= truth[face, :3] @ plane.normal > np.cos(np.radians(15))
    return int(np.bincount(face[on]).argmax()) if on.sum() > len(on) / 2 else -1


def flat(plane, axes) -> shapely.Geometry:
    """Outline of a plane along two axes."""
    rings = [[ring @ axes.T for ring in part] for part in plane.outline.parts]
    return shapely.union_all([shapely.Polygon(p[0], p[1:]).buffer(0) for p in rings])


def measure_odometry(*seeds: str) -> None:
    """Relative error over a second where planes of one, two or all orientations are in sight."""
    rows = {1: [], 2: [], 99: []}
    for seed in map(int, seeds):
        frames: list[Frame] = []
        for frame in walked(kinect_room(seed, FRAMES * STEP, walk), seed):
            frames.append(frame)
            if len(frames) == 11:
                for most, into in rows.items():
                    into.append(second(frames, most))
                del frames[:-1]
    for most, into in rows.items():
        shift, turn, nees, sigma, spread = np.array(into).T
        print(
            f'{most:2d} orientations: {len(into)} s, {np.median(shift):.1f} mm, '
            f'{np.median(turn):.2f} degrees, NEES {nees.mean():.2f}, '
            f'stated {np.median(sigma):.0f} mm, {np.median(spread):.1f} degrees'
        )


def second(frames: list[Frame], most: int) -> tuple[float, ...]:
    """Error of the last frame's pose relative to the first's."""
    odometry, first, motions = PlaneOdometry(CONFIG), frames[0].pose, []
    for frame in frames:
        planes = of_orientations(frame.planes, most)
        seen = views(frame.labels, planes, CONFIG.distortion_length)
        up = first.rotation[2]
        motions.append(odometry.add(planes, seen, frame.stamp, up, edges=frame.edges))
    motion = motions[-1]
    truth = motions[0].pose.after(first.inverse()).after(frames[-1].pose)
    turn = Rotation.from_matrix(truth.rotation @ motion.pose.rotation.T).as_rotvec()
    error = np.concatenate([truth.shift - motion.pose.shift, turn])
    deviation = np.sqrt([np.trace(motion.covariance[k : k + 3, k : k + 3]) for k in (0, 3)])
    return (
        1e3 * np.linalg.norm(error[:3]),
        np.degrees(np.linalg.norm(turn)),
        error @ np.linalg.solve(motion.covariance, error) / 6,
        1e3 * deviation[0],
        np.degrees(deviation[1]),
    )


def of_orientations(planes: list, most: int) -> list:
    """Planes of so many orientations, 15 degrees apart, the largest first."""
    normals, kept = [], []
    for plane in sorted(planes, key=lambda plane: -plane.count):
        if not any(abs(n @ plane.normal) > np.cos(np.radians(15)) for n in normals):
            if len(normals) == most:
                continue
            normals.append(plane.normal)
        kept.append(plane)
    return sorted(kept, key=lambda plane: plane.label)


def measure_mount(count: str, seed: str) -> None:
    """Errors of roll, pitch and height by their deviations."""
    random, camera, rows, unsure = np.random.default_rng(int(seed)), kinect_camera(), [], 0
    unit = np.array([np.degrees(1), np.degrees(1), 1e3])
    for number in range(1000 * int(seed), 1000 * int(seed) + int(count)):
        room = kinect_room(number)
        height, pitch, roll, yaw = random.uniform((0.6, 10, -10, -20), (1.6, 45, 10, 20))
        x, y = room.poses[0].position[:2]
        ahead = np.array([np.cos(np.radians(yaw)), np.sin(np.radians(yaw))])
        at = (np.array([x, y]) + 0.1 * k * ahead for k in range(5))
        poses = tuple(Pose.looking((*place, height), yaw, pitch, roll) for place in at)
        scene = Scene(room.solids, poses, room.dark)
        sequence = SequenceSegmenter(Config(pose_noise=0.0, pose_turn_noise=0.0))
        for k in range(5):
            view = simulate(scene, Kinect(number), camera, frame=k, seed=number)
            image = RangeImage.from_depth(view.depth, camera)
            sequence.segment(image, SECOND + k * 10**8, pose=Transform.identity())
        mount = mount_of(sequence.map.planes, 5, CONFIG.role_tolerance)
        if mount is None or mount.doubts:
            unsure += 1
            continue
        truth = np.radians(roll), np.radians(pitch), height
        rows.append((np.array([mount.roll, mount.pitch, mount.height]) - truth, mount.sigma))
    error, sigma = np.moveaxis(np.array(rows), 1, 0)
    print(f'{count} cameras, {unsure} with a floor that is not sure')
    print('roll, pitch (degrees), height (mm): medians', np.median(abs(error), axis=0) * unit)
    print('stated, means', sigma.mean(axis=0) * unit)
    print('mean squares by deviation', ((error / sigma) ** 2).mean(axis=0))
    print('largest, deviations', abs(error / sigma).max())


def measure_hour(frames: str) -> None:
    """Memory and planes of the map on a walk past boxes along a corridor."""
    camera, random = kinect_camera(80, 60), np.random.default_rng(3)
    corridor = [
        half_space(normal, point)
        for normal, point in (((0, 0, 1), (0, 0, 0)), ((0, 1, 0), (0, -1.6, 0)))
    ]
    corridor.append(half_space((0, -1, 0), (0, 1.6, 0)))
    boxes = []
    for x in np.arange(2, 0.1 * int(frames) + 20, 1.7):
        size, turn = random.uniform(0.25, 0.8, 3), Rotation.from_euler('z', random.uniform(0, 1.6))
        y = random.choice([-1, 1]) * random.uniform(0.7, 1.2)
        boxes.append(box(size, turn.as_matrix(), (x, y, size[2] / 2)))
    sequence = SequenceSegmenter(Config(fixed_frame='world', min_pixels=40))
    rays, spent = camera.rays.reshape(-1, 3), 0.0
    for n in range(int(frames)):
        x = 0.1 * n
        near = boxes[max(0, int((x - 2) / 1.7) - 1) : int((x + 4) / 1.7) + 1]
        looking = 15 * np.sin(0.7 * x), 22, 2 * np.sin(x)
        pose = Pose.looking((x, 0.15 * np.sin(x), 1.2), *looking)
        depth, _ = cast([*corridor, *near], pose.position, rays @ pose.rotation.T)
        inverse = 1 / depth + random.normal(0, 0.0015, depth.shape)
        depth = np.where(inverse > 1 / 6, 1 / np.maximum(inverse, 1 / 6), 0).reshape(60, 80)
        image = RangeImage.from_depth(depth.astype(np.float32), camera)
        begin = time.thread_time()
        told = Transform(pose.rotation, pose.position)
        sequence.segment(image, SECOND + n * 10**8, pose=told)
        spent += time.thread_time() - begin
        if (n + 1) % (int(frames) // 6) == 0:
            pages = int(Path('/proc/self/statm').read_text().split()[1])
            print(
                f'{n / 600:5.1f} min: {pages * 4096 / 2**20:.0f} MB, {len(sequence.map)} planes, '
                f'{1e3 * spent / (n + 1):.1f} ms a frame'
            )


def measure_real(images: str, poses: str, camera_file: str) -> None:
    """How far the planes of single frames are from those of the map."""
    camera, config = read_camera(Path(camera_file)), Config(fixed_frame='world')
    sequence, single = SequenceSegmenter(config), []
    files = zip(sorted(Path(images).iterdir()), sorted(Path(poses).iterdir()), strict=True)
    for k, (image_file, pose_file) in enumerate(files):
        matrix = np.loadtxt(pose_file)
        left, _, right = np.linalg.svd(matrix[:3, :3])
        pose = Transform(left @ right, matrix[:3, 3])
        image = RangeImage.from_depth(read_depth(image_file), camera)
        found = sequence.segment(image, SECOND + k * SECOND // 30, pose=pose)
        large = [plane for plane in found.planes if plane.count >= 3000]
        single += [
            (pose.rotation @ p.normal, pose.rotation @ p.centroid + pose.shift) for p in large
        ]
    planes = [plane for plane in sequence.map.planes if plane.observations >= 50]
    axes = [tangents(plane.normal[None])[0] for plane in planes]
    outlines = [flat(*pair).buffer(0.05) for pair in zip(planes, axes, strict=True)]
    rows = []
    for normal, at in single:
        near = []
        for plane, along, outline in zip(planes, axes, outlines, strict=True):
            angle = np.degrees(np.arccos(min(1.0, normal @ plane.normal)))
            offset = 1e3 * abs(plane.normal @ at + plane.distance)
            if angle < 25 and offset < 100 and shapely.contains_xy(outline, *(along @ at)):
                near.append((offset, angle))
        if near:
            # Of planes one behind the other, the nearest.
            rows.append(min(near))
    print(f'{len(sequence.map)} planes; {len(rows)} of {len(single)} regions lie on one')
    print('offset (mm), angle (degrees): medians', np.median(rows, axis=0))
    print('of nine tenths', np.percentile(rows, 90, axis=0))


if __name__ == '__main__':
    if len(sys.argv) < 3 or f'measure_{sys.argv[1]}' not in globals():
        sys.exit(__doc__)
    globals()[f'measure_{sys.argv[1]}'](*sys.argv[2:])
