"""Attitude as a table: CSV with a header that states frames and units, and NetCDF with attributes."""

from __future__ import annotations

import os

import numpy as np

from estimator.models.files import written_atomically
from guidance.export.series import AttitudeSeries

_ABOUT = "quaternion inertial_from_body, Hamilton, scalar first; rate and acceleration in body axes"


def write_csv(path: str | os.PathLike[str], series: AttitudeSeries) -> None:
    """Write times (s), quaternion, rate (rad/s) and, where known, acceleration (rad/s2) to 17 significant digits."""
    head = ["time_s", "q_w", "q_x", "q_y", "q_z", "rate_x_rad_s", "rate_y_rad_s", "rate_z_rad_s"]
    parts = [series.times[:, None], series.quaternion, series.rate]
    if series.acceleration is not None:
        head += ["acceleration_x_rad_s2", "acceleration_y_rad_s2", "acceleration_z_rad_s2"]
        parts.append(series.acceleration)
    rows = np.concatenate(parts, axis=1)
    lines = ["# boresight attitude, schema 1", f"# {_ABOUT}",
             f"# epoch {series.epoch} {series.time_system}, inertial frame {series.reference_frame}, "
             f"object {series.object_name} {series.object_id}", ",".join(head)]
    lines += [",".join(f"{v:.17g}" for v in row) for row in rows]
    with written_atomically(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_netcdf(path: str | os.PathLike[str], series: AttitudeSeries) -> None:
    """Write the same to a NetCDF 4 file, with units, frames and the epoch as attributes."""
    import xarray as xr

    variables = {
        "quaternion": (("time", "component"), series.quaternion, {"units": "1", "long_name": "inertial_from_body"}),
        "rate": (("time", "axis"), series.rate, {"units": "rad s-1", "long_name": "angular velocity, body axes"}),
    }
    if series.acceleration is not None:
        variables["acceleration"] = (("time", "axis"), series.acceleration,
                                     {"units": "rad s-2", "long_name": "angular acceleration, body axes"})
    data = xr.Dataset(
        variables,
        coords={"time": ("time", series.times, {"long_name": f"seconds after {series.epoch} {series.time_system}"}),
                "component": ["w", "x", "y", "z"], "axis": ["x", "y", "z"]},
        attrs={"schema": 1, "conventions": _ABOUT, "epoch": series.epoch, "time_system": series.time_system,
               "reference_frame": series.reference_frame, "object_name": series.object_name,
               "object_id": series.object_id})
    with written_atomically(path) as temporary:
        data.to_netcdf(temporary, engine="h5netcdf")
