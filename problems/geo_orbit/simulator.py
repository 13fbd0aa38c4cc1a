"""Tracking data of a known orbit: what the stations of the settings would measure, with noise and hidden effects.

The measurements come from the kernels and the effects of the joint problem itself, at values that are chosen instead of
estimated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from estimator.models.earth_orientation import tai_from_utc
from estimator.models.errors import MissingDataError, RequestError
from estimator.models.orbit_environment import read_bulletin_b
from estimator.models.ranging import Kind
from estimator.residuals import KernelResidual
from problems.geo_orbit.plausibility import predicted_elevations
from problems.geo_orbit.problem import OrbitModel, celestial_start, orbit_problem
from problems.geo_orbit.settings import OrbitSettings
from problems.geo_orbit.tracking import Observations, Tracking

SIZES: dict[str, int] = {"range": 1, "range_rate": 1, "azimuth_elevation": 2, "direction_cosines": 2}
_REFERENCE = {"range": 4e7, "range_rate": 0.0, "azimuth_elevation": 0.5, "direction_cosines": 0.5}  # m, m/s, rad, 1
"""Values of which the kernels tell by how much the prediction differs."""
OFFSET = 37.0  # s between the first measurements of one station and the next


def simulated_tracking(
    settings: OrbitSettings,
    *,
    hours: float = 24.0,
    step: float = 420.0,
    kinds: Sequence[Kind] = ("range", "azimuth_elevation"),
    effects: Mapping[str, Sequence[float] | np.ndarray] | None = None,
    seed: int | None = 1,
    minimum_elevation: float = np.radians(8.0),
) -> Tracking:
    """Measurements of the settings' own orbit wherever a station of the settings sees the satellite.

    Args:
        settings: with epoch, position and velocity, and the stations; their forces and signals are the truth.
        hours: length of the data from 300 s after the epoch on.
        step: s between measurements of one kind at one station.
        kinds: what every station measures.
        effects: parameters of effects that are true beside the settings, by name.
        seed: of the noise of the settings' standard deviations; None for no noise.
        minimum_elevation: below which nothing is measured, rad.

    Raises:
        MissingDataError: no epoch, orbit or station in the settings, or no station that sees the satellite.
        RequestError: a kind, an effect or a number of parameters that does not exist, or no time to measure in.
    """
    if settings.epoch is None:
        raise MissingDataError("a simulation needs an epoch", where="[orbit] epoch", remedy="give it as UTC text")
    if not settings.stations:
        raise MissingDataError("there is no station to measure from", where="[[stations]]",
                               remedy="add name, latitude_deg, longitude_deg, altitude_m of one at least")
    if unknown := [k for k in kinds if k not in SIZES]:
        raise RequestError("no such kind of measurement", where="kinds", value=unknown, limit=", ".join(SIZES))
    if not (step > 0 and hours * 3600 > 300.0 + step):
        raise RequestError("there is no time to measure in", where="hours and step", value=f"{hours} h, {step} s",
                           limit="step > 0 s and more than 300 s and one step")
    epoch = tai_from_utc([settings.epoch])[0]
    orientation = read_bulletin_b(settings.bulletins) if settings.bulletins else None
    start = celestial_start(settings, epoch, orientation)
    if start is None:
        raise MissingDataError("a simulation needs an orbit", where="[orbit]",
                               remedy="give position_m and velocity_m_s")
    time = np.arange(300.0, hours * 3600, step)
    bare = []
    for i, name in enumerate(settings.stations):
        for k, kind in enumerate(kinds):
            tai = epoch + np.round((time + OFFSET * i + 100.0 * k) * 1e6).astype("timedelta64[us]")
            bare.append(Observations(kind, name, name, tai, np.full((len(time), SIZES[kind]), _REFERENCE[kind])))
    model = OrbitModel(Tracking(tuple(bare)), settings, epoch, *start)
    above = {name: e > minimum_elevation for name, (_, e) in predicted_elevations(model).items()}
    if not any(np.any(a) for a in above.values()):
        raise MissingDataError("no station sees the satellite", where="[[stations]]",
                               limit=f"above {np.degrees(minimum_elevation):.1f} deg",
                               remedy="add a station, or check orbit and epoch")
    model = model.thinned(above)
    problem = orbit_problem(model, list(effects or {}))
    values = dict(problem.start)
    for name, value in (effects or {}).items():
        if name not in values:
            raise RequestError(f"{name} is not one effect but a family", where="effects", remedy="choose one of "
                               + ", ".join(e for e in problem.effects if e.split(":")[0] == name))
        given = np.atleast_1d(np.asarray(value, dtype=float))
        if given.shape != np.shape(values[name]):
            raise RequestError(f"{name} has another number of parameters", where="effects", value=given.size,
                               limit=", ".join(problem.unknown(name).manifold.labels()))
        values[name] = given
    random = np.random.default_rng(seed)
    seen = []
    for o, residual in zip(model.tracking.observations, problem.residuals, strict=True):
        assert isinstance(residual, KernelResidual)
        value = o.value - residual.linearize(values).residual
        if seed is not None:
            value = value + random.standard_normal(value.shape) * residual.standard_deviation
        if o.kind == "azimuth_elevation":
            value[:, 0] = np.mod(value[:, 0], 2 * np.pi)
        seen.append(replace(o, value=value))
    return Tracking(tuple(seen), dict(settings.stations))
