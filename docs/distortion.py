"""Measure what calibration does, as docs/calibration.md tells it.

python docs/distortion.py FOLDER: a recording, FOLDER/depth and FOLDER/camera.yaml, cut into two
halves; what the map of each explains of the other.

python docs/distortion.py SENSOR FRAMES: error of what is learned from that many frames of eight
rooms that SENSOR (kinect, realsense or tof) sees, against its true fixed error.
"""

import sys
from pathlib import Path

import numpy as np

from rangeseg_ros import RangeImage, Segmenter
from rangeseg_ros.core.calibration.calibrate import calibrate, without_plane
from rangeseg_ros.core.calibration.field import residuals
from rangeseg_ros.core.calibration.sightings import concatenate, find_sightings
from rangeseg_ros.io.cameras import read_camera
from rangeseg_ros.io.images import read_depth
from rangeseg_ros.simulation.fields import smooth_field
from rangeseg_ros.simulation.render import simulate
from rangeseg_ros.simulation.scenes import kinect_room, walk
from rangeseg_ros.simulation.sensors.catalogue import SENSORS
from rangeseg_ros.simulation.sensors.kinect import QUANTUM, sensor_pattern
from rangeseg_ros.simulation.sensors.sensor import resize
from rangeseg_ros.simulation.sensors.stereo import distortion
from rangeseg_ros.simulation.sensors.time_of_flight import _OFFSET

ROOMS = range(100, 108)
SENSOR_SEED = 1


def main():
    """Print what was asked for."""
    if len(sys.argv) == 2:
        halves(Path(sys.argv[1]))
    else:
        simulated(sys.argv[1], int(sys.argv[2]))


def halves(folder):
    """Residuals of cells of each half before and after the map of the other."""
    camera, segmenter = read_camera(folder / 'camera.yaml'), Segmenter()
    depths = [read_depth(path) for path in sorted((folder / 'depth').iterdir())]
    seen = [sightings(segmenter, RangeImage.from_depth(depth, camera)) for depth in depths]
    middle, maps = len(seen) // 2, []
    parts = [concatenate(seen[:middle]), concatenate(seen[middle:])]
    for name, own, other in zip(('first', 'second'), parts, parts[::-1], strict=True):
        learned = calibrate(own, camera.shape, camera).distortion
        maps.append(learned)
        v, u = (np.rint(each).astype(int) for each in pixels(other, camera))
        alone = learned.offset[v, u].astype(float)
        error = alone.copy()
        if learned.slope is not None:
            error += learned.slope[v, u] * (other.inverse - learned.reference)
        before, after, page1 = (
            rms(residuals(other, other.inverse - each)) for each in (0, error, alone)
        )
        print(f'{name} half: {before:.5f} to {after:.5f} / m, {1 - after / before:.0%} less')
        print(f'with page 1 alone to {page1:.5f} / m, {1 - page1 / before:.0%} less')
    known = (maps[0].deviation > 0) & (maps[1].deviation > 0)
    one, two = (each.offset[known] for each in maps)
    print(f'correlation of the fields {np.corrcoef(one, two)[0, 1]:.2f}')


def simulated(name, count):
    """Error of what is learned, and how it compares with the standard deviation stated."""
    true, error, ratio = errors(name, count)
    print(f'{count} frames: true {true:.5f} / m, error {error:.5f} / m')
    print(f'that is {error / true:.0%}; error / standard deviation {ratio:.2f}')


def errors(name, count):
    """Root mean squares: the true error, that of what is learned, and this by its deviation."""
    camera = SENSORS[name](SENSOR_SEED).camera
    if name == 'kinect':
        camera = resize(camera, 320, 240)
    cells = seen_by(name, camera, ROOMS, count)
    learned, inverse = calibrate(cells, camera.shape).distortion, np.median(cells.inverse)
    known = learned.deviation > 0
    field = learned.offset
    if learned.slope is not None:
        field = field + learned.slope * (inverse - learned.reference)
    true = without_plane(true_error(name, camera, inverse), known)
    off = without_plane(field.astype(float) - true, known)[known]
    return rms(true[known]), rms(off), rms(off / learned.deviation[known])


def true_error(name, camera, inverse):
    """Fixed error (H, W) of the inverse depth, 1/m."""
    if name == 'kinect':
        return QUANTUM * sensor_pattern(camera.shape, SENSOR_SEED)
    if name == 'realsense':
        return distortion(camera.shape, SENSOR_SEED)
    widths = (0.12 * camera.width, 0.12 * camera.width)
    offset = _OFFSET * smooth_field(camera.shape, widths, np.random.default_rng([SENSOR_SEED, 11]))
    return -offset * inverse**2 / np.linalg.norm(camera.rays.astype(float), axis=-1)


def seen_by(name, camera, rooms, count):
    """Planes of so many frames of walks through rooms, as a sensor sees them."""
    sensor, segmenter, seen = SENSORS[name](SENSOR_SEED), Segmenter(), []
    for seed in rooms:
        scene = kinect_room(seed, 360, walk)
        for k in np.arange(0, 360, 360 * len(rooms) / count).astype(int):
            view = simulate(scene, sensor, camera, frame=k, seed=seed)
            seen.append(sightings(segmenter, RangeImage.from_depth(view.depth, camera)))
    return concatenate(seen)


def sightings(segmenter, image):
    """Planes of one frame."""
    return find_sightings(segmenter.segment(image).labels, image)


def pixels(seen, camera):
    """Rows and columns of the middles of the cells."""
    x, y, _ = seen.ray.T
    return camera.fy * y + camera.cy, camera.fx * x + camera.cx


def rms(values):
    """Root mean square."""
    return float(np.sqrt((values**2).mean()))


if __name__ == '__main__':
    main()
