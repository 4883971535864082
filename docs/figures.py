"""Draw the figures of the documents: python docs/figures.py [FOLDER], docs/ by default.

docs/terrain.png: depth, planes, and what they are to a robot.
docs/normals.png: jump edges, and the normals that both methods reconstruct.
docs/figures/planes.png, uncertainty.png: a Kinect's frame of a room and a stereo camera's.
docs/figures/distortion.png: fixed pattern of a simulated Kinect, what is learned, what is left.
docs/figures/map.png: the map of a walk through a room, from above and from a side.

python docs/figures.py --detection DETECTION.json PICTURE.png: what `rangeseg evaluate --json` says
of test pieces.

python docs/figures.py --comparison DEPTH CAMERA.yaml PICTURE.png PEAC.png: a frame, and the planes
of RANSAC, of PEAC as labels of 16 bits, which pip does not install, and of this package.
docs/comparison.png is of the third depth image of ch5/rgbd of
https://github.com/gaoxiang12/slambook2 (MIT licence), PEAC with windows of 5, support 1000.
"""

import json
import sys
from pathlib import Path

import benchmark
import cv2
import distortion as calibration
import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rangeseg_ros import Config, RangeImage, Segmenter, SequenceSegmenter, Transform
from rangeseg_ros.core.calibration.calibrate import calibrate, without_plane
from rangeseg_ros.drawing import colours, grey, overlay
from rangeseg_ros.evaluation.label_files import read_label_image
from rangeseg_ros.io.cameras import read_camera
from rangeseg_ros.io.images import read_depth, write_image
from rangeseg_ros.simulation.render import simulate
from rangeseg_ros.simulation.scenes import Scene, kinect_room, walk
from rangeseg_ros.simulation.sensors.catalogue import SENSORS
from rangeseg_ros.simulation.sensors.kinect import QUANTUM, Kinect, kinect_camera, sensor_pattern
from rangeseg_ros.simulation.terrain.frame import simulate_terrain
from rangeseg_ros.simulation.terrain.kinds import stated, terrain_scene

ROOT = Path(__file__).parents[1]
WIDTH = 360
METHODS = 'normals', 'planes'


def main():
    """Draw everything."""
    if sys.argv[1:2] == ['--detection']:
        found, picture = map(Path, sys.argv[2:])
        write_image(picture, detection(json.loads(found.read_text())['detection']))
        return
    if sys.argv[1:2] == ['--comparison']:
        depth, camera, picture, peac = map(Path, sys.argv[2:])
        image = RangeImage.from_depth(read_depth(depth), read_camera(camera))
        write_image(picture, comparison(image, read_label_image(peac)))
        return
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else ROOT / 'docs')
    kinect, stereo = frame('kinect', 8, 1), frame('realsense', 3, 1)
    robots = [terrain('hole', 2), terrain('stairs up', 2)]
    write_image(folder / 'terrain.png', np.vstack(robots))
    write_image(folder / 'normals.png', normals(kinect))
    results = [Segmenter(Config()).segment(image) for image in (kinect, stereo)]
    for name, picture in (('planes', in_colour), ('uncertainty', uncertainty)):
        pair = [fitted(picture(result)) for result in results]
        write_image(folder / 'figures' / f'{name}.png', np.hstack(pair))
    write_image(folder / 'figures' / 'distortion.png', distortion())
    write_image(folder / 'figures' / 'map.png', room_map(scene=8, seed=1))


