"""Images at the limits of indices: sizes, holes, values; what a segmentation makes of each.

As a program it prints a line for each: its name, and a digest of all results or the error.
"""

import hashlib
import sys

import numpy as np

from rangeseg_ros import Camera, Config, RangeImage
from rangeseg_ros.core.sequence import SequenceSegmenter

SHAPES = [(1, 1), (1, 2), (2, 1), (1, 97), (97, 1), (2, 2), (3, 3), (5, 64), (64, 5), (17, 33)]
SHAPES += [(48, 64), (49, 65)]


def depths(shape):
    """Depth images (H, W) in metres by their names."""
    random = np.random.default_rng(shape[0] * 1000 + shape[1])
    v, u = np.indices(shape, float)
    planes = np.where(u > v, 1 + 0.01 * u, 2 - 0.01 * v)
    noisy = planes + random.normal(0, 0.003, shape)
    holes = np.where(random.random(shape) < 0.4, np.nan, noisy)
    one = np.full(shape, np.nan)
    one[shape[0] // 2, shape[1] // 2] = 1
    stairs = 1 + 0.2 * (v // 4)
    return {
        'nothing': np.full(shape, np.nan),
        'zeros': np.zeros(shape),
        'constant': np.ones(shape),
        'one pixel': one,
        'last pixel': np.where((v == shape[0] - 1) & (u == shape[1] - 1), 1.0, np.nan),
        'border': np.where((v % max(shape[0] - 1, 1) == 0), 1.0, np.nan),
        'chequered': np.where((u + v) % 2, 1.0, 5.0),
        'lines': np.where(v % 2, 1.0, np.nan),
        'noise': random.uniform(0.1, 10, shape),
        'planes': planes,
        'noisy': noisy,
        'holes': holes,
        'stairs': stairs,
        'infinite': np.where(u % 3 == 0, np.inf, noisy),
        'near and far': np.where(u > v, 1e-6, 1e6),
        'negative': -noisy,
    }


def images(shape):
    """Range images by their names: of a camera, and the same as clouds."""
    height, width = shape
    focal = max(height, width)
    camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    for name, depth in depths(shape).items():
        image = RangeImage.from_depth(depth.astype(np.float32), camera)
        yield name, image
        yield f'{name}, cloud', RangeImage.from_points(image.points)


def digest(result):
    """Of all that is told of a frame."""
    told = hashlib.sha256(result.labels.tobytes())
    told.update(result.terrain.tobytes() + result.height.tobytes() + result.normals.tobytes())
    for plane in result.planes:
        told.update(plane.normal.tobytes() + plane.covariance.tobytes() + plane.hull.tobytes())
    return told.hexdigest()[:16]


def main():
    for method in ('planes', 'normals'):
        # Down the image, so that there is ground in some.
        config = Config(method=method, up_y=-1.0, up_z=0.0, min_pixels=4)
        for shape in SHAPES:
            for name, image in images(shape):
                try:
                    told = digest(SequenceSegmenter(config).segment(image, 0))
                except Exception as error:
                    told = f'{type(error).__name__}: {error}'
                print(method, *shape, name, told, sep='; ', flush=True)


if __name__ == '__main__':
    sys.exit(main())
