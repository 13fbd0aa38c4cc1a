"""Alignment campaigns with known truth, from equations of their own (see :mod:`problems.alignment.simulation`).

Example:
    >>> from problems.alignment.simulator import preset, simulate
    >>> campaign, truth = simulate(preset("compact"), seed=1)
    >>> campaign.doppler.frequency_shift.shape[1]
    3
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.effects.declaration import Layout
from estimator.models.errors import RequestError
from problems.alignment.campaign import (
    Arc,
    ArcKind,
    Campaign,
    Covariate,
    DopplerSeries,
    GnssSeries,
    Nominal,
    TorqueCommands,
    TrackerSeries,
)
from problems.alignment.simulation import sensors
from problems.alignment.simulation.effects import (
    ActiveEffect,
    EffectChoice,
    Environment,
    TorqueEffects,
    activate,
    argument_of_latitude,
    contributions,
    parse_effects,
)
from problems.alignment.simulation.orbit import GRAVITATIONAL_PARAMETER, Orbit, initial_state, integrate_orbit
from problems.alignment.simulation.pointing import Session, profile_spline
from problems.alignment.simulation.rotation import integrate_arc, moving_body
from problems.alignment.simulation.scenario import PRESETS, Scenario, preset
from problems.alignment.simulation.truth import ArcState, Truth

__all__ = ["PRESETS", "Scenario", "Truth", "parse_effects", "preset", "simulate"]

SPEED_OF_LIGHT = 299792458.0  # [m/s]
_MARGIN = 300.0  # [s] of orbit before the first and after the last sample

Motion = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""time (n,) to ``tracker_from_inertial`` matrices (n, 3, 3) and rates (n, 3) rad/s in tracker axes."""


class _Draws:
    """One stream of random numbers for each purpose, so that a change in one leaves the others as they were."""

    purposes = ("orbit", "mounting", "inertia", "sessions", "free", "pulses", "gnss", "gnss_epochs", "star_tracker",
                "star_tracker_epochs", "doppler", "doppler_epochs", "gnss_outliers", "star_tracker_outliers",
                "doppler_outliers", "gnss_accuracy", "star_tracker_accuracy", "doppler_accuracy", "housekeeping")

    def __init__(self, seed: int):
        self.seed = seed

    def __getitem__(self, purpose: str) -> np.random.Generator:
        return np.random.default_rng([self.seed, self.purposes.index(purpose)])


@dataclass
class _World:
    """The true world of one campaign while it is being made."""

    scenario: Scenario
    draws: _Draws
    orbit: Orbit
    antenna_from_tracker: np.ndarray
    actuator_from_tracker: np.ndarray
    inertia: np.ndarray
    arcs: tuple[Arc, ...]
    environment: Environment
    active: tuple[ActiveEffect, ...] = ()
    motions: dict[str, Motion] = field(default_factory=dict)
    outliers: dict[str, np.ndarray] = field(default_factory=dict)

    def of_channel(self, channel: str) -> list[ActiveEffect]:
        return [e for e in self.active if e.instance.channel == channel]


def simulate(
    scenario: Scenario,
    seed: int,
    effects: EffectChoice | None = None,
) -> tuple[Campaign, Truth]:
    """One campaign and its truth; the same arguments give the same campaign.

    Args:
        scenario: every number of the campaign, see :func:`preset`.
        seed: of the random numbers, not negative. Each purpose has its own stream: with the same seed, a campaign with
            and without an effect has the same noise.
        effects: the effects that are true, by name, with values in SI units in the order of the declaration (one
            number, a sequence, or a mapping by parameter; None for the values that physics demands). A key may also
            be an :class:`~estimator.effects.declaration.EffectInstance` that no library holds. Without any, a free
            rotation is torque-free and only the commanded torque acts in a pulse.

    Returns:
        The campaign as measured, and the truth.

    Raises:
        RequestError: arcs that do not fit into the campaign, an unknown effect, a wrong number of values.
        NotFiniteError: a value of an effect is NaN or infinite.
    """
    if seed < 0:
        raise RequestError("the seed is negative", where="seed", value=seed, limit="0 or more")
    world = _world(scenario, _Draws(int(seed)))
    world.active = activate(effects or {}, _layout(world))
    torque = _commands(world)
    rotation = TorqueEffects(world.active, world.environment, world.inertia, world.actuator_from_tracker)
    arc_states = _set_in_motion(world, torque, rotation)
    campaign = _measure(world, torque)
    return campaign, _truth(world, campaign, int(seed), arc_states, rotation)


