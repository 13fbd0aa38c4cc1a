"""The ONE joint nonlinear least-squares problem of a set of tracking data; see the package for the question.

``orbit_model(tracking, settings)`` prepares what does not depend on effects; ``orbit_problem(model, effects)`` makes
the
problem: ``position`` and ``velocity`` at the epoch, force parameters, velocity steps, biases, and the effects asked
for.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from estimator.losses import Loss, Quadratic
from estimator.models.earth_orientation import tai_from_utc
from estimator.models.errors import MissingDataError, TooFewDataError
from estimator.models.orbit_environment import EarthOrientation, SpaceEnvironment, eme2000_from_gcrs, read_bulletin_b
from estimator.models.orbit_gravity import gravity_field
from estimator.models.orbit_motion import (
    BURN,
    DRAG,
    MOON,
    SOLAR_PRESSURE,
    SUN,
    THRUST,
    Acceleration,
    Burn,
    constant_acceleration,
    motion,
    motion_inputs,
)
from estimator.models.ranging import COMPONENTS, UNITS, Signalling
from estimator.orbit_signal import OrbitArc, OrbitSignal, VelocityStep, position_unknown, velocity_unknown
from estimator.problem import Problem
from estimator.residuals import KernelResidual, Residual
from estimator.unknowns import Unknown, Vector
from problems.geo_orbit.effects import OrbitEffect, OrbitLayout, chosen, instances
from problems.geo_orbit.kernels import Correcting, measurement_data, measurement_kernel
from problems.geo_orbit.settings import OrbitSettings
from problems.geo_orbit.tracking import Observations, Station, Tracking

_BIAS_FIELDS = {
    "range": "range_bias",
    "range_rate": "range_rate_bias",
    "azimuth_elevation": "angle_bias",
    "direction_cosines": "angle_bias",
}
_BIAS_NAMES = {
    "range": "range-bias",
    "range_rate": "range-rate-bias",
    "azimuth_elevation": "angle-bias",
    "direction_cosines": "angle-bias",
}
_BIAS_SCALES = {"range": 1e4, "range_rate": 1.0, "azimuth_elevation": 0.01, "direction_cosines": 0.01}


@dataclass(frozen=True, eq=False)
class OrbitModel:
    """Tracking data with everything about them that does not depend on the effects in the model.

    Attributes:
        tracking: the observations.
        settings: checked settings.
        epoch: TAI, datetime64[us]; all seconds count from it.
        position, velocity: where to start, GCRS, m and m/s.
        loss: robust loss of every measurement.
        velocity_steps: times (s after the epoch) of velocity steps that are estimated.
        finite_burns: whether the motion carries derivatives along a thrust, which manoeuvres of finite length need.
    """

    tracking: Tracking
    settings: OrbitSettings
    epoch: np.datetime64
    position: np.ndarray
    velocity: np.ndarray
    loss: Loss = field(default_factory=Quadratic)
    velocity_steps: tuple[float, ...] = ()
    finite_burns: bool = False

    def seconds(self, tai: np.ndarray) -> np.ndarray:
        """Seconds after the epoch of TAI instants."""
        return (tai - self.epoch) / np.timedelta64(1, "us") * 1e-6

    def seconds_of_text(self, utc: str) -> float:
        """Seconds after the epoch of a UTC text."""
        return float(self.seconds(tai_from_utc([utc]))[0])

    @cached_property
    def span(self) -> tuple[float, float]:
        """First and last time tag, s after the epoch."""
        times = [self.seconds(o.time) for o in self.tracking.observations]
        return float(min(t.min() for t in times)), float(max(t.max() for t in times))

    @cached_property
    def orientation(self) -> EarthOrientation | None:
        """The user's bulletins, or None for the installed table."""
        return read_bulletin_b(self.settings.bulletins) if self.settings.bulletins else None

    @cached_property
    def environment(self) -> SpaceEnvironment:
        """Earth orientation, Sun and Moon over the span."""
        a, b = self.span
        return SpaceEnvironment(self.epoch, min(a, 0.0) - 600, max(b, 0.0) + 600, self.orientation)

    @cached_property
    def burns(self) -> tuple[Burn, ...]:
        """Commanded burns."""
        return self.settings.burns_after(self.seconds_of_text)

    def station(self, name: str) -> Station:
        """The station of that name.

        Raises:
            MissingDataError: the settings have none.
        """
        found = self.settings.stations.get(name)
        if found is None:
            raise MissingDataError(
                f"the data name the station {name!r}, which the settings do not have",
                where="[[stations]]",
                remedy="add its name, latitude_deg, longitude_deg, altitude_m",
            )
        return found

    def estimated_components(self, name: str) -> tuple[str, ...]:
        """Components whose bias is estimated at a station (or pair: its receiver)."""
        own = self.station(name).estimated_biases
        return own or self.settings.estimate_biases

    @cached_property
    def layout(self) -> OrbitLayout:
        """What the effects need to know."""
        s = self.settings
        kinds: dict[str, list[str]] = {}
        for o in self.tracking.observations:
            kinds.setdefault(o.receiver, []).append(o.kind)
        biased = tuple((name, tuple(c for c in self.estimated_components(name))) for name in kinds)
        return OrbitLayout(
            tuple((k, tuple(v)) for k, v in kinds.items()),
            self.span,
            s.gravity,
            s.degree,
            s.sun and s.moon,
            0.0 if s.reflection is None else s.reflection[0],
            bool(s.reflection and s.reflection[1]),
            bool(s.acceleration and s.acceleration[2]),
            len(s.burns),
            s.light_time,
            biased,
        )

    def thinned(self, keep: dict[str, np.ndarray]) -> OrbitModel:
        """The model with only the observations of the masks by residual name ("station/kind")."""
        observations = []
        for o in self.tracking.observations:
            mask = keep.get(f"{o.name}/{o.kind}", np.ones(len(o.time), dtype=bool))
            if mask.any():
                observations.append(o.subset(mask))
        return replace(self, tracking=replace(self.tracking, observations=tuple(observations)))


