"""Exact points of scanners, in double precision."""


def abw_points(values, calibration):
    """Points (512, 512, 3) of ABW range values, metres in the optical frame; NaN in shadow."""
    return calibration.camera.rays.astype(float) * calibration.depth(values)[..., None]
