"""The ground of an image, looked for when somebody asks."""

from __future__ import annotations

from dataclasses import dataclass

from rangeseg_ros.core.arrays import Floats
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.ground.estimate import STEP_PRIOR
from rangeseg_ros.core.ground.grid import GroundGrid, GroundMemory
from rangeseg_ros.core.ground.roles import unit
from rangeseg_ros.core.ground.terrain import Terrain, terrain_of
from rangeseg_ros.core.sensing.enlargement import Cells
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel


@dataclass(frozen=True, eq=False, repr=False)
class GroundInput:
    """What finding the ground takes.

    `up` (3,) is a unit vector in the frame of the image, `sensor_height` that above the ground
    below the sensor, metres, 0 for unknown. `memory` is of the images before the one of `stamp`,
    nanoseconds; `pose` (rotation, shift) leads from the frame of the image, with the sensor as its
    origin, to the frame named `fixed_frame`. `cells` hold a measurement each where the image was
    enlarged; the errors are theirs.
    """

    image: RangeImage
    sensor: SensorModel
    config: Config
    up: Floats
    sensor_height: float
    memory: GroundMemory
    stamp: int = 0
    pose: tuple[Floats, Floats] | None = None
    fixed_frame: str = ''
    cells: Cells | None = None

    @classmethod
    def of(cls, image: RangeImage, sensor: SensorModel, config: Config) -> GroundInput:
        """With the parameters of `config`; up is by default that of a level camera."""
        up = unit(image.level_up if config.level else (config.up_x, config.up_y, config.up_z))
        return cls(image, sensor, config, up, config.sensor_height, GroundMemory(config))

    def terrain(self) -> Terrain:
        """Find it."""
        known = self.sensor_height, self.config.sensor_height_sd
        if self.sensor_height <= 0:
            remembered = self.memory.recall_height(self.stamp)
            # A robot nods and a floor undulates, by less than an obstacle is high.
            known = (remembered, self.config.least_step) if remembered else (0.0, 0.0)
        cells = self.cells
        image = self.image if cells is None else cells.reduced(self.image)
        found = terrain_of(image, self.sensor, self.up, known, self.config)
        if cells is not None:
            pixels = [cells.enlarged(values, self.image.shape) for values in found[:2]]
            found = found._replace(classes=pixels[0], height=pixels[1])
        if found.stand.found and self.sensor_height <= 0:
            # Nothing that is stated rules out a step out of view.
            found = found._replace(stand=found.stand._replace(confidence=1 - STEP_PRIOR))
        if found.stand.found:
            self.memory.keep_height(found.stand.height(self.up), self.stamp)
        return found

    def ground_grid(self, terrain: Terrain) -> GroundGrid:
        """The grid of the images before, with the terrain of this one."""
        place = self.image.place
        return self.memory.add(terrain, self.up, self.stamp, place, self.pose, self.fixed_frame)