def celestial_start(
    settings: OrbitSettings, epoch: np.datetime64, orientation: EarthOrientation | None
) -> tuple[np.ndarray, np.ndarray] | None:
    """The settings' initial state in GCRS, or None where they have none."""
    if settings.position is None or settings.velocity is None:
        return None
    p, v = np.array(settings.position), np.array(settings.velocity)
    if settings.frame == "EME2000":
        turn = eme2000_from_gcrs().T
        return turn @ p, turn @ v
    if settings.frame == "ITRF":
        environment = SpaceEnvironment(epoch, -600.0, 600.0, orientation)
        rotation = environment.earth_fixed_from_celestial(np.zeros(1))[0]
        spin = np.array([0.0, 0.0, 7.292115146706979e-5])  # rad/s of the Earth
        return rotation.T @ p, rotation.T @ (v + np.cross(spin, p))
    return p, v


def orbit_model(tracking: Tracking, settings: OrbitSettings, *, loss: Loss | None = None) -> OrbitModel:
    """Prepare tracking data for the joint problem.

    Raises:
        TooFewDataError: fewer numbers than an orbit has unknowns.
        MissingDataError: a station of the data is not in the settings.
        InputError: bad input of any other kind; see :mod:`problems.geo_orbit.plausibility`.
    """
    from problems.geo_orbit.initial_orbit import initial_state
    from problems.geo_orbit.plausibility import check_observations, check_start

    numbers = sum(o.value.size for o in tracking.observations)
    if numbers < 6:
        raise TooFewDataError(
            "too few measurements for an orbit, which has six unknowns",
            value=f"{numbers} numbers",
            limit="at least 6",
            remedy="add measurements of other times or stations",
        )
    first = min(o.time.min() for o in tracking.observations)
    epoch = tai_from_utc([settings.epoch])[0] if settings.epoch else first
    orientation = read_bulletin_b(settings.bulletins) if settings.bulletins else None
    start = celestial_start(settings, epoch, orientation)
    bare = OrbitModel(tracking, settings, epoch, np.full(3, np.nan), np.full(3, np.nan), loss or Quadratic())
    check_observations(bare)
    if start is None:
        start = initial_state(bare)
    model = replace(
        bare,
        position=start[0],
        velocity=start[1],
        velocity_steps=tuple(sorted(bare.seconds_of_text(t) for t in settings.manoeuvre_times)),
    )
    if settings.position is not None or settings.tle is not None:
        check_start(model)
    return model


