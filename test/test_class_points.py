"""Points of a class of pixels: as NumPy has them."""

import numpy as np
import pytest
from clouds import cloud_of

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.ground.classes import DROP, GROUND, OBSTACLE
from rangeseg_ros.core.ground.points import points_of_class
from rangeseg_ros.core.ground.survey import Survey
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel

CAMERA = Camera(57, 43, 50.0, 55.0, 28.0, 20.0)


@pytest.mark.parametrize('kind', [GROUND, OBSTACLE, DROP])
@pytest.mark.parametrize('form', ['camera', 'cloud', 'turned'])
def test_points_of_a_class(form, kind):
    draw = np.random.default_rng(5)
    inverse = draw.uniform(0.2, 1, CAMERA.shape).astype(np.float32)
    inverse[draw.random(CAMERA.shape) < 0.1] = 0
    image = RangeImage(CAMERA.rays, inverse, CAMERA)
    if form == 'cloud':
        image = cloud_of(image.points)
    if form == 'turned':
        turn = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
        image = RangeImage.from_points(image.points.astype(float) @ turn + (0.1, -0.2, 0.3))
    terrain = Survey.of(image, SensorModel.from_config(Config()), Config()).terrain()
    classes = draw.integers(0, 4, CAMERA.shape).astype(np.uint8) * image.valid
    height = draw.random(CAMERA.shape).astype(np.float32)
    terrain = terrain._replace(classes=classes, height=height)
    found = points_of_class(image, terrain, kind)
    chosen = classes == kind
    assert found.dtype == np.float32 and len(found) == chosen.sum() > 0
    np.testing.assert_array_equal(found[:, :3], image.points[chosen])
    np.testing.assert_array_equal(found[:, 3], height[chosen])
