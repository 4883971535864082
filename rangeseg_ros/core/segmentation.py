"""What is found in a range image: labels, planes, and what is worked out of them when read."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import import_module
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats, Labels, Mask, Singles
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.description.tilt import Tilt, tilt_of
from rangeseg_ros.core.ground.grid import GroundGrid
from rangeseg_ros.core.ground.ground_input import GroundInput
from rangeseg_ros.core.ground.roles import Ramp, ramps_of
from rangeseg_ros.core.ground.stairs import Stairs, stairs_of
from rangeseg_ros.core.ground.terrain import Terrain
from rangeseg_ros.core.regions import region_sizes
from rangeseg_ros.core.sensing.enlargement import Cells
from rangeseg_ros.core.sensing.grid import GridEdges
from rangeseg_ros.core.sensing.jump_edges import edge_pixels
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel
from rangeseg_ros.core.sensing.verdict import Verdict, judge, no_depth

STATED = SensorModel.from_config(Config())
"""The sensor that the defaults describe."""


class Labelling(Protocol):
    """The part of a method's labelling that a `Segmentation` needs."""

    def energy(self) -> float:
        """Value of eq. 5.3."""

    def normals(self) -> Singles | None:
        """Normals (H, W, 3) that the labels stand for; None where the planes have them."""


class StoredLabelling(NamedTuple):
    """A `Labelling` without the image it is of: what remains of it in a pickle."""

    value: float
    field: Singles | None

    def energy(self) -> float:
        return self.value

    def normals(self) -> Singles | None:
        return self.field


def _notebook() -> Any:
    # Imported when asked for: the core draws nothing, and needs no other library.
    return import_module('rangeseg_ros.notebook')


