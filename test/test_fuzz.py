"""Any depth image gives a result that keeps its promises, without a word."""

import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rangeseg_ros import Camera, Config, RangeImage, Segmenter
from rangeseg_ros.core.sensing.range_image import UnitWarning

BAD = [0, -1, np.nan, np.inf, -np.inf, 1e30, 1e-30, 65.535]


@st.composite
def depths(draw):
    """Ramps, stairs and noise of any kind of number, with holes of all that is no depth."""
    height, width = draw(st.integers(1, 64)), draw(st.integers(1, 64))
    v, u = np.indices((height, width))
    along = u if draw(st.booleans()) else v
    step = draw(st.sampled_from([1, 1, 8]))
    depth = draw(st.sampled_from([0.3, 2.5, 30.0])) + 0.0
    depth = depth + draw(st.sampled_from([0.0, 0.01, 0.3, 1.0, 30.0])) * (along // step * step)
    random = np.random.default_rng(draw(st.integers(0, 1000)))
    depth = depth + draw(st.sampled_from([0.0, 0.002, 0.5])) * random.normal(size=depth.shape)
    for value in draw(st.lists(st.sampled_from(BAD), max_size=3)):
        y, x = random.integers(0, height), random.integers(0, width)
        depth[y : y + 9, x : x + 9] = value
    kind = draw(st.sampled_from(['<u2', '>u2', '<f2', '<f4', '>f4', '<f8']))
    with np.errstate(all='ignore'):
        if kind[1] == 'u':
            depth = np.nan_to_num(1000 * depth, posinf=65535, neginf=0).clip(0, 65535)
        return depth.astype(kind)


@pytest.mark.parametrize('method', ['planes', 'normals'])
@settings(max_examples=60)
@given(data=st.data())
def test_invariants(method, data):
    depth, focal = data.draw(depths()), data.draw(st.sampled_from([1.0, 30.0, 300.0, 1e5]))
    # As wide as at 1 pixel no lens shows the world.
    d = data.draw(st.sampled_from([(), (), (-0.2, 0, 0, 0)])) if focal > 1 else ()
    centre, lens = (depth.shape[1] / 2, depth.shape[0] / 2), {'distortion_model': 'plumb_bob'}
    camera = Camera(*depth.shape[::-1], focal, 0.8 * focal, *centre, **lens, d=d)
    config = Config(method=method, min_pixels=data.draw(st.sampled_from([1, 20, 200])))
    before = depth.tobytes()
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        warnings.simplefilter('ignore', UnitWarning)
        result = Segmenter(config).segment(RangeImage.from_depth(depth, camera))
        hulls = [plane.hull for plane in result.planes]
    assert depth.tobytes() == before
    assert result.labels.shape == depth.shape and result.labels.dtype == np.uint16
    assert not result.labels[~result.image.valid].any()
    assert set(np.unique(result.labels)) - {0} == {plane.label for plane in result.planes}
    assert bool(result.reason) == (not result.planes) and np.isfinite(result.energy)
    for plane, hull in zip(result.planes, hulls, strict=True):
        assert plane.count == np.count_nonzero(result.labels == plane.label)
        assert np.isfinite([*plane.extents, *plane.centre, *plane.orientation]).all()
        assert np.isfinite([*plane.centroid, plane.area, plane.rms, plane.confidence]).all()
        assert np.linalg.norm(plane.normal) == pytest.approx(1) and plane.distance > 0
        assert len(hull) > 2 and np.isfinite(hull).all()
        assert (plane.covariance == plane.covariance.T).all()
        values = np.linalg.eigvalsh(plane.covariance)
        assert values[0] > -1e-9 * max(values[-1], 1e-30)