def _matrix(quaternion: np.ndarray) -> np.ndarray:
    """Matrix (..., 3, 3) that takes coordinates from y to x, of the quaternion x_from_y (..., 4)."""
    return np.asarray(Rotation.from_quat(quaternion, scalar_first=True).as_matrix())


def _unit(quaternion: tuple[float, ...]) -> np.ndarray:
    return np.asarray(quaternion) / np.linalg.norm(quaternion)


def _world(scenario: Scenario, draws: _Draws) -> _World:
    draw = draws["orbit"]
    full_turn = 2.0 * np.pi
    drawn = draw.uniform(0.0, full_turn, 4)
    given = (scenario.ascending_node, scenario.argument_of_perigee, scenario.true_anomaly,
             scenario.earth_rotation_angle_at_epoch)
    node, perigee, anomaly, angle = (float(d) if g is None else g for d, g in zip(drawn, given, strict=True))
    state = initial_state(scenario.semi_major_axis, scenario.eccentricity, scenario.inclination, node, perigee, anomaly)
    orbit = integrate_orbit(state, (-_MARGIN, scenario.duration + _MARGIN), scenario.zonal_coefficients, angle,
                            scenario.earth_rotation_rate)
    errors = Rotation.from_rotvec(scenario.mounting_spread * draws["mounting"].standard_normal((2, 3)))
    mountings = [
        np.asarray((error * Rotation.from_quat(nominal, scalar_first=True)).as_quat(canonical=True, scalar_first=True))
        for error, nominal in zip(errors, (scenario.antenna_from_tracker, scenario.actuator_from_tracker), strict=True)
    ]
    inertia = moving_body(np.array(scenario.inertia), scenario.inertia_spread, draws["inertia"])
    arcs = _schedule(scenario)
    spans = [(a.start, a.stop) for a in arcs if a.kind != "doppler"]
    return _World(scenario, draws, orbit, mountings[0], mountings[1], inertia, arcs,
                  Environment(orbit, scenario.epoch, spans, scenario.duration))


def _schedule(scenario: Scenario) -> tuple[Arc, ...]:
    """Doppler sessions spread over the first part, then the free rotations, then the torque pulses.

    Raises:
        RequestError: the arcs do not fit.
    """
    settle = min(300.0, 0.05 * scenario.duration)  # [s]
    lengths = [(f"free-{k + 1}", "free_rotation", scenario.free_duration, scenario.free_spacing)
               for k in range(scenario.free_arcs)]
    lengths += [(f"torque-{k + 1}", "torque_pulse", scenario.pulse_duration, scenario.pulse_spacing)
                for k in range(len(scenario.pulse_axes))]
    start = scenario.duration - settle / 3.0 - sum(length + spacing for _, _, length, spacing in lengths)
    start = float(np.floor(start))
    first, last = float(np.floor(settle)), start - settle / 3.0 - scenario.session_duration
    arcs: list[tuple[str, ArcKind, float, float]] = []
    count = scenario.doppler_sessions
    room = last - first if count else start
    needed = max(count - 1, 0) * (scenario.session_duration + 1.0)
    if room < needed:
        raise RequestError("the arcs do not fit into the campaign", where="scenario.duration",
                           value=f"{scenario.duration:.0f} s",
                           limit=f"about {scenario.duration - room + needed:.0f} s",
                           remedy="make the campaign longer, or its arcs fewer or shorter")
    for k, begin in enumerate(np.linspace(first, last, count)):
        begin = float(np.floor(begin))
        arcs.append((f"doppler-{k + 1}", "doppler", begin, begin + scenario.session_duration))
    for name, kind, length, spacing in lengths:
        arcs.append((name, kind, start, start + length))  # type: ignore[arg-type]
        start += length + spacing
    return tuple(Arc(*a) for a in arcs)


def _layout(world: _World) -> Layout:
    scenario = world.scenario
    sessions = tuple((a.start, a.stop) for a in world.arcs if a.kind == "doppler")
    period = 2.0 * np.pi * np.sqrt(scenario.semi_major_axis**3 / GRAVITATIONAL_PARAMETER)
    ends = [t for a in world.arcs for t in (a.start, a.stop)] or [0.0, scenario.duration]
    return Layout(beams=scenario.beams, sessions=sessions, span=(0.0, scenario.duration), orbital_period=float(period),
                  tracker_span=(min(ends), max(ends)),
                  beam_directions=tuple((float(x), float(y), float(z)) for x, y, z in _beams(scenario)))


