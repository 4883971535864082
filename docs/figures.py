"""Draw the figures of the documents: python docs/figures.py [FOLDER], docs/ by default.

docs/terrain.png, the picture in the README: depth, planes, and what they are to a robot.
docs/normals.png: observed normals, jump edges, and the normals that both methods reconstruct.
docs/figures/distortion.png: the fixed pattern of a simulated Kinect, what is learned of it, and
what is left.
docs/figures/ground.png: what pixels are to a robot, and their height above the ground.
docs/figures/map.png: the map of a walk through a room, from above and from a side.
The other docs/figures/*.png, one picture for each stage of method `planes`: of a Kinect's frame of
a room and, on the right, of a stereo camera's.
"""

import sys
from pathlib import Path

import cv2
import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rangeseg_ros import Config, RangeImage, Segmenter
from rangeseg_ros.core.by_normals.normals import observed_normals
from rangeseg_ros.core.by_planes import method
from rangeseg_ros.core.by_planes.blocks import Nodes, block_size
from rangeseg_ros.core.by_planes.surfaces import Patches, join_surfaces
from rangeseg_ros.core.calibration.calibrate import calibrate
from rangeseg_ros.core.calibration.sightings import concatenate, find_sightings
from rangeseg_ros.core.calibration.validation import without_plane
from rangeseg_ros.core.fitting.noise import measured_sensor
from rangeseg_ros.core.fitting.steps import jump_steps
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.regions import least_pixels, plane_regions
from rangeseg_ros.core.sensing.blocks import Blocks
from rangeseg_ros.core.sensing.bridges import bridge_holes
from rangeseg_ros.core.sensing.grid import weights
from rangeseg_ros.core.sensing.jump_edges import jump_edges
from rangeseg_ros.core.sensing.moments import COUNT
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance
from rangeseg_ros.core.sensing.view import View
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.drawing import colours, grey, normals_picture, overlay
from rangeseg_ros.io.images import write_image
from rangeseg_ros.io.params import read_config
from rangeseg_ros.simulation.kinect import simulate_kinect
from rangeseg_ros.simulation.render import simulate
from rangeseg_ros.simulation.scenes import Scene, kinect_room, walk
from rangeseg_ros.simulation.sensors.catalogue import SENSORS
from rangeseg_ros.simulation.sensors.kinect import QUANTUM, kinect_camera, sensor_pattern
from rangeseg_ros.simulation.terrain.frame import simulate_terrain
from rangeseg_ros.simulation.terrain.kinds import stated, terrain_scene

ROOT = Path(__file__).parents[1]
WIDTH = 360
METHODS = 'normals', 'planes'