@dataclass(frozen=True, eq=False, repr=False)
class Segmentation:
    """What was found in one range image.

    Attributes
    ----------
    labels : (H, W) uint16
        0 = no plane, otherwise the label of a plane.
    planes : list of Plane
        In the order of their labels.
    timings : dict
        Milliseconds per stage, in the order of the stages.
    reason : str
        Why there is no plane; empty when there is one.
    sensor : SensorModel
        Errors of the sensor, as the image shows them.
    labelling : Labelling
        What the regions were made from.
    jumps : (horizontal, vertical) of bool or None
        Edges of the grid of `cells` that cross a jump; None where none were looked for.
    source : GroundInput or Terrain
        How the ground is found, or what was found.
    upright : tuple of 3 float
        Tolerance, smallest area and slope of `tilt_of`.
    image : RangeImage or None
        What was segmented; None in a result that was pickled.
    cells : Cells or None
        Squares of pixels that planes were found in; None for pixels.
    work_budget : float
        Share of the full work that the image was given: with the same, its labels are the same.
    curved_regions : array of uint16 or None
        See `curved`, of `cells`; None where none were looked for.
    identified : bool
        False where `sensor` was to be measured and the image says too little: it is as stated.
    values : str
        Those of the image: depth, or disparity or picture, whose planes are measured in no unit.
    """

    labels: Labels
    planes: list[Plane]
    timings: dict[str, float]
    reason: str
    sensor: SensorModel = STATED
    labelling: Labelling = field(default=StoredLabelling(0.0, None), repr=False)
    jumps: GridEdges | None = field(default=None, repr=False)
    source: GroundInput | Terrain | None = field(default=None, repr=False)
    upright: tuple[float, float, float] | None = None
    work_budget: float = 1.0
    image: RangeImage | None = None
    cells: Cells | None = field(default=None, repr=False)
    curved_regions: Labels | None = field(default=None, repr=False)
    identified: bool = True
    values: str = 'depth'

    def __repr__(self) -> str:
        height, width = self.labels.shape
        if not self.planes:
            return f'<Segmentation {width}x{height}: no plane: {self.reason}>'
        roles = Counter(plane.role for plane in self.planes if plane.role).most_common()
        named = ', '.join(f'{role} {count}' for role, count in roles)
        share = np.count_nonzero(self.labels) / self.labels.size
        found = f'{len(self.planes)} planes' + (f' ({named})' if named else '')
        return f'<Segmentation {width}x{height}: {found}, {share:.0%} of the pixels>'

    def _repr_html_(self) -> str:
        return str(_notebook().to_html(self))

    def plot(self, axes: Any = None) -> Any:
        """Show the planes over the depth in matplotlib's axes, the current ones when not given."""
        return _notebook().plot(self, axes)

    def to_dict(self) -> dict[str, Any]:
        """Planes and how they were found as numbers, texts and lists, as JSON takes it."""
        return {
            'shape': list(self.labels.shape),
            'planes': [plane.to_dict() for plane in self.planes],
            'reason': self.reason,
            'sensor': str(self.sensor),
            'verdict': list(self.verdict.reasons),
            'tilt': str(self.tilt or ''),
        }

    def to_pandas(self) -> Any:
        """pandas.DataFrame with a row for each plane and the columns of planes.csv."""
        return _notebook().to_pandas(self)

    def to_trimesh(self) -> Any:
        """trimesh.Scene with a coloured mesh for each plane."""
        return _notebook().to_trimesh(self)

    def to_open3d(self) -> list[Any]:
        """Coloured open3d.geometry.TriangleMesh of each plane."""
        return list(_notebook().to_open3d(self))

    @cached_property
    def verdict(self) -> Verdict:
        """What is doubtful about the image, worked out when read."""
        if self.image is None:
            return Verdict()
        place = self.image.place
        thetas = {
            plane.label: -plane.normal / (plane.distance + plane.normal @ place)
            for plane in self.planes
        }
        return judge(self.image, self.labels, thetas, self.curved, self.identified, self.values)

    def of_pixels(self, labels: Labels, image: RangeImage, cells: Cells) -> Segmentation:
        """The result of the image whose `cells` it is of, with labels (H, W) of its pixels.

        A plane that none of these has is left out.
        """
        last = max((plane.label for plane in self.planes), default=0)
        counts = region_sizes(labels, last + 1).tolist()
        planes = [p.named(count=counts[p.label]) for p in self.planes if counts[p.label]]
        return replace(self, labels=labels, planes=planes, image=image, cells=cells)

    @property
    def side(self) -> int:
        """Pixels along the side of the squares that planes were found in."""
        return self.cells.factor if self.cells else 1

    def _at_full_size(self, array: NDArray[Any]) -> NDArray[Any]:
        """Values of all pixels."""
        return array if self.cells is None else self.cells.enlarged(array, self.labels.shape)

    @property
    def curved(self) -> Labels:
        """(H, W) 1, 2, ... on smooth regions that are less probably planes than
        `plane_probability` asks for, by falling size; 0 elsewhere.
        """
        if self.curved_regions is None:
            return np.zeros_like(self.labels)
        curved = self._at_full_size(self.curved_regions)
        return curved * (self.labels == 0) * (True if self.image is None else self.image.valid)

    @cached_property
    def tilt(self) -> Tilt | None:
        """Where the planes say that up is, when that is not what was stated; when read."""
        if self.upright is None or not isinstance(self.source, GroundInput):
            return None
        return tilt_of(self.planes, self.source.up, *self.upright)

    @cached_property
    def normals(self) -> Singles:
        """Reconstructed surface normals (thesis 5.11), worked out when read.

        (H, W, 3), unit vectors towards the sensor in the frame of the image: with method normals
        the direction that the pixel was given, with method planes the normal of its plane. NaN
        where there is no label.
        """
        normals = self.labelling.normals()
        if normals is not None:
            normals = self._at_full_size(normals)
            return np.where((self.labels > 0)[..., None], normals, np.float32(np.nan))
        table = np.full((int(self.labels.max(initial=0)) + 1, 3), np.nan, np.float32)
        for plane in self.planes:
            table[plane.label] = plane.normal
        return table.take(self.labels, axis=0, mode='clip')

    @cached_property
    def edges(self) -> Mask:
        """(H, W) True on either side of a jump edge, worked out when read."""
        if self.jumps is None:
            return np.zeros(self.labels.shape, np.bool_)
        return self._at_full_size(edge_pixels(self.jumps))

    @cached_property
    def ground(self) -> Terrain | None:
        """The ground and what interrupts it, worked out when read.

        None where none was asked for, or the image is no depth in metres.
        """
        if not isinstance(self.source, GroundInput):
            return self.source
        return None if no_depth(self.source.image) else self.source.terrain()

    @cached_property
    def grid(self) -> GroundGrid | None:
        """The ground around the robot, of this image and earlier ones whose `grid` was read."""
        if not isinstance(self.source, GroundInput) or self.ground is None:
            return None
        return self.source.ground_grid(self.ground)

    @cached_property
    def stairs(self) -> list[Stairs]:
        """Staircases in sight, up and down, worked out when read."""
        if not isinstance(self.source, GroundInput) or self.ground is None:
            return []
        place = self.source.image.place
        return [replace(seen, edge=seen.edge + place) for seen in stairs_of(self.ground)]

    @property
    def up(self) -> Floats | None:
        """(3,) unit vector in the frame of the image; None where no ground was asked for."""
        if self.source is None:
            return None
        return self.source.up if isinstance(self.source, GroundInput) else self.source.field.up

    @property
    def ramps(self) -> list[Ramp]:
        """Ramps among planes that have roles."""
        return [] if self.up is None else ramps_of(self.planes, self.up)

    @property
    def terrain(self) -> NDArray[np.uint8]:
        """(H, W) 0 not measured or not known, 1 ground, 2 obstacle, 3 drop."""
        if self.ground is None:
            return np.zeros(self.labels.shape, np.uint8)
        return self.ground.classes

    @property
    def height(self) -> Singles:
        """(H, W) metres along up above the ground; NaN where that is not known."""
        if self.ground is None:
            return np.full(self.labels.shape, np.nan, np.float32)
        return self.ground.height

    @cached_property
    def energy(self) -> float:
        """Value of eq. 5.3 for the labelling the regions were made from, worked out when read."""
        return self.labelling.energy()

    def __getstate__(self) -> dict[str, Any]:
        kept = {name: getattr(self, name) for name in ('verdict', 'stairs', 'tilt')}
        labelling = StoredLabelling(self.energy, self.labelling.normals())
        return {
            **self.__dict__,
            **kept,
            'labelling': labelling,
            'source': self.ground,
            'image': None,
        }