def _commands(world: _World) -> list[tuple[str, float, float, np.ndarray]]:
    """Segments of constant torque: (arc, start, stop, command (3) N m in actuator axes)."""
    arcs = [a for a in world.arcs if a.kind == "torque_pulse"]
    result = []
    for arc, axis in zip(arcs, world.scenario.pulse_axes, strict=True):
        given = world.scenario.pulse_directions
        direction = np.array(given[arcs.index(arc)]) if given else np.eye(3)[axis]
        for start, stop, size in world.scenario.pulse_segments:
            result.append((arc.name, arc.start + start, arc.start + stop, size * direction))
    return result


def _set_in_motion(
    world: _World, torque: list[tuple[str, float, float, np.ndarray]], rotation: TorqueEffects
) -> dict[str, ArcState]:
    """Give every arc its true motion; returns the states at the start of the rotation arcs."""
    scenario = world.scenario
    session_draw, free_draw, pulse_draw = (world.draws[p] for p in ("sessions", "free", "pulses"))
    tracker_from_antenna = _matrix(_unit(scenario.antenna_from_tracker)).T
    given_rates = iter(scenario.free_initial_rates)
    states: dict[str, ArcState] = {}
    for arc in world.arcs:
        if arc.kind == "doppler":
            offset = np.asarray(scenario.pointing_spread) * session_draw.standard_normal(3)
            offset[0] += scenario.look_angle
            world.motions[arc.name] = Session(
                arc.start, offset, np.asarray(scenario.slew_amplitude), session_draw.uniform(*scenario.slew_period, 3),
                session_draw.uniform(0.0, 2.0 * np.pi, 3), tracker_from_antenna, world.orbit,
                profile_spline(np.array(scenario.slew_profile), scenario.session_duration)
                if scenario.slew_profile else None)
            continue
        free = arc.kind == "free_rotation"
        draw = free_draw if free else pulse_draw
        attitude = sensors.random_matrix(draw)
        rate = _tumbling(world, draw) if free else scenario.pulse_initial_rate * draw.standard_normal(3)
        if free and scenario.free_initial_rates:
            rate = np.array(next(given_rates))
        segments = [(start, stop, command) for name, start, stop, command in torque if name == arc.name]
        motion = integrate_arc(arc.start, arc.stop, attitude.T, rate, world.inertia, segments,
                               rotation.right_side(arc.start, arc.stop), rotation.states)
        world.motions[arc.name] = motion
        states[arc.name] = ArcState(sensors.quaternions(attitude[None])[0], rate)
    return states


def _tumbling(world: _World, draw: np.random.Generator) -> np.ndarray:
    """Rate (3) of the asked size, away from the principal axes: a spin about one of them shows no ratio of moments."""
    _, axes = np.linalg.eigh(world.inertia)
    limit = np.cos(world.scenario.free_axis_clearance)
    while True:
        direction = sensors.directions(1, draw)[0]
        if np.max(np.abs(direction @ axes)) <= limit:
            return np.asarray(world.scenario.free_rate * direction)