def _accelerations(model: OrbitModel) -> tuple[list[Acceleration], dict[str, np.ndarray], list[tuple[Unknown, str]]]:
    """Accelerations of the settings, the start values of their parameters, and the unknowns among them."""
    s = model.settings
    present: list[Acceleration] = []
    values: dict[str, np.ndarray] = {}
    unknowns: list[tuple[Unknown, str]] = []
    if s.sun:
        present.append(SUN)
    if s.moon:
        present.append(MOON)
    if s.reflection is not None:
        name = "solar-radiation-pressure-coefficient"
        present.append(replace(SOLAR_PRESSURE, name=name))
        values[name] = np.array([s.reflection[0]])
        if s.reflection[1]:
            unknowns.append((Unknown(name, Vector(1, ("coefficient",)), "1", 1.0), name))
    if s.drag is not None:
        name = "drag-coefficient"
        present.append(replace(DRAG, name=name))
        values[name] = np.array([s.drag[0]])
        if s.drag[1]:
            unknowns.append((Unknown(name, Vector(1, ("coefficient",)), "1", 2.0), name))
    if s.acceleration is not None:
        terms, frame, estimated = s.acceleration
        name = "constant-acceleration" + (":linear" if terms == 2 else "")
        present.append(constant_acceleration(name, linear=terms == 2, orbital=frame == "orbital"))
        values[name] = np.zeros(3 * terms)
        labels = ("x", "y", "z") if frame == "celestial" else ("radial", "along", "cross")
        if estimated:
            both = labels + tuple(f"{a} rate" for a in labels)
            unknowns.append(
                (
                    Unknown(
                        name,
                        Vector(3 * terms, both[: 3 * terms]),
                        "m/s2" if terms == 1 else "m/s2, m/s3",
                        (1e-4,) * 3 + (1e-8,) * (3 * terms - 3),
                        frame=frame,
                    ),
                    name,
                )
            )
    if s.burns:
        present.append(BURN)
    return present, values, unknowns


def effect_unknown(effect: OrbitEffect) -> Unknown:
    """The unknown that holds an effect's parameters."""
    units = tuple(dict.fromkeys(p.unit for p in effect.parameters))
    return Unknown(
        effect.name,
        Vector(len(effect.parameters), tuple(p.name for p in effect.parameters)),
        ", ".join(units),
        tuple(p.scale for p in effect.parameters),
        description=effect.reference,
    )


def effect_start(effect: OrbitEffect) -> np.ndarray:
    """Zero, or the middle of the range where a parameter is searched."""
    return np.array([0.0 if p.search is None else p.search.middle() for p in effect.parameters])


