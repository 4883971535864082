"""The ground of an image, looked for when somebody asks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.ground.grid import GridOptions, GroundGrid, GroundMemory
from rangeseg_ros.core.ground.roles import unit
from rangeseg_ros.core.ground.terrain import Limits, Terrain, terrain_of
from rangeseg_ros.core.sensing.enlargement import Cells
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel


@dataclass(frozen=True, eq=False)
class Survey:
    """What finding the ground takes.

    Attributes
    ----------
    image : RangeImage
    sensor : SensorModel
    up : (3,) float64
        Unit vector in the frame of the image.
    sensor_height : float
        Above the ground below the sensor, metres; 0 = unknown.
    height_noise : float
        Its standard deviation, metres.
    limits : Limits
    memory : GroundMemory
        Of the images before, or of none.
    stamp : int
        When the image was taken, nanoseconds.
    pose : (rotation (3, 3), shift (3,)), optional
        Fixed frame from the frame of the image with the sensor as its origin.
    fixed_frame : str
        Its name.
    cloud_resolution : float
        Side of the cubes of which clouds have a point, metres; 0 = all pixels.
    cells : Cells or None
        Of one measurement each, where the image was enlarged; the errors are theirs.
    """

    image: RangeImage
    sensor: SensorModel
    up: NDArray[np.float64]
    sensor_height: float
    height_noise: float
    limits: Limits
    memory: GroundMemory
    stamp: int = 0
    pose: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
    fixed_frame: str = ''
    cloud_resolution: float = 0.0
    cells: Cells | None = None

    @classmethod
    def of(
        cls, image: RangeImage, sensor: SensorModel, config: Config, up: ArrayLike | None = None
    ) -> Survey:
        """With the parameters of `config`, and its direction `up` when none is given.

        The default is that of a level camera, see `RangeImage.level_up`.
        """
        limits = Limits(
            float(np.radians(config.ground_slope)),
            config.obstacle_height,
            config.drop_height,
            float(np.radians(config.up_sd)),
            config.ground_gap,
            config.robot_radius,
        )
        if up is None:
            up = image.level_up if config.level else (config.up_x, config.up_y, config.up_z)
        return cls(
            image,
            sensor,
            unit(up),
            config.sensor_height,
            config.sensor_height_sd,
            limits,
            GroundMemory(grid_options(config)),
            cloud_resolution=config.cloud_resolution,
        )

    def terrain(self) -> Terrain:
        """Find it."""
        known = self.sensor_height, self.height_noise
        if self.sensor_height <= 0:
            remembered = self.memory.recall_height(self.stamp)
            # A robot nods and a floor undulates, by less than an obstacle is high.
            known = (remembered, self.limits.least) if remembered else (0.0, 0.0)
        image, cells = self.image, self.cells
        if cells is not None:
            image = cells.reduced(image)
        found = terrain_of(image, self.sensor, self.up, known, self.limits)
        if cells is not None:
            pixels = [cells.enlarged(values, self.image.shape) for values in found[:2]]
            found = found._replace(classes=pixels[0], height=pixels[1])
        if found.stand.found:
            self.memory.keep_height(found.stand.height(self.up), self.stamp)
        return found

    def ground_grid(self, terrain: Terrain) -> GroundGrid:
        """The grid of the images before, with the terrain of this one."""
        place = self.image.place
        return self.memory.add(terrain, self.up, self.stamp, place, self.pose, self.fixed_frame)


def grid_options(config: Config) -> GridOptions:
    """Of the parameters."""
    return GridOptions(
        config.grid_resolution,
        config.grid_size,
        config.grid_memory,
        config.grid_clearance,
        config.track_time,
    )
