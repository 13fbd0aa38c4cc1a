"""What a disagreement in an alignment campaign may go with: orbit, attitude, rate, look direction, housekeeping."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.discrepancy.dependence import Covariate
from estimator.effects.declaration import ENVIRONMENT
from problems.alignment.problem import AlignmentModel

COINCIDENT = 1e-6  # s, times closer than this are one epoch


def campaign_covariates(model: AlignmentModel, channel: str, time: np.ndarray) -> dict[str, Covariate]:
    """Covariates of a channel at rising times.

    ``time`` (s after the epoch), ``orbit_phase`` (rad from the ascending node) and ``sunlit`` (visible part of the Sun)
    everywhere; where there is attitude, the body's rate in tracker axes, its norm, and the angle between nadir and the
    star tracker's line of sight or each beam, for beams also their azimuth about nadir from the direction of flight;
    for the Doppler channel the measured shift of each beam, which stands for frequency; and every housekeeping series
    under its own name, between its first and last sample.

    Args:
        model: the campaign.
        channel: kind of measurement.
        time: (n,) s after the epoch, rising.
    """
    time = np.asarray(time, dtype=float)
    table = model.environment(time)
    fields, column = {}, 0
    for name, size in ENVIRONMENT.items():
        fields[name] = table[:, column : column + size]
        column += size
    result = {
        "time": Covariate(time, "s"),
        "orbit_phase": Covariate(fields["orbit_phase"][:, 0], "rad", angle=True),
        "sunlit": Covariate(fields["sunlit"][:, 0], "1"),
    }
    if channel != "gnss":
        result |= _attitude(model, channel, time, fields["position"], fields["velocity"])
    for name, series in model.campaign.housekeeping.items():
        if len(series.time) > 1:
            known = (time >= series.time[0]) & (time <= series.time[-1])
            values = np.where(known, np.interp(time, series.time, series.values), np.nan)
            result[name if name not in result else f"housekeeping {name}"] = Covariate(values, series.unit)
    return result


def _attitude(model: AlignmentModel, channel: str, time: np.ndarray, position: np.ndarray,
              velocity: np.ndarray) -> dict[str, Covariate]:
    rate = model.smooth_rate(time, np.full((len(time), 3), np.nan))
    quaternion = model.smooth_attitude(time)
    result = {f"body_rate_{axis}": Covariate(rate[:, k], "rad/s") for k, axis in enumerate("xyz")}
    result["body_rate"] = Covariate(np.linalg.norm(rate, axis=1), "rad/s")
    known = np.isfinite(quaternion[:, 0])
    if not known.any():
        return result
    inertial = Rotation.from_quat(quaternion[known], scalar_first=True).inv()
    down = -position[known] / np.linalg.norm(position[known], axis=1, keepdims=True)
    if channel != "doppler":
        sight = inertial.apply(np.asarray(model.layout.tracker_boresight))
        result["boresight_off_nadir_angle"] = Covariate(_spread(_angle(sight, down), known), "rad")
        return result
    doppler = model.campaign.doppler
    assert doppler is not None
    index = np.clip(np.searchsorted(doppler.time, time - COINCIDENT), 0, len(doppler.time) - 1)
    beams = doppler.frequency_shift.shape[1]
    given = doppler.beam_direction
    directions = given[index] if given.ndim == 3 else np.broadcast_to(given, (len(time), beams, 3))
    tracker_from_antenna = Rotation.from_quat(model.start.antenna_from_tracker, scalar_first=True).inv()
    along = velocity[known] / np.linalg.norm(velocity[known], axis=1, keepdims=True)
    along = along - np.sum(along * down, axis=1, keepdims=True) * down
    across = np.cross(down, along)
    off_nadir, azimuth = (np.full((len(time), beams), np.nan) for _ in range(2))
    for beam in range(beams):
        looking = inertial.apply(tracker_from_antenna.apply(directions[known, beam]))
        off_nadir[known, beam] = _angle(looking, down)
        azimuth[known, beam] = np.arctan2(np.sum(looking * across, axis=1), np.sum(looking * along, axis=1))
    result["off_nadir_angle"] = Covariate(off_nadir, "rad")
    result["look_azimuth"] = Covariate(azimuth, "rad", angle=True)
    result["doppler_shift"] = Covariate(doppler.frequency_shift[index], "Hz")
    return result


def _angle(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angle (n,) rad between vectors (n, 3), accurate near zero too."""
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(first, second), axis=1), np.sum(first * second, axis=1)))


def _spread(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    whole = np.full(len(known), np.nan)
    whole[known] = values
    return whole