def orbit_problem(model: OrbitModel, effects: Sequence[str] = (), *, candidates: Sequence[str] = ()) -> Problem:
    """The joint problem of prepared tracking data.

    Args:
        model: the prepared data.
        effects: names of effects whose parameters are estimated with everything else.
        candidates: names of effects that are in the kernels and held at zero, for score tests.

    Raises:
        RequestError: an unknown effect.
    """
    estimated = chosen(model.layout, effects)
    dormant = tuple(e for e in chosen(model.layout, candidates) if e not in estimated)
    # Always in the library's order: the compiled equations then do not depend on which of them are estimated.
    order = {e.name: i for i, e in enumerate(instances(model.layout))}
    everything = tuple(sorted((*estimated, *dormant), key=lambda e: order[e.name]))
    s = model.settings
    present, values, force_unknowns = _accelerations(model)
    unknowns: dict[str, Unknown] = {}
    start: dict[str, np.ndarray] = {}

    def need(unknown: Unknown, value: np.ndarray) -> Unknown:
        unknowns.setdefault(unknown.name, unknown)
        start.setdefault(unknown.name, np.asarray(value, dtype=float))
        return unknown

    position, velocity = need(position_unknown(), model.position), need(velocity_unknown(), model.velocity)
    for unknown, name in force_unknowns:
        need(unknown, values[name])
    for e in everything:
        if e.channel == "force":
            assert e.acceleration is not None
            present.append(e.acceleration)
            values[e.name] = np.zeros(len(e.parameters))
            force_unknowns.append((need(effect_unknown(e), effect_start(e)), e.name))
    field_ = gravity_field(s.gravity, s.degree)
    if s.order < s.degree:
        field_ = field_.truncated(s.degree, s.order)
    active = [name for _, name in force_unknowns]
    if model.finite_burns:
        present.append(THRUST)
        active.append(THRUST.name)
    equations = motion(field_, present, active, s.area / s.mass)
    parameters = np.concatenate([np.zeros(0), *(values.get(a.name, np.zeros(a.size)) for a in present)])
    steps = []
    for number, time in enumerate(model.velocity_steps):
        unknown = need(
            Unknown(
                f"manoeuvre-{number + 1}",
                Vector(4, ("time", "radial", "along", "cross")),
                "s, m/s",
                (3600.0, 10.0, 10.0, 10.0),
            ),
            np.array([time, 0.0, 0.0, 0.0]),
        )
        steps.append(VelocityStep(unknown))
    for e in everything:
        if e.channel == "manoeuvre":
            steps.append(VelocityStep(need(effect_unknown(e), effect_start(e))))
    edges = tuple(t for b in model.burns for t in (b.start, b.stop))
    arc = OrbitArc(
        "orbit",
        equations,
        motion_inputs(model.environment, model.burns),
        0.0,
        model.span,
        position,
        velocity,
        tuple(force_unknowns),
        parameters,
        tuple(steps),
        edges,
        THRUST.name if model.finite_burns else "",
    )
    residuals: list[Residual] = []
    for o in model.tracking.observations:
        residuals.append(_residual(model, arc, o, everything, need))
    held = frozenset(e.name for e in dormant)
    return Problem(
        tuple(unknowns.values()),
        tuple(residuals),
        start,
        held,
        rebuild=lambda names: orbit_problem(model, names, candidates=candidates),
        effects=tuple(e.name for e in estimated),
    )


def _residual(
    model: OrbitModel,
    arc: OrbitArc,
    o: Observations,
    effects: Sequence[OrbitEffect],
    need: Callable[[Unknown, np.ndarray], Unknown],
) -> KernelResidual:
    s = model.settings
    receiver, transmitter = model.station(o.receiver), model.station(o.transmitter)
    same = o.receiver == o.transmitter
    time = model.seconds(o.time)
    components = COMPONENTS[o.kind]
    signalling = Signalling(s.time_tag, s.legs, s.troposphere, s.refraction, s.light_time)  # type: ignore[arg-type]
    bias = np.array([receiver.bias.get(c, 0.0) for c in components])
    correcting = []
    measured = np.array(o.value, dtype=float)
    if o.kind == "range":
        measured = measured - s.onboard_range_bias
    if any(c in model.estimated_components(o.receiver) for c in components):
        unknown = Unknown(
            f"{_BIAS_NAMES[o.kind]}:{o.name}", Vector(len(components), components), UNITS[o.kind], _BIAS_SCALES[o.kind]
        )
        correcting.append(Correcting(need(unknown, bias), _BIAS_FIELDS[o.kind]))
    else:
        measured = measured - bias
    for e in effects:
        if e.channel == "measurement" and o.kind in e.kinds and e.station in ("", o.receiver):
            if e.each and o.receiver not in e.each:
                continue
            component = e.each.index(o.receiver) if e.each else None
            correcting.append(Correcting(need(effect_unknown(e), effect_start(e)), e.correction, component))
    kernel = measurement_kernel(o.kind, signalling, same, correcting)
    sigma = np.array([receiver.sigma.get(c, s.sigma[c]) for c in components])
    data = {"measured": measured, **measurement_data(model.environment, time, transmitter, receiver)}
    return KernelResidual(
        f"{o.name}/{o.kind}",
        o.kind,
        UNITS[o.kind],
        kernel,
        (OrbitSignal("state", arc, time),),
        data,
        np.tile(sigma, (len(time), 1)),
        time,
        np.zeros(len(time), dtype=int),
        (o.name,),
        loss=model.loss,
    )