def detection(rows):
    """In how many scenes each test piece is found (colour), and how much of it in the worst."""
    kinds = list(dict.fromkeys(row['kind'] for row in rows))
    figure = Figure(figsize=(9, 2.2), dpi=120, layout='constrained')
    for axes, kind in zip(figure.subplots(1, len(kinds)), kinds, strict=True):
        cells = [row for row in rows if row['kind'] == kind]
        sizes, places = (sorted({row[name] for row in cells}) for name in ('size', 'distance'))
        shares = np.full((len(sizes), len(places)), np.nan)
        for row in cells:
            if row['scenes']:
                place = sizes.index(row['size']), places.index(row['distance'])
                shares[place] = row['detected'] / row['scenes']
                worst = row['worst'].split()[-1]
                axes.text(*place[::-1], worst, ha='center', va='center', fontsize=8)
        axes.imshow(
            shares, cmap='RdYlGn', vmin=0, vmax=1, origin='lower', aspect='auto', alpha=0.7
        )
        axes.set_xticks(range(len(places)), [f'{place:g} m' for place in places])
        unit = '\u00b0' if kind == 'ramp' else ' m'
        axes.set_yticks(range(len(sizes)), [f'{size:g}{unit}' for size in sizes])
        axes.tick_params(labelsize=7)
        axes.set_title(kind, fontsize=9)
    return drawn(figure)


