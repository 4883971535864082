"""Sites that an expansion may change."""

import numpy as np
import pytest

from rangeseg_ros.core.graphcut.sites import GridLabelling, band, fronts


@pytest.mark.parametrize('reach', [1, 2, 3, 5])
def test_a_band_has_the_sites_so_near_to_a_label(reach):
    rng = np.random.default_rng(reach)
    height, width, count = 14, 11, 4
    seen = 0
    for rows in [(0, height), (0, 6), (5, height)]:
        labels = rng.integers(0, count, (height, width)).astype(np.int32)
        labels[:, 4:] = labels[:, :1]
        links = rng.random((2, height, width)).astype(np.float32) * (
            rng.random((2, height, width)) > 0.2
        )
        links[0, :, -1] = links[1, -1] = 0
        pixels = labels.ravel(), links.reshape(2, -1)
        data = np.zeros(labels.size, np.float32)
        start, sites = fronts(GridLabelling.of(pixels[0], data, pixels[1], width), count, rows)
        for alpha in range(count):
            labelling = GridLabelling.of(pixels[0], data, pixels[1], width)
            front = sites[start[alpha] : start[alpha + 1]]
            found = band(alpha, front, reach, labelling, rows)
            inside = np.zeros(labels.shape, bool)
            inside[slice(*rows)] = True
            # The label's own count from beyond the rows, too; what is reached lies in them.
            reached = labels == alpha
            for _ in range(reach):
                more = reached.copy()
                more[:, 1:] |= reached[:, :-1] & (links[0, :, :-1] > 0)
                more[:, :-1] |= reached[:, 1:] & (links[0, :, :-1] > 0)
                more[1:] |= reached[:-1] & (links[1, :-1] > 0)
                more[:-1] |= reached[1:] & (links[1, :-1] > 0)
                reached |= more & inside
            assert set(found.tolist()) == set(np.flatnonzero(reached & (labels != alpha)).tolist())
            assert (labelling.position[found] == np.arange(len(found))).all()
            assert np.count_nonzero(labelling.position >= 0) == len(found)
            seen += len(found)
    assert seen > 100