def _motion(world: _World, time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Quaternion ``tracker_from_inertial`` (n, 4), rate (n, 3), and 1 inside arcs (n, 1), at increasing times.

    Outside arcs the quaternion is (1, 0, 0, 0), the rate and the mark are zero.
    """
    attitude = np.zeros((len(time), 4))
    attitude[:, 0] = 1.0
    rate = np.zeros((len(time), 3))
    inside = np.zeros((len(time), 1))
    for arc in world.arcs:
        first, last = np.searchsorted(time, arc.start, "left"), np.searchsorted(time, arc.stop, "right")
        if first < last:
            matrix, rate[first:last] = world.motions[arc.name](time[first:last])
            attitude[first:last] = sensors.quaternions(matrix)
            inside[first:last] = 1.0
    return attitude, rate, inside


def _measure(world: _World, torque: list[tuple[str, float, float, np.ndarray]]) -> Campaign:
    scenario = world.scenario
    commands = None
    if torque:
        commands = TorqueCommands(np.array([s for _, s, _, _ in torque]), np.array([s for _, _, s, _ in torque]),
                                  np.array([c for *_, c in torque]))
    tracker, doppler_times = _tracker(world)
    return Campaign(
        title=scenario.title,
        epoch=scenario.epoch,
        earth_rotation_angle_at_epoch=world.orbit.earth_rotation_angle_at_epoch,
        earth_rotation_rate=scenario.earth_rotation_rate,
        gnss=_gnss(world),
        star_tracker=tracker,
        doppler=_doppler(world, doppler_times),
        torque=commands,
        arcs=world.arcs,
        nominal=Nominal(_unit(scenario.antenna_from_tracker), _unit(scenario.actuator_from_tracker),
                        np.array(scenario.inertia)),
        housekeeping=_housekeeping(world) if scenario.housekeeping else {},
    )


def _gnss(world: _World) -> GnssSeries:
    scenario = world.scenario
    time = sensors.epochs(0.0, scenario.duration, scenario.gnss_step, scenario.gnss_jitter, world.draws["gnss_epochs"])
    time = time[sensors.outside(time, scenario.gnss_gaps)]
    position, _ = world.orbit.inertial(time)
    position = world.orbit.to_earth_fixed(time, position)
    if effects := world.of_channel("gnss"):
        sampled = {}
        if any({"attitude", "rate", "inside_arc"} & set(e.used) for e in effects):
            attitude, rate, inside = _motion(world, time)
            sampled = {"attitude": attitude, "rate": rate, "inside_arc": inside}
        position += contributions(effects, world.environment, time, 3, {}, sampled)
    deviation = sensors.standard_deviations(scenario.gnss_noise, position.shape, scenario.noise_variation,
                                            world.draws["gnss_accuracy"])
    noise = world.draws["gnss"].standard_normal(position.shape)
    noise *= deviation
    position += scenario.gnss_noise_factor * noise
    draw = world.draws["gnss_outliers"]
    wrong = sensors.chosen(len(time), scenario.gnss_outlier_fraction, draw)
    size = sensors.sizes(len(wrong), scenario.outlier_size, draw)[:, None] * deviation[wrong]
    position[wrong] += size * sensors.directions(len(wrong), draw)
    world.outliers["gnss"] = wrong
    return GnssSeries(time, position, deviation)


def _tracker(world: _World) -> tuple[TrackerSeries, np.ndarray]:
    """The star tracker's series, and the epochs of the Doppler samples (which share its scatter where they can)."""
    scenario = world.scenario
    draw, doppler_draw = world.draws["star_tracker_epochs"], world.draws["doppler_epochs"]
    every = round(scenario.doppler_step / scenario.star_tracker_step)
    together = (abs(every * scenario.star_tracker_step - scenario.doppler_step) < 1e-9 and every >= 1
                and scenario.doppler_time_offset == 0.0 and scenario.doppler_jitter == 0.0)
    times, attitudes, rates, doppler_times = [], [], [], []
    for arc in sorted(world.arcs, key=lambda a: a.start):
        time = sensors.epochs(arc.start, arc.stop, scenario.star_tracker_step, scenario.star_tracker_jitter, draw)
        if arc.kind == "doppler":
            begin = arc.start + scenario.doppler_time_offset
            own = sensors.epochs(begin, arc.stop, scenario.doppler_step, scenario.doppler_jitter, doppler_draw)
            doppler_times.append(time[::every] if together else own)
        attitude, rate = world.motions[arc.name](time)
        times.append(time)
        attitudes.append(attitude)
        rates.append(rate)
    doppler = np.concatenate(doppler_times) if doppler_times else np.zeros(0)
    doppler = doppler[sensors.outside(doppler, scenario.doppler_gaps)]
    if not times:
        return TrackerSeries(np.zeros(0), np.zeros((0, 4)), np.zeros((0, 3))), doppler
    time, attitude, rate = np.concatenate(times), np.concatenate(attitudes), np.concatenate(rates)
    keep = sensors.outside(time, scenario.star_tracker_gaps)
    time, attitude, rate = time[keep], attitude[keep], rate[keep]
    if effects := world.of_channel("star_tracker"):
        sampled = {"attitude": sensors.quaternions(attitude), "rate": rate}
        attitude = sensors.turned(attitude, contributions(effects, world.environment, time, 3, {}, sampled))
    deviation = sensors.standard_deviations(np.asarray(scenario.star_tracker_noise), (len(time), 3),
                                            scenario.noise_variation, world.draws["star_tracker_accuracy"])
    noise = scenario.star_tracker_noise_factor * deviation * world.draws["star_tracker"].standard_normal((len(time), 3))
    outlier_draw = world.draws["star_tracker_outliers"]
    wrong = sensors.chosen(len(time), scenario.star_tracker_outlier_fraction, outlier_draw)
    size = sensors.sizes(len(wrong), scenario.outlier_size, outlier_draw)[:, None] * deviation[wrong]
    noise[wrong] += size * sensors.directions(len(wrong), outlier_draw)
    world.outliers["star_tracker"] = wrong
    return TrackerSeries(time, sensors.quaternions(sensors.turned(attitude, noise)), deviation), doppler


def _beams(scenario: Scenario) -> np.ndarray:
    """Unit vectors (beams, 3) in antenna axes, spread evenly over the cone about +z, the first in the y-z plane."""
    azimuth = 0.5 * np.pi + 2.0 * np.pi * np.arange(scenario.beams) / scenario.beams
    across = np.sin(scenario.beam_cone)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth),
                     np.full(scenario.beams, np.cos(scenario.beam_cone))], axis=1)