def drawn(figure):
    """Picture of a figure."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3]


def comparison(image, peac):
    """Depth and RANSAC above, PEAC and this package below."""
    seen = np.where(image.valid, image.points[..., 2], 0), image.camera
    pictures = [titled(in_grey(image), 'depth')]
    for title, labels in (
        ('sequential RANSAC', benchmark.ransac(*seen)),
        ('PEAC', peac),
        ('rangeseg_ros', benchmark.planes(*seen)),
    ):
        pictures.append(titled(coloured(image, labels), title))
    return np.vstack([np.hstack(pictures[:2]), np.hstack(pictures[2:])])


def titled(picture, title):
    """The picture at the common size, with its title in the lower right corner."""
    picture, font = fitted(picture), cv2.FONT_HERSHEY_SIMPLEX
    (width, height), below = cv2.getTextSize(title, font, 0.5, 1)
    left, bottom = WIDTH - width - 12, picture.shape[0] - below - 4
    picture[bottom - height - 4 :, left - 4 :] = 0
    cv2.putText(picture, title, (left, bottom), font, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return picture


def coloured(image, labels):
    """Labels over the depth, the largest region first in the order of colours."""
    counts = np.bincount(labels.ravel())
    counts[0] = labels.size
    rank = np.empty(len(counts), np.uint16)
    rank[np.argsort(-counts, kind='stable')] = np.arange(len(counts))
    labels = rank[labels]
    tinted = cv2.addWeighted(in_grey(image), 0.45, colours(labels), 0.55, 0)
    return np.where((labels > 0)[..., None], tinted, in_grey(image))


def in_colour(result):
    """Planes in colour over the depth."""
    return overlay(result.image.inverse, result.labels, result.planes)


def normals_picture(normals):
    """Unit normals (H, W, 3) in colours: red to the right, green up, blue to the sensor."""
    colour = 127.5 * (1 + np.nan_to_num(normals) * np.array([1, -1, -1]))
    colour[np.isnan(normals[..., 0])] = 0
    return np.clip(np.rint(colour), 0, 255).astype(np.uint8)


def normals(image):
    """Jump edges, and the normals of methods normals and planes."""
    results = [Segmenter(Config(method=name)).segment(image) for name in METHODS]
    edges = np.repeat(255 * results[0].edges.astype(np.uint8)[..., None], 3, axis=2)
    pictures = [edges, *(normals_picture(result.normals) for result in results)]
    return np.hstack([fitted(one) for one in pictures])


def distortion():
    """Error of the inverse depth, blue to red for -0.004 to 0.004 / m: true, learned, left."""
    camera = kinect_camera(320, 240)
    cells = calibration.seen_by('kinect', camera, range(4), 40)
    learned = calibrate(cells, camera.shape, camera).distortion.offset
    known = learned != 0
    true = without_plane(QUANTUM * sensor_pattern(camera.shape, calibration.SENSOR_SEED), known)
    pictures = []
    for field in (true, learned, true - learned):
        shown = 255 * colormaps['RdBu_r'](np.clip(field / 0.008 + 0.5, 0, 1))[..., :3]
        pictures.append(fitted(np.where(known[..., None], shown, 128).astype(np.uint8)))
    return np.hstack(pictures)


def terrain(kind, seed):
    """A Kinect on a robot: depth, planes, and ground green, obstacles red, drops blue."""
    image, result = on_robot(kind, seed)
    planes = overlay(image.inverse, result.labels, result.planes)
    return np.hstack([fitted(p) for p in (in_grey(image), planes, classes(image, result))])


def on_robot(kind, seed):
    """Range image of a terrain, and what is found in it."""
    scene, sensor = terrain_scene(kind, seed), SENSORS['kinect'](seed)
    up, height = stated(scene, seed)
    config = Config(up_x=up[0], up_y=up[1], up_z=up[2], sensor_height=height)
    seen = simulate_terrain(scene, sensor, seed=seed)
    image = RangeImage.from_depth(seen.depth, sensor.camera)
    return image, Segmenter(config).segment(image)


def classes(image, result):
    """Ground green, obstacles red, drops blue, over the depth."""
    colour = np.array([[0, 0, 0], [0, 150, 0], [220, 0, 0], [40, 80, 255]], np.uint8)
    base = in_grey(image)
    tinted = cv2.addWeighted(base, 0.45, colour[result.terrain], 0.55, 0)
    return np.where((result.terrain > 0)[..., None], tinted, base)


def room_map(scene, seed):
    """Every eighth frame of a walk of eight seconds, as one map."""
    room, camera = kinect_room(scene), kinect_camera(640, 480)
    poses = walk(room.poses[0], seed, 240)
    up = poses[0].rotation.T @ (0, 0, 1)
    sequence = SequenceSegmenter(Config(up_x=up[0], up_y=up[1], up_z=up[2]))
    for k in range(0, len(poses), 8):
        view = simulate(
            Scene(room.solids, poses, room.dark), Kinect(0), camera, frame=k, seed=scene
        )
        image = RangeImage.from_depth(view.depth, camera)
        pose = Transform(poses[k].rotation, poses[k].position)
        sequence.segment(image, k * 10**9 // 30, poses[k].rotation.T @ (0, 0, 1), pose)
    figure = Figure(figsize=(9, 4), layout='constrained')
    # From above, and from a side: what is nearer covers the rest, what faces away is left out.
    for axes, (x, y, depth) in zip(figure.subplots(1, 2), ((0, 1, 2), (0, 2, 1)), strict=True):
        facing = [plane for plane in sequence.map.planes if plane.normal[depth] > 0]
        for plane in sorted(facing, key=lambda plane: plane.centroid[depth]):
            for ring, *_ in plane.outline.parts:
                axes.fill(ring[:, x], ring[:, y], color=colours([plane.id])[0] / 255)
        axes.set_aspect('equal')
        axes.grid()
    return drawn(figure)


def frame(sensor, scene, seed):
    """Range image of a room."""
    seen = simulate(kinect_room(scene, seed), SENSORS[sensor](seed), seed=scene)
    return RangeImage.from_depth(seen.depth, seen.camera)


def in_grey(image):
    """Near is bright, nothing measured is black."""
    return cv2.cvtColor(grey(image.inverse), cv2.COLOR_GRAY2RGB)


def uncertainty(result):
    """Standard deviation of each plane where it is seen, dark for 0 to yellow for 20 mm."""
    image = result.image
    deviation = np.zeros(image.shape)
    for plane in result.planes:
        here = result.labels == plane.label
        points = np.append(image.points[here], np.ones((here.sum(), 1)), axis=1)
        deviation[here] = np.sqrt(np.einsum('ni,ij,nj->n', points, plane.covariance, points))
    shown = colormaps['inferno'](np.clip(deviation / 0.02, 0, 1))[..., :3]
    return np.where((result.labels > 0)[..., None], 255 * shown, in_grey(image)).astype(np.uint8)


def fitted(picture):
    """The picture at the width, and 3/4 of that high, that all have."""
    size = WIDTH, WIDTH * 3 // 4
    return cv2.resize(np.ascontiguousarray(picture), size, interpolation=cv2.INTER_AREA)


if __name__ == '__main__':
    main()
