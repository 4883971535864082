"""What the core consists of, piece by piece, and how `ablate.py` switches each piece off.

A change is a parameter of `Config` with its value, or a name below `rangeseg_ros.core` with what
takes its place: a constant, or a function that makes the new function from the original one.
Compiled kernels keep the functions they were compiled with, so that only what Python calls can be
replaced. A name that is gone is an error: the table follows the code.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from rangeseg_ros.core.by_planes.offsets import Offsets


class Mechanism(NamedTuple):
    """A rule, a pass or a special case.

    Attributes
    ----------
    name : str
    modules : str
        Below `core/`, with `:function,function` where it is only a part of a module.
    changes : mapping
        What switches it off, or, of an option, on: see above.
    table : {'frames', 'terrain', 'tracks'}
        What it is measured on.
    option : bool
        Whether it is off by default.
    """

    name: str
    modules: str
    changes: Mapping[str, Any]
    table: str = 'frames'
    option: bool = False


def _returning(value: Any) -> Callable[[Any], Any]:
    return lambda original: lambda *given, **named: value


def _unchanged(original: Any) -> Any:
    return lambda first, *rest: first


def _given(place: int, value: Any) -> Callable[[Any], Any]:
    """The function with one of its arguments replaced."""
    return lambda original: lambda *given: original(*given[:place], value, *given[place + 1 :])


def _of_one_range(original: Any) -> Any:
    """A fit over strata as if all had one range: nothing depends on it."""
    return lambda strata, *rest: original(strata._replace(squared=0 * strata.squared + 1), *rest)


def _sensor(**fields: Callable[[Any, Any], float]) -> dict[str, Any]:
    """The measured sensor with fields that follow from it and from the stated one."""

    def changed(original: Any) -> Any:
        def measured(scales: Any, stated: Any, quanta: Any) -> Any:
            found = original(scales, stated, quanta)
            return found._replace(**{name: new(found, stated) for name, new in fields.items()})

        return measured

    return {'segmenter.measured_sensor': changed}


def _stated(*names: str) -> dict[str, Any]:
    return _sensor(**{name: lambda _, stated, name=name: getattr(stated, name) for name in names})


def _zero(*names: str) -> dict[str, Any]:
    return _sensor(**{name: lambda _, stated: 0.0 for name in names})


def _without_distortion_length(original: Any) -> Any:
    return lambda nodes, sensor: original(nodes, sensor._replace(distortion_length=0.0))


def _near_height_zero(_: Any) -> Any:
    def near(place: Any, variance: Any, config: Any, *rest: Any) -> Any:
        return (variance > 0) & (np.abs(place[0]) < config.least_step / 2)

    return near


_DISTORTION = 'fitting/noise.py:_over_scales,_ratio'
_CORRELATION = 'fitting/noise.py:_split'
_NOISE = ('noise', 'error_law')
_NORMALS = ('method', 'labelling', 'normals', 'directions')
# Cost of a border that lets nothing merge by the energy.
_NO_BORDER = -1e12

# fmt: off
MECHANISMS = (
    # The sensor.
    Mechanism('sensor measured', ' '.join(f'fitting/{name}.py' for name in _NOISE),
              {'sensor_model': 'fixed'}),
    Mechanism('distortion measured, not stated', _DISTORTION,
              _stated('distortion', 'range_distortion')),
    Mechanism('distortion measured, not one sd of the noise', _DISTORTION,
              _sensor(distortion=lambda found, _: found.noise,
                      range_distortion=lambda found, _: found.range_noise)),
    Mechanism('correlation of the noise measured, not stated', _CORRELATION,
              _stated('white', 'correlation')),
    Mechanism('noise is correlated', f'{_CORRELATION} sensing/sensor.py:correlated_residuals',
              _sensor(white=lambda *_: 1.0, correlation=lambda *_: 0.0)),
    Mechanism('quantisation found', 'fitting/noise.py:quantisation,_common_step',
              {'segmenter.quantisation': _returning((0.0, 0.0))}),
    Mechanism('noise of directions', 'sensing/sensor.py:tilt_variance', _zero('direction_noise')),
    Mechanism('errors in range', 'fitting/error_law.py:_scale_term,_deviance',
              {'fitting.noise.fit_law': _of_one_range}),
    # Edges and holes.
    Mechanism('jump edges', 'sensing/jump_edges.py fitting/steps.py',
              {'jump_edges': 'none'}),
    Mechanism('jumps by the plane, not Sobel',
              'sensing/jump_edges.py:plane_deviation,_find_deviations fitting/steps.py',
              {'jump_edges': 'sobel'}),
    Mechanism('steps follow the noise', 'fitting/steps.py', {'edge_step': 0.0065}),
    Mechanism('holes bridged', 'sensing/bridges.py',
              {'segmenter.bridge_holes': _unchanged}),
    Mechanism('enlarged images found',
              'sensing/enlargement.py',
              {'segmenter.enlargement': _returning(None)}),
    Mechanism('disparities and pictures found', 'sensing/encoding.py',
              {'segmenter.encoding': _returning(None)}),
    # Regions.
    Mechanism('patches as wide as the distortion',
              'by_planes/patches.py',
              {'by_planes.method.find_patches': _without_distortion_length}),
    Mechanism('parts merge by the energy', 'by_planes/surfaces.py:_apart',
              {'by_planes.method.join_surfaces': _given(4, _NO_BORDER),
               'segmenter.unite_regions': _given(3, _NO_BORDER)}),
    Mechanism('regions that touch unite', 'by_planes/surfaces.py:unite_regions',
              {'segmenter.unite_regions': lambda _: lambda regions, sums, *rest:
               (regions, np.zeros((0, 2), np.uint16), sums)}),
    Mechanism('planes moved by the distortion', 'by_planes/offsets.py',
              {'by_planes.labelling.local_offsets':
               lambda _: lambda surfaces, blocks, theta, *rest: Offsets.none(len(theta))}),
    Mechanism('labels expanded by cuts', 'by_planes/labelling.py graphcut/cut.py '
              'graphcut/expansion.py',
              {'by_planes.labelling.run_halves': _returning(None)}),
    Mechanism('labels of pixels, not of blocks', 'by_planes/labelling.py by_planes/offsets.py '
              'graphcut/cut.py graphcut/expansion.py',
              {'by_planes.labelling.run_halves': _returning(None),
               'by_planes.labelling.local_offsets':
               lambda _: lambda surfaces, blocks, theta, *rest: Offsets.none(len(theta))}),
    Mechanism('bins of 2 x 2 pixels, not of 4 x 4', 'sensing/binning.py:widening',
              {'work_budget': 0.9}),
    Mechanism('bins, not pixels', 'sensing/binning.py',
              {'segmenter.bin_side': _returning(1)}),
    Mechanism('bins of one surface', 'sensing/binning.py:of_one_surface,_average_near_median',
              {'sensing.binning.Bins.of_one_surface': lambda _: lambda bins, steps: bins.means}),
    Mechanism('borders of pixels, not of bins', 'by_planes/borders.py',
              {'segmenter.with_sharp_borders': lambda _: lambda regions, surfaces, models, image,
               side, *rest: regions.repeat(side, 0).repeat(side, 1)[
                   : image.shape[0], : image.shape[1]] * image.valid}),
    Mechanism('curved regions told', 'by_planes/posterior.py', {'plane_probability': 0.0}),
    Mechanism('small blocks tell the bends of planes', 'by_planes/posterior.py:_posterior',
              {'segmenter.plane_posteriors':
               lambda original: lambda fits, *rest: original(
                   fits._replace(sensor=fits.sensor._replace(unbent=1.0)), *rest)}),
    Mechanism('facets of curved surfaces told', 'by_planes/posterior.py:_evidence,_solution',
              {'segmenter.plane_posteriors': _given(1, np.zeros((0, 2), np.uint16))}),
    Mechanism('method normals', ' '.join(f'by_normals/{name}.py' for name in _NORMALS),
              {'method': 'normals'}, option=True),
    # Planes.
    Mechanism('outliers left out of fits', 'fitting/region_sums.py:fit_sums',
              {'fitting.region_sums.fit_sums': lambda _: lambda total: np.zeros((len(total), 3))}),
    Mechanism('parts of a surface found', 'fitting/coplanar.py',
              {'description.planes.common_surfaces':
               lambda _: lambda fits, covariance: np.arange(len(fits.theta))}),
    # The ground.
    Mechanism('ground reached by a chain', 'ground/reach.py',
              {'ground.terrain.reach': _near_height_zero}, 'terrain'),
    Mechanism('ground follows what is seen', 'ground/cells.py:ground_field,_sums,_fitted',
              {'ground.terrain.ground_field':
               lambda original: lambda cells, ground, *rest: original(
                   cells, np.zeros_like(ground), *rest)}, 'terrain'),
    Mechanism('confidence decides', 'ground/estimate.py:no_step',
              {'ground.terrain.SURE': 0.0}, 'terrain'),
    Mechanism('steep faces are obstacles', 'ground/terrain.py:_faces',
              {'ground.terrain._faces':
               lambda _: lambda cells, config: np.zeros(cells.inverse.shape, bool)}, 'terrain'),
    # Ids.
    Mechanism('camera motion by the planes', 'tracking/tracker.py:_camera_motion',
              {'tracking.tracker._camera_motion': _returning((np.eye(3), np.zeros(3)))}, 'tracks'),
    Mechanism('gate of chi-squared', 'tracking/plane_errors.py:mahalanobis,with_floor',
              {'tracking.tracker.GATE': 1e9}, 'tracks'),
    Mechanism('gate of angles', 'tracking/tracker.py:_near',
              {'tracking.tracker._near': lambda _: lambda known, seen:
               np.ones((len(known.id), len(seen.id)), bool)}, 'tracks'),
    Mechanism('planes found again without overlap', 'tracking/tracker.py:_assign',
              {'tracking.tracker._UNSEEN_OVERLAP': 0.0}, 'tracks'),
    Mechanism('planes remembered out of sight', 'tracking/tracker.py:Tracker',
              {'track_time': 0.0}, 'tracks'),
)
# fmt: on