def main():
    """Draw everything."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else ROOT / 'docs')
    robots = [terrain('hole', 2), terrain('stairs up', 2)]
    write_image(folder / 'terrain.png', np.vstack(robots))
    write_image(folder / 'normals.png', normals(frame('kinect', 8, 1)))
    frames = [(frame('kinect', 8, 1), Config()), (frame('realsense', 3, 1), settings('realsense'))]
    both = [stages(*each) for each in frames]
    for name in both[0]:
        pair = [fitted(pictures[name]) for pictures in both]
        write_image(folder / 'figures' / f'{name}.png', np.hstack(pair))
    write_image(folder / 'figures' / 'distortion.png', distortion(sensor_seed=1))
    write_image(folder / 'figures' / 'ground.png', heights('clutter', 1))
    write_image(folder / 'figures' / 'map.png', room_map(scene=8, seed=1))


def distortion(sensor_seed):
    """Error of the inverse depth, blue to red for -0.004 to 0.004 / m: true, learned, left."""
    camera, segmenter, seen = kinect_camera(320, 240), Segmenter(), []
    for seed in range(4):
        room = kinect_room(seed)
        scene = Scene(room.solids, walk(room.poses[0], seed, 360), room.dark)
        for k in range(0, 360, 36):
            view = simulate_kinect(scene, camera, frame=k, seed=seed, sensor_seed=sensor_seed)
            image = RangeImage.from_depth(view.depth, camera)
            seen.append(find_sightings(segmenter.segment(image).labels, image))
    learned = calibrate(concatenate(seen), camera.shape, camera).distortion.offset
    known = learned != 0
    true = without_plane(QUANTUM * sensor_pattern(camera.shape, sensor_seed), known)
    pictures = []
    for field in (true, learned, true - learned):
        shown = 255 * colormaps['RdBu_r'](np.clip(field / 0.008 + 0.5, 0, 1))[..., :3]
        pictures.append(fitted(np.where(known[..., None], shown, 128).astype(np.uint8)))
    return np.hstack(pictures)


def normals(image):
    """Observed normals and jump edges above, those of method normals and planes below."""
    config = Config(method='normals')
    results = [Segmenter(Config(method=name)).segment(image) for name in METHODS]
    observed = observed_normals(image, weights(image, results[0].jumps), config)
    edges = np.repeat(255 * results[0].edges.astype(np.uint8)[..., None], 3, axis=2)
    above = [normals_picture(observed), edges]
    below = [normals_picture(result.normals) for result in results]
    return np.vstack([np.hstack([fitted(one) for one in row]) for row in (above, below)])


def terrain(kind, seed):
    """A Kinect on a robot: depth, planes, and ground green, obstacles red, drops blue."""
    image, result = on_robot(kind, seed)
    planes = overlay(image.inverse, result.labels, result.planes)
    return np.hstack([fitted(p) for p in (in_grey(image), planes, classes(image, result))])


def heights(kind, seed):
    """A Kinect on a robot: ground, obstacles, drops; heights from -0.5 m, dark, to 1.5 m."""
    image, result = on_robot(kind, seed)
    shown = 255 * colormaps['viridis'](np.clip((result.height + 0.5) / 2, 0, 1))[..., :3]
    shown = np.where(np.isfinite(result.height)[..., None], shown, 0).astype(np.uint8)
    return np.hstack([fitted(classes(image, result)), fitted(shown)])


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
        view = simulate_kinect(Scene(room.solids, poses, room.dark), camera, frame=k, seed=scene)
        image = RangeImage.from_depth(view.depth, camera)
        pose = Transform(poses[k].rotation, poses[k].position)
        sequence.segment(image, k * 10**9 // 30, poses[k].rotation.T @ (0, 0, 1), pose)
    figure = Figure(figsize=(9, 4), layout='constrained')
    canvas = FigureCanvasAgg(figure)
    # From above, and from a side: what is nearer covers the rest, what faces away is left out.
    for axes, (x, y, depth) in zip(figure.subplots(1, 2), ((0, 1, 2), (0, 2, 1)), strict=True):
        facing = [plane for plane in sequence.map.planes if plane.normal[depth] > 0]
        for plane in sorted(facing, key=lambda plane: plane.centroid[depth]):
            for ring, *_ in plane.outline.parts:
                axes.fill(ring[:, x], ring[:, y], color=colours([plane.id])[0] / 255)
        axes.set_aspect('equal')
        axes.grid()
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3]


def frame(sensor, scene, seed):
    """Range image of a room."""
    seen = simulate(kinect_room(scene, seed), SENSORS[sensor](seed), seed=scene)
    return RangeImage.from_depth(seen.depth, seen.camera)


def settings(name):
    """Parameters for a sensor, the defaults where it has no file."""
    path = ROOT / 'params' / f'{name}.yaml'
    return read_config(path) if path.exists() else Config()


def stages(image, config):
    """Pictures (H, W, 3) of what each stage has found, in their order."""
    pictures = {'depth': in_grey(image)}
    fine = Blocks.of(image)
    stated = SensorModel.from_config(config)
    sensor = measured_sensor(image, fine, stated)
    steps = jump_steps(fine, sensor)
    bridges = bridge_holes(image, steps.windows, steps.slopes)
    told = steps.windows, steps.slopes, steps.pixels
    jumps = jump_edges(bridges, config.jump_edges, *told)
    grid = weights(bridges, jumps, config.weighting)
    pictures['edges'] = with_edges(image, jumps)

    size, least = block_size(image.shape), least_pixels(config.min_pixels, image.shape)
    blocks = fine if size == 4 else fine.merged(image.rays, size)
    nodes = Nodes.of(bridges.inverse, grid, blocks, sensor, size)
    whole = nodes.moments[..., COUNT] > 0
    count = np.maximum(blocks.moments[..., COUNT] - 3, 1)[whole]
    shown = np.sqrt(blocks.squared[whole]), blocks.residual[whole] / count
    pictures['noise'] = noise_chart(*shown, stated, sensor)
    pictures['blocks'] = over(image, whole.astype(np.intp), size)

    patches = Patches.of(nodes, size, sensor)
    pictures['patches'] = over(image, patches.labels, size)
    surface, _ = join_surfaces(patches, nodes, size, sensor, config.plane_smoothness, least)
    pictures['surfaces'] = over(image, surface, size)

    view = View(image, bridges, fine, grid, sensor, least)
    labelling = method.segment(view, config, 1.0, lambda stage: None)
    labels = labelling.labels
    pictures['labels'] = overlay(image.inverse, labels * image.valid)
    regions = plane_regions(labels, labels > 0, view.grid, config.noise_regions, view.least)
    regions, *_ = method.flat_regions(
        regions, view, config.plane_smoothness, config.plane_probability, config.plane_prior
    )
    pictures['regions'] = overlay(image.inverse, regions * image.valid)
    result = Segmenter(config).segment(image)
    pictures['planes'] = overlay(image.inverse, result.labels, result.planes)
    pictures['uncertainty'] = uncertainty(image, result)
    return pictures


def in_grey(image):
    """Near is bright, nothing measured is black."""
    return cv2.cvtColor(grey(image.inverse), cv2.COLOR_GRAY2RGB)


def with_edges(image, jumps):
    """Jump edges in red."""
    picture = in_grey(image)
    edges = np.zeros(image.shape, bool)
    edges[:, 1:] |= jumps[0]
    edges[1:] |= jumps[1]
    picture[edges] = 255, 60, 30
    return picture


def of_all(numbers, size, image):
    """Numbers of the pixels of an image from those of squares so large."""
    pixels = numbers.repeat(size, 0).repeat(size, 1)[: image.shape[0], : image.shape[1]]
    return pixels.astype(np.uint16)


def over(image, numbers, size):
    """Colour blocks by their numbers (rows, columns), 0 for none."""
    pixels = of_all(numbers, size, image)
    base = in_grey(image)
    picture = cv2.addWeighted(base, 0.45, colours(pixels), 0.55, 0)
    return np.where((pixels > 0)[..., None], picture, base)


def noise_chart(inverse, residual, stated, sensor):
    """Standard deviation in blocks against the inverse range, and the two models of it."""
    figure = Figure(figsize=(6, 4.5), dpi=100, layout='constrained')
    axes = figure.subplots()
    axes.plot(inverse, 1000 * np.sqrt(residual), '.', markersize=1, color='0.7', rasterized=True)
    x = np.linspace(0, inverse.max(), 100)
    for model, style, label in ((stated, '--', 'stated'), (sensor, '-', 'measured')):
        axes.plot(x, 1000 * np.sqrt(random_variance(model, x**2)), style, label=label)
    axes.set(xlabel='inverse depth, 1/m', ylabel='residuals of blocks, 0.001/m', xlim=(0, None))
    axes.set_ylim(0, 4000 * np.sqrt(np.median(residual)))
    axes.legend(loc='upper left')
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def uncertainty(image, result):
    """Standard deviation of each plane where it is seen, dark for 0 to yellow for 20 mm."""
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
