"""Frames of one camera, one after the other: planes with persistent ids and roles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.ground.grid import GroundMemory
from rangeseg_ros.core.ground.ground_input import GroundInput
from rangeseg_ros.core.ground.roles import roles, unit
from rangeseg_ros.core.mapping.edges import JumpPoints
from rangeseg_ros.core.mapping.map_planes import moved_planes
from rangeseg_ros.core.mapping.observations import views
from rangeseg_ros.core.mapping.odometry import Motion, PlaneOdometry
from rangeseg_ros.core.mapping.plane_map import PlaneMap
from rangeseg_ros.core.mapping.transforms import Transform, TransformError
from rangeseg_ros.core.segmentation import Segmentation
from rangeseg_ros.core.segmenter import Segmenter
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.tracking.tracker import Tracker

# Parameters of which a grid of the ground is made.
_OF_GRIDS = 'grid_resolution', 'grid_size'


class SequenceSegmenter:
    """Segments the frames of a sequence, live or recorded: the same frames give the same ids.

    Attributes
    ----------
    map : PlaneMap
        Of the frames whose pose was given, or else found by the odometry.
    pose : Transform or None
        Of the last frame, in the frame of the map.
    motion : Motion or None
        Of the camera up to the last frame, with the parameter `odometry`.

    Examples
    --------
    >>> sequence = SequenceSegmenter(config)
    >>> results = [sequence.segment(image, stamp) for stamp, image in frames]
    """

    def __init__(self, config: Config | None = None) -> None:
        self._segmenter = Segmenter(config)
        self._tracker = Tracker(config)
        self.map = PlaneMap(config)
        self.pose: Transform | None = None
        self.motion: Motion | None = None
        self._odometry = PlaneOdometry(self.config)
        self._ground = GroundMemory(self.config)
        self._stamp = 0
        self._pose: Transform | None = None

    def __repr__(self) -> str:
        return f'<SequenceSegmenter, {self.config!r}, {self.map!r}>'

    @property
    def config(self) -> Config:
        """Parameters; new ones count from the next frame on, and the planes keep their ids."""
        return self._segmenter.config

    @config.setter
    def config(self, config: Config) -> None:
        before, moved = self.config, config.map_frame != self.config.map_frame
        self._segmenter = Segmenter(config)
        if moved:
            self.map = self.map.restarted('its frame has changed')
            self._pose = None
        if (config.odometry, config.odometry_frame) != (before.odometry, before.odometry_frame):
            self._odometry, self.motion = PlaneOdometry(config), None
        self._tracker.config = self._odometry.config = self.map.config = config
        if moved or any(getattr(config, n) != getattr(before, n) for n in _OF_GRIDS):
            self._ground = GroundMemory(config)
        self._ground.config = config

    def segment(
        self,
        image: RangeImage,
        stamp: int,
        up: ArrayLike | None = None,
        pose: Transform | None = None,
        height: float | None = None,
        up_sd: float | None = None,
        result: Segmentation | None = None,
    ) -> Segmentation:
        """Label the next frame; ids and roles of its planes are set.

        Parameters
        ----------
        image : RangeImage
        stamp : int
            When it was taken, nanoseconds. Before the last frame, as in a looped recording, time
            begins anew: nothing known is matched to it.
        up : (3,) float, optional
            Direction in the frame of the image, the configured one when not given.
        pose : Transform, optional
            Fixed frame from the frame of the image: the planes then count for `map`.
        height : float, optional
            Of the origin of the frame of the image above the ground, metres, where the parameter
            `sensor_height` is 0.
        up_sd : float, optional
            Standard deviation of `up`, degrees, where it is not the parameter `up_sd`.
        result : Segmentation, optional
            Of a `Segmenter` for `image`, as where it works on several frames at once.

        Raises
        ------
        ValueError
            A stamp that is no integer, a pose that is no Transform, a height that is not finite,
            or as `Segmenter.segment`.
        """
        if not isinstance(stamp, int | np.integer):
            raise ValueError(f'stamp must be an integer, nanoseconds, not {stamp!r:.60}')
        if not isinstance(pose, Transform | None):
            raise TransformError('pose must be a Transform, as of Transform.from_matrix(matrix)')
        if height is not None and not np.isfinite(height):
            raise ValueError(f'height must be a finite number, metres, not {height!r:.60}')
        result = result or self._segmenter.segment(image)
        config = self.config
        if up_sd not in (None, config.up_sd):
            config = replace(config, up_sd=up_sd)
        if stamp < self._stamp:
            self._forget()
        # Errors and what is in sight follow from where the sensor is: all is seen from there.
        sensor, away = Transform(np.eye(3), image.place), image.place.any()
        planes = moved_planes(result.planes, sensor.inverse()) if away else result.planes
        pose = pose.after(sensor) if pose else None
        motion = pose.inverse().after(self._pose) if pose and self._pose else None
        self._stamp, self._pose = stamp, pose
        planes = self._tracker.track(result.labels, planes, stamp, motion)
        up = result.up if up is None else unit(up)
        planes = with_roles(planes, config, up)
        if config.odometry:
            towards = unit((config.up_x, config.up_y, config.up_z)) if up is None else up
            seen = views(result.labels, planes, config.distortion_length)
            edges = JumpPoints.of(image, result.jumps, result.cells)
            found = self._odometry.add(planes, seen, stamp, towards, image.axes, edges)
            self.motion = found.of_origin(image.place)
            if not config.fixed_frame:
                if not found.held and len(self.map):
                    self.map = self.map.restarted('the odometry lost the camera')
                pose = self.motion.pose.after(sensor)
        self.pose = pose.after(sensor.inverse()) if pose else None
        if pose:
            self.map.add(result.labels, planes, image, pose, stamp)
        source = result.source
        if isinstance(source, GroundInput) and up is not None:
            above = 0.0 if height is None else max(0.0, float(height + up @ image.place))
            source = replace(
                source,
                config=config,
                up=up,
                sensor_height=source.sensor_height or above,
                memory=self._ground,
                stamp=stamp,
                pose=pose,
                fixed_frame=config.map_frame,
            )
        known = zip(result.planes, planes, strict=True)
        planes = [p.named(id=seen.id, surface=seen.surface, role=seen.role) for p, seen in known]
        return replace(result, planes=planes, source=source)

    def _forget(self) -> None:
        """Time has gone back: match nothing to what is known."""
        self._tracker.reset()
        self.map = self.map.restarted('time has gone back')
        self._ground.forget()
        self._pose = None


def with_roles(
    planes: Sequence[Plane], config: Config, up: ArrayLike | None = None
) -> list[Plane]:
    """`planes` with their `roles`."""
    named = zip(planes, roles(planes, config, up), strict=True)
    return [plane.named(role=role) for plane, role in named]
