"""Measure how early a robot that drives up to hazards has them in its grid, and whether they stay.

python docs/measure_drives.py SENSOR SEED...     as of `rangeseg simulate terrain`
python docs/measure_drives.py SENSOR SEED hour   one hazard again and again, and the memory taken

The robot drives at half a metre a second from 3.6 m up to 0.4 m before a hazard, which is out of
view by then, waits for two seconds and backs off to 2 m; five frames a second. The stated up is
off by 1 degree about each axis, the height by 1 cm. Its poses err as the parameters say, or are
those of the odometry from planes and edges.
"""

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rangeseg_ros import Config, RangeImage
from rangeseg_ros.core.ground.cells import DROP, GROUND, OBSTACLE
from rangeseg_ros.core.ground.grid import GroundGrid
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.simulation.scenes import Pose
from rangeseg_ros.simulation.sensors.catalogue import SENSORS
from rangeseg_ros.simulation.sensors.sensor import Sensor
from rangeseg_ros.simulation.solids import box
from rangeseg_ros.simulation.terrain.frame import simulate_terrain
from rangeseg_ros.simulation.terrain.scene import ALL, FAR, Piece, Terrain, slab

HEIGHT, PITCH, STEP, SECOND = 0.8, 28.0, 0.1, 10**9
FLOOR, WALL = slab(-8, FAR, 0, 0, ALL), box((1, 20, 6), np.eye(3), (6, 0, 0))
# Edges and corners to tell the motion by: a corridor with doors in its walls.
DOORS = [
    box((0.8, 0.2, 4), np.eye(3), (x, side * 1.6, 0))
    for x in (-3, -1.2, 0.6, 2.4)
    for side in (-1, 1)
]
SURROUNDINGS = [Piece(solid, OBSTACLE, 3.0) for solid in (WALL, *DOORS)]
NEAR = Piece(slab(-8, 0, 0, 0, ALL), GROUND)


def beyond(level: float, kind: int) -> list[Piece]:
    """A floor that goes on higher or lower."""
    return [NEAR, Piece(slab(0, FAR, level, level, ALL), kind, abs(level))]


def stairs(rise: float, kind: int) -> list[Piece]:
    """Five treads."""
    treads = [
        slab(0.28 * k, 0.28 * (k + 1) if k < 4 else FAR, rise * (k + 1), rise * (k + 1), ALL)
        for k in range(5)
    ]
    sizes = [abs(rise) * (k + 1) for k in range(5)]
    return [NEAR, *(Piece(tread, kind, size) for tread, size in zip(treads, sizes, strict=True))]


HAZARDS = {
    'edge, 10 cm down': beyond(-0.1, DROP),
    'edge, 50 cm down': beyond(-0.5, DROP),
    'stairs down': stairs(-0.17, DROP),
    'kerb, 8 cm up': beyond(0.08, OBSTACLE),
    'kerb, 15 cm up': beyond(0.15, OBSTACLE),
    'stairs up': stairs(0.17, OBSTACLE),
    'box of 10 cm': [
        Piece(FLOOR, GROUND),
        Piece(box((0.3, 1.2, 0.1), np.eye(3), (0.15, 0, 0.05)), OBSTACLE, 0.1),
    ],
}  # fmt: skip


def driven(seed: int) -> Iterator[Pose]:
    """Where the camera is: up to the hazard at x = 0, waiting, and back."""
    ahead = np.arange(-3.6, -0.4 + 1e-9, STEP)
    places = [*ahead, *[ahead[-1]] * 10, *np.arange(-0.4, -2.0, -STEP)]
    draw = np.random.default_rng(seed)
    yaw, side = draw.uniform(-15, 15), draw.uniform(-0.2, 0.2)
    for x in places:
        nod, roll = draw.normal(0, 0.2, 2)
        yield Pose.looking((x, side, HEIGHT), yaw, PITCH + nod, roll)


def drive(
    pieces: list[Piece], sensor: Sensor, seed: int, odometry: bool
) -> tuple[list[np.ndarray], list[float]]:
    """Of every frame: x, the shares of the hazard that are danger and ground, and of the floor.

    And milliseconds.
    """
    draw = np.random.default_rng([seed, 1])
    config = Config(
        sensor_height=HEIGHT + 0.01, odometry=odometry, fixed_frame='' if odometry else 'map'
    )
    sequence, rows, spent = SequenceSegmenter(config), [], []
    mounted = Rotation.from_euler('xyz', [1, -1, 1], degrees=True)
    home: Transform | None = None
    for k, pose in enumerate(driven(seed)):
        scene = Terrain('', [*pieces, *SURROUNDINGS], (FLOOR,), pose)
        frame = simulate_terrain(scene, sensor, seed=1000 * seed + k)
        image, true = (
            RangeImage.from_depth(frame.depth, sensor.camera),
            Transform(pose.rotation, pose.position),
        )
        error = draw.normal(
            0, [*3 * [np.radians(config.pose_turn_noise)], *3 * [config.pose_noise]]
        )
        begun = time.process_time()
        found = sequence.segment(
            image,
            SECOND + k * SECOND // 5,
            mounted.apply(scene.up),
            None if odometry else true.by(error),
        )
        grid = found.grid
        spent.append(1e3 * (time.process_time() - begun))
        if home is None:
            home = true.after(sequence.pose.inverse()) if odometry else Transform.identity()
        rows.append(np.array([pose.position[0], *told(grid, home, pose.position[1])]))
    return rows, spent


