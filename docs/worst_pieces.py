"""Look for the places at which test pieces are found worst.

python docs/worst_pieces.py [--sensor NAME] [--mount METRES] [--looks COUNT] [--seed SEED]

Places across the view and ahead, directions of the camera, and errors of what is stated: a third
of the looks at random, then changes of the worst one so far. Worst is where most of a piece is
called ground, then where least of it is found. Ramps that are ground are to be found as such.
"""

import argparse

import cv2
import numpy as np

from rangeseg_ros import Config, RangeImage, Segmenter
from rangeseg_ros.core.ground.cells import DROP, GROUND, OBSTACLE
from rangeseg_ros.evaluation.detection import FEWEST
from rangeseg_ros.evaluation.terrain import MARGIN, REACH
from rangeseg_ros.simulation.sensors.catalogue import SENSORS
from rangeseg_ros.simulation.terrain.frame import simulate_terrain
from rangeseg_ros.simulation.terrain.kinds import stated
from rangeseg_ros.simulation.terrain.testpieces import DISTANCES, catalogue, piece_scene

# Numbers that a scene draws: roll, pitch, distance, place across, direction.
DRAWN = 5


class Steered:
    """A random generator whose uniform numbers, of 0...1, are given."""

    def __init__(self, numbers: np.ndarray) -> None:
        self._numbers = iter(numbers)

    def uniform(self, low: float, high: float) -> float:
        """The next one."""
        return low + (high - low) * next(self._numbers)


def look(piece: tuple, numbers: np.ndarray, seed: int, sensor: str, mount: float) -> tuple:
    """Share of a piece that is called ground, and that found; () where it is not in sight."""
    scene = piece_scene(*piece, mount, seed, Steered(numbers))
    device = SENSORS[sensor](seed)
    frame = simulate_terrain(scene, device, None, seed)
    up, height = stated(scene, seed)
    ways = dict(zip(('up_x', 'up_y', 'up_z'), map(float, up), strict=True))
    image = RangeImage.from_depth(frame.depth, device.camera)
    found = Segmenter(Config(**ways, sensor_height=height)).segment(image).terrain
    flat = piece[0] == 'ramp' and not np.isin(frame.terrain, (OBSTACLE, DROP)).any()
    metres = np.where(frame.terrain == DROP, frame.crossing, frame.depth / 1000)
    kernel = np.ones((2 * MARGIN + 1, 2 * MARGIN + 1), np.uint8)
    judged = cv2.erode(frame.terrain, kernel) == cv2.dilate(frame.terrain, kernel)
    judged &= (frame.terrain > 0) & (metres <= REACH.get(sensor, 3.5))
    own = judged & np.isin(frame.terrain, (GROUND,) if flat else (OBSTACLE, DROP))
    if own.sum() < FEWEST:
        return ()
    danger = 0.0 if flat else float((found[own] == GROUND).mean())
    return danger, float((found[own] == frame.terrain[own]).mean())


def search(piece: tuple, looks: int, seed: int, sensor: str, mount: float) -> tuple:
    """The worst of so many looks at a piece; () where none has it in sight."""
    random, worst, at = np.random.default_rng(seed), (), None
    for count in range(looks):
        numbers, drawn = random.random(DRAWN), int(random.integers(2**31))
        if at is not None and 3 * count >= looks:
            # The errors and the noise stay in every second look.
            numbers = np.clip(at[0] + random.normal(0, 0.15, DRAWN), 0, 1)
            drawn = at[1] if count % 2 else drawn
        seen = look(piece, numbers, drawn, sensor, mount)
        if seen and (not worst or (-seen[0], seen[1]) < (-worst[0], worst[1])):
            worst, at = seen, (numbers, drawn)
    return worst


def main() -> None:
    """Print a row for each kind and size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--sensor', choices=[*SENSORS], default='kinect')
    parser.add_argument('--mount', type=float, default=0.5)
    parser.add_argument('--looks', type=int, default=30)
    parser.add_argument('--seed', type=int, default=0)
    given = parser.parse_args()
    print('| piece | size |', ' | '.join(f'{d:g} m' for d in DISTANCES), '|', flush=True)
    rows: dict[tuple, list[str]] = {}
    for piece in catalogue():
        worst = search(piece, given.looks, given.seed, given.sensor, given.mount)
        cell = f'{worst[1]:.2f} ({worst[0]:.2f})' if worst else '-'
        rows.setdefault(piece[:2], []).append(cell)
        if len(rows[piece[:2]]) == len(DISTANCES):
            print(f'| {piece[0]} | {piece[1]:g} |', ' | '.join(rows[piece[:2]]), '|', flush=True)


if __name__ == '__main__':
    main()