def _doppler(world: _World, time: np.ndarray) -> DopplerSeries | None:
    scenario = world.scenario
    if len(time) == 0:
        return None
    beams = _beams(scenario)
    attitude, rate, _ = _motion(world, time)
    position, velocity = world.orbit.inertial(time)
    relative = world.orbit.relative_velocity(position, velocity)
    # The beams are carried into inertial axes, where the velocity is.
    inertial_from_antenna = np.swapaxes(_matrix(attitude), 1, 2) @ _matrix(world.antenna_from_tracker).T
    carried = np.einsum("nij,bj->nbi", inertial_from_antenna, beams)
    shift = 2.0 * scenario.carrier_frequency / SPEED_OF_LIGHT * np.einsum("nbi,ni->nb", carried, relative)
    if effects := world.of_channel("doppler"):
        constant = {"antenna_from_tracker": world.antenna_from_tracker, "beam_direction": beams,
                    "carrier_frequency": np.array([scenario.carrier_frequency])}
        sampled = {"attitude": attitude, "rate": rate}
        shift = shift + contributions(effects, world.environment, time, scenario.beams, constant, sampled)
    deviation = sensors.standard_deviations(scenario.doppler_noise, shift.shape, scenario.noise_variation,
                                            world.draws["doppler_accuracy"])
    shift = shift + scenario.doppler_noise_factor * deviation * world.draws["doppler"].standard_normal(shift.shape)
    draw = world.draws["doppler_outliers"]
    wrong = np.stack(np.unravel_index(sensors.chosen(shift.size, scenario.doppler_outlier_fraction, draw), shift.shape))
    sign = np.where(draw.random(wrong.shape[1]) < 0.5, -1.0, 1.0)
    size = sign * sensors.sizes(wrong.shape[1], scenario.outlier_size, draw)
    shift[wrong[0], wrong[1]] += size * deviation[wrong[0], wrong[1]]
    world.outliers["doppler"] = wrong.T
    return DopplerSeries(time, shift, deviation, beams, scenario.carrier_frequency)


def _housekeeping(world: _World) -> dict[str, Covariate]:
    """Telemetry that swings with the orbit: the antenna's temperature and the current of its heater."""
    draw = world.draws["housekeeping"]
    time = np.arange(0.0, world.scenario.duration + 1e-9, 30.0)  # [s]
    phase = argument_of_latitude(*world.orbit.inertial(time))
    temperature = 291.0 + 14.0 * np.cos(phase - draw.uniform(0.0, 2.0 * np.pi))  # [K]
    current = 0.4 + 0.3 * (temperature < 283.0)  # [A]
    return {
        "antenna_temperature": Covariate(time, temperature + 0.2 * draw.standard_normal(len(time)), "K"),
        "heater_current": Covariate(time, current + 0.01 * draw.standard_normal(len(time)), "A"),
    }


def _truth(world: _World, campaign: Campaign, seed: int, arc_states: dict[str, ArcState],
           rotation: TorqueEffects) -> Truth:
    scenario = world.scenario

    def attitude(time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        asked = np.asarray(time, dtype=float)
        order = np.argsort(asked, kind="stable")
        back = np.argsort(order, kind="stable")
        quaternion, rate, inside = (part[back] for part in _motion(world, asked[order]))
        if not inside.all():
            raise RequestError("the true attitude is known inside arcs alone", where="time",
                               value=float(asked[inside[:, 0] == 0.0][0]), limit="a time inside an arc")
        return quaternion, rate

    return Truth(
        seed=seed,
        scenario=scenario,
        antenna_from_tracker=world.antenna_from_tracker,
        actuator_from_tracker=world.actuator_from_tracker,
        inertia=world.inertia,
        torque_map_over_inertia_trace=rotation.command_map() / np.trace(world.inertia),
        effects={e.instance.name: e.parameters() for e in world.active},
        arc_states=arc_states,
        orbit_state=world.orbit.start_state,
        earth_rotation_angle_at_epoch=campaign.earth_rotation_angle_at_epoch,
        noise={"gnss": scenario.gnss_noise_factor * scenario.gnss_noise,
               "doppler": scenario.doppler_noise_factor * scenario.doppler_noise,
               "tracker": scenario.star_tracker_noise_factor * np.asarray(scenario.star_tracker_noise)},
        outliers=world.outliers,
        trajectory=world.orbit.earth_fixed,
        inertial_state=world.orbit.inertial,
        attitude=attitude,
    )