def told(grid: GroundGrid, home: Transform, side: float) -> list[float]:
    """Shares of a hazard at x = 0 that are danger and ground, and of the floor that is ground."""
    count = len(grid.classes)
    middles = (np.stack(np.meshgrid(*2 * [np.arange(count)]), axis=-1) + 0.5) * grid.resolution
    flat = np.append(middles.reshape(-1, 2), np.zeros((count**2, 1)), axis=1) + grid.origin
    x, y, _ = home.apply(flat).T
    # Cells that do not touch the border, nor the end of what is told of it.
    across, classes = np.abs(y - side) < 0.4, grid.classes.ravel()
    hazard, floor = across & (x > 0.1) & (x < 0.3), across & (x < -0.1) & (x > -1.0)
    return [
        np.isin(classes[hazard], (DROP, OBSTACLE)).mean(),
        (classes[hazard] == GROUND).mean(),
        (classes[floor] == GROUND).mean(),
    ]


def hour(sensor: Sensor, seed: int) -> None:
    """Drive to and fro before an edge, with stated poses that err anew in every image."""
    there = [*driven(seed)]
    poses, images = [*there, *there[20::-1]], []
    for k, pose in enumerate(poses):
        scene = Terrain('', [*HAZARDS['edge, 10 cm down'], *SURROUNDINGS], (FLOOR,), pose)
        images.append((simulate_terrain(scene, sensor, seed=1000 * seed + k).depth, scene.up))
    config = Config(sensor_height=HEIGHT + 0.01, fixed_frame='map')
    draw, sequence, rows = np.random.default_rng([seed, 1]), SequenceSegmenter(config), []
    mounted = Rotation.from_euler('xyz', [1, -1, 1], degrees=True)
    sigma = [*3 * [np.radians(config.pose_turn_noise)], *3 * [config.pose_noise]]
    for k in range(300 * 60):
        pose, (depth, up) = poses[k % len(poses)], images[k % len(poses)]
        at = Transform(pose.rotation, pose.position).by(draw.normal(0, sigma))
        begun, image = time.process_time(), RangeImage.from_depth(depth, sensor.camera)
        found = sequence.segment(image, SECOND + k * SECOND // 5, mounted.apply(up), at)
        spent = 1e3 * (time.process_time() - begun)
        # All of the edge is in the grid from here on.
        if pose.position[0] > -2:
            shares = told(found.grid, Transform.identity(), pose.position[1])
            rows.append((spent, *shares))
        if k % 1500 == 1499:
            resident = int(Path('/proc/self/statm').read_text().split()[1]) * 4096 / 2**20
            times, danger, called, floor = np.array(rows).T
            print(
                f'minute {k // 300 + 1}: {resident:.0f} MiB, {np.median(times):.0f} ms a frame, '
                f'edge lost in {(danger < 0.5).sum()} of {len(rows)} frames, at most '
                f'{called.max():.1%} of it ground, {floor.mean():.1%} of the floor kept',
                flush=True,
            )
            rows.clear()


def main(sensor: str, *seeds: str) -> None:
    """Print a table."""
    print('| hazard | poses | first seen, m | frames lost | hazard called ground | floor kept |')
    print('|---|---|---|---|---|---|')
    times = []
    for name, pieces in HAZARDS.items():
        for odometry in (False, True):
            first, lost, ground, kept = [], 0, [], []
            for seed in map(int, seeds):
                rows, spent = drive(pieces, SENSORS[sensor](seed), seed, odometry)
                times += spent[2:]
                x, danger, called, floor = np.array(rows).T
                seen = danger >= 0.5
                begin = int(seen.argmax()) if seen.any() else len(seen)
                first.append(-x[begin] if seen.any() else 0.0)
                lost += int((~seen[begin:]).sum())
                ground.append(called.max())
                kept.append(floor[-1])
            print(
                f'| {name} | {"odometry" if odometry else "stated"} | {np.median(first):.1f} '
                f'({min(first):.1f}) | {lost} | {max(ground):.1%} | {np.mean(kept):.1%} |',
                flush=True,
            )  # fmt: skip
    print(f'{np.median(times):.0f} ms of processor a frame')


if __name__ == '__main__':
    if sys.argv[-1] == 'hour':
        hour(SENSORS[sys.argv[1]](int(sys.argv[2])), int(sys.argv[2]))
    else:
        main(*sys.argv[1:])
