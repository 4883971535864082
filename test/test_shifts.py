"""Planes shifted to what is measured of them near by: against the definition, and at a crease."""

import numpy as np
from scipy.ndimage import gaussian_filter

from rangeseg_ros import Camera, Config, RangeImage, Segmenter
from rangeseg_ros.core.by_planes.shifts import shift_at, shifts
from rangeseg_ros.core.sensing.moments import RATIO


def test_shifts_are_the_weighted_residuals_around():
    random = np.random.default_rng(3)
    rows, columns, agreement = 11, 13, 5.0
    surfaces = np.zeros((rows, columns), np.int32)
    surfaces[:, :6], surfaces[2:9, 6:], surfaces[9, 9] = 1, 2, 1
    theta = np.array([[0, 0, 0], [0.02, -0.01, 0.5], [-0.1, 0.05, 0.45]])
    blocks = np.zeros((rows, columns, 13))
    rays, residuals = {}, {}
    for place in np.ndindex(rows, columns):
        ray = random.normal([0, 0, 1], 0.3, (16, 3))
        residual = random.normal(0.002, 0.01, 16)
        rays[place], residuals[place] = ray, residual
        y = ray @ theta[surfaces[place]] + residual
        square = np.einsum('ni,nj->ij', ray, ray)[np.triu_indices(3)]
        blocks[place] = [*square, *(y @ ray), y @ y, 16, 32, 0]
    found = shifts(surfaces, blocks, theta, 2, 3, agreement)
    for place in np.ndindex(rows, columns):
        for label in (1, 2):
            level, residual, ratio = [], [], 0.0
            for near in np.ndindex(rows, columns):
                i, j = near
                window = surfaces[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2]
                if surfaces[near] != label or not np.isin(window, (0, label)).all():
                    continue
                if max(abs(i - place[0]), abs(j - place[1])) <= 3:
                    level.append(rays[near] @ theta[label])
                    residual.append(residuals[near])
                    ratio += blocks[near][RATIO]
            expected = 0.0
            if level:
                fit = np.ravel(level) @ np.ravel(residual) / np.square(level).sum()
                expected = fit * ratio / (ratio + agreement)
            own = np.argwhere(surfaces == label)
            inside = (own.min(0) - 2 <= place).all() and (place <= own.max(0) + 2).all()
            value = shift_at(found, label, *place)
            np.testing.assert_allclose(value, expected if inside else 0, rtol=1e-4, atol=1e-9)


def test_a_crease_stays_in_its_place_where_the_sensor_bends_the_planes():
    """Two walls at 4 m that meet at a right angle, under the distortion of a bad Kinect."""
    camera = Camera(640, 480, 585.0, 585.0, 319.5, 239.5)
    column = camera.rays[..., 0]
    away = []
    for seed in range(3):
        random = np.random.default_rng(seed)
        bent = gaussian_filter(random.normal(size=(480, 640)), 35)
        noise = gaussian_filter(random.normal(size=(480, 640)), 2)
        inverse = 0.25 + np.abs(column) * 0.25
        inverse = inverse + 0.002 * bent / bent.std() + 0.0012 * noise / noise.std()
        image = RangeImage.from_depth((1 / inverse).astype(np.float32), camera)
        labels = Segmenter(Config()).segment(image).labels
        edge = (labels[:, 1:] != labels[:, :-1]) & (np.abs(column[:, 1:]) < 0.1)
        distance = np.abs(np.arange(639) - 319)
        away.append(np.where(edge, distance, 99).min(axis=1))
    # Without shifts, half.
    assert np.mean(np.array(away) <= 2) > 0.75
