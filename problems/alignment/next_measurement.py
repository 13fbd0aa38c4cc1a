"""Which measurement would tell the names of a group apart: planned arcs, and the separation that each would bring.

The arcs are what an operator can ask for: a free rotation about an axis, a torque pulse on one actuator axis, a Doppler
pass with another attitude or at another phase of the orbit. Each is simulated by kinematics of its own along the orbit
carried on from the campaign's end, with the campaign's own noise and sampling, and its information is added to the
campaign's. Separation of two names: let the first be true at its fitted size, fit everything with the second instead;
the root of the sum of squares that is left is the separation in sigmas. The worse of the two directions counts, and
of a larger group the worst pair.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise, permutations
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from estimator.effects.declaration import EffectInstance
from estimator.models.inertia import matrix_of
from estimator.problem import Problem
from estimator.residuals import Linearization
from estimator.unknowns import offsets
from problems.alignment.campaign import Arc, DopplerSeries, GnssSeries, TorqueCommands, TrackerSeries
from problems.alignment.problem import AlignmentModel, alignment_problem
from problems.alignment.starting_point import StartingPoint

GRAVITATIONAL_PARAMETER = 3.986004418e14  # m3/s2, of the Earth
EARTH_RADIUS = 6378137.0  # m
OBLATENESS = 1.08262668e-3  # J2 of the Earth
SHARED = ("antenna_from_tracker", "actuator_from_tracker", "normalized_inertia", "inertia_trace")
ENOUGH = 4.0  # sigma of separation that settles a name
MARGIN = 240.0  # s of positions before and after a planned arc
WAIT = 600.0  # s between the end of the campaign and the first planned arc
DEGREE = np.pi / 180

Values = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Option:
    """One arc that can be asked for.

    Attributes:
        kind: "free_rotation", "torque_pulse" or "doppler".
        words: what to ask for, a noun phrase.
        start, duration: s after the epoch; s.
        rate: (3,) rad/s, tracker axes, at the start of a free rotation.
        axis: actuator axis of a pulse.
        torque: N m of a pulse: plus for a quarter of the arc, minus for the next, half as much in the last quarter.
        offset: (3,) rotation vector in antenna axes from the campaign's usual attitude in a Doppler pass, rad.
        swing: (3,) rad, amplitude of a slow turn about the same axes over the pass.
    """

    kind: str
    words: str
    start: float
    duration: float
    rate: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axis: int = 0
    torque: float = 0.0
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    swing: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Prospect:
    """An option with the separation (sigma) of the group that the campaign and it would reach together."""

    option: Option
    separation: float


@dataclass(frozen=True)
class Advice:
    """The measurement that separates a group best.

    Attributes:
        group: the names.
        now: separation in sigma of the worst pair in the data at hand.
        prospects: every option looked at, the best first.
    """

    group: tuple[str, ...]
    now: float
    prospects: tuple[Prospect, ...]

    @property
    def best(self) -> Prospect:
        """The option with the largest separation."""
        return self.prospects[0]

    @property
    def sentence(self) -> str:
        """What to measure next, with the predicted separation in sigma."""
        names = ", ".join(self.group[:-1]) + " and " + self.group[-1]
        best = self.best
        sentence = (f"{best.option.words} would separate {names} by {best.separation:.1f} sigma "
                    f"(these data: {self.now:.1f} sigma)")
        gained = best.separation**2 - self.now**2
        if best.separation < ENOUGH:
            if gained < 0.05 * ENOUGH**2:
                return (f"no single arc that can be asked for separates {names}: the best, {best.option.words}, would "
                        f"reach {best.separation:.1f} sigma (these data: {self.now:.1f} sigma)")
            repeats = int(np.ceil((ENOUGH**2 - self.now**2) / gained))
            sentence += f"; {repeats} of them would reach {ENOUGH:.0f} sigma"
        return sentence

    def as_list(self) -> list[dict[str, Any]]:
        """Every option with its separation, for the machine-readable answer."""
        return [{"measurement": p.option.words, "kind": p.option.kind, "start": p.option.start,
                 "duration": p.option.duration, "separation_sigma": p.separation} for p in self.prospects]


# ---------------------------------------------------------------------------------------------------- information


@dataclass(frozen=True, eq=False)
class _Information:
    """Gram matrix of whitened rows over shared unknowns and effects, everything else eliminated.

    ``labels`` say for each column to which unknown it belongs; a label with a leading ``*`` is the signature of that
    effect at its fitted size (one column).
    """

    labels: tuple[str, ...]
    matrix: np.ndarray


def _information(problem: Problem, parts: Sequence[Linearization], effects: Mapping[str, EffectInstance],
                 sizes: Mapping[str, np.ndarray]) -> _Information:
    """Reduce a linearization; ``sizes`` are the fitted parameters of the effects that have a signature column."""
    columns = offsets(problem.unknowns)
    total = sum(u.manifold.tangent for u in problem.unknowns)
    scales = np.concatenate([u.scales for u in problem.unknowns])
    signatures = [n for n in sizes if n in columns]
    gram = np.zeros((total + len(signatures), total + len(signatures)))
    combine = np.zeros((total, len(signatures)))
    for k, name in enumerate(signatures):
        ordinary = np.array([p.search is None for p in effects[name].parameters])
        width = columns[name].stop - columns[name].start
        if width == len(sizes[name]):
            combine[columns[name], k] = np.where(ordinary, sizes[name], 0.0) / scales[columns[name]]
    for part in parts:
        rows = np.zeros((part.whitened.size, total))
        root = np.sqrt(part.weight)
        position = 0
        for u in part.columns:
            w = u.manifold.tangent
            piece = part.jacobian[:, :, position : position + w] * root[:, None, None] * u.scales
            rows[:, columns[u.name]] = piece.reshape(len(rows), w)
            position += w
        rows = np.concatenate([rows, rows @ combine], axis=1)
        gram += rows.T @ rows
    own = [u.name for u in problem.unknowns if u.name not in SHARED and u.name not in effects]
    held = {"inertia_trace"} & set(problem.held)
    eliminated = np.concatenate([np.zeros(0, dtype=int), *(np.arange(columns[n].start, columns[n].stop) for n in own)])
    places: list[int] = []
    labels: list[str] = []
    for u in problem.unknowns:
        if u.name in own or u.name in held:
            continue
        places += list(range(columns[u.name].start, columns[u.name].stop))
        labels += [u.name] * u.manifold.tangent
    kept = np.array([*places, *range(total, total + len(signatures))], dtype=int)
    labels += ["*" + n for n in signatures]
    inner = gram[np.ix_(eliminated, eliminated)] + 1e-9 * np.eye(len(eliminated))
    cross = gram[np.ix_(eliminated, kept)]
    reduced = gram[np.ix_(kept, kept)] - cross.T @ np.linalg.solve(inner, cross)
    return _Information(tuple(labels), 0.5 * (reduced + reduced.T))


def _sum(parts: Sequence[_Information]) -> _Information:
    """Add what several data sets say; columns of one unknown are matched by name and place."""
    keys: dict[tuple[str, int], int] = {}
    placed = []
    for part in parts:
        seen: dict[str, int] = {}
        index: list[int] = []
        for label in part.labels:
            key = (label, seen.get(label, 0))
            seen[label] = key[1] + 1
            index.append(keys.setdefault(key, len(keys)))
        placed.append(np.array(index, dtype=int))
    matrix = np.zeros((len(keys), len(keys)))
    for part, place in zip(parts, placed, strict=True):
        matrix[np.ix_(place, place)] += part.matrix
    return _Information(tuple(label for label, _ in keys), matrix)


def separation(information: Sequence[_Information], group: Sequence[str], rest: Sequence[str]) -> float:
    """Sigma by which the data tell the names of a group apart, worst pair, worse direction."""
    whole = _sum(information)
    labels = np.array(whole.labels)
    worst = np.inf
    for truth, taken in permutations(group, 2):
        mine = np.flatnonzero(labels == "*" + truth)
        if not len(mine):
            continue
        others = np.flatnonzero(np.isin(labels, [*SHARED, *rest, taken]))
        block = whole.matrix[np.ix_(others, others)] + 1e-9 * np.eye(len(others))
        cross = whole.matrix[others, mine[0]]
        left = whole.matrix[mine[0], mine[0]] - cross @ np.linalg.solve(block, cross)
        worst = min(worst, float(np.sqrt(max(left, 0.0))))
    return worst if np.isfinite(worst) else 0.0


# ---------------------------------------------------------------------------------------------------- planned arcs


@dataclass(frozen=True, eq=False)
class _PlannedModel(AlignmentModel):
    """A planned campaign, whose starting point is known because it was planned."""

    known: StartingPoint | None = None

    @cached_property
    def start(self) -> StartingPoint:
        assert self.known is not None
        return self.known


class _Orbit:
    """The orbit carried on after the campaign's end (Earth's point mass and oblateness)."""

    def __init__(self, model: AlignmentModel, stop: float):
        self.model = model
        # The fitted velocity is best a little inside the data.
        first, last = float(model.campaign.gnss.time[0]), float(model.campaign.gnss.time[-1])
        self.epoch = last - min(60.0, 0.1 * (last - first))
        at = np.array([self.epoch])
        turn = self._inertial_from_fixed(at)
        spin = np.array([0.0, 0.0, model.campaign.earth_rotation_rate])
        fixed = model.position(at)[0]
        state = np.concatenate([turn.apply(fixed)[0], turn.apply(model.velocity(at)[0] + np.cross(spin, fixed))[0]])
        self._solution = solve_ivp(self._derivative, (self.epoch, stop + 1.0), state, method="DOP853", rtol=1e-10,
                                   atol=1e-4, dense_output=True).sol

    @staticmethod
    def _derivative(_: float, state: np.ndarray) -> np.ndarray:
        position = state[:3]
        radius = np.linalg.norm(position)
        ratio = 5 * (position[2] / radius) ** 2
        factor = 1.5 * OBLATENESS * (EARTH_RADIUS / radius) ** 2
        flattened = position * (1 + factor * (np.array([1.0, 1.0, 3.0]) - ratio))
        return np.concatenate([state[3:], -GRAVITATIONAL_PARAMETER / radius**3 * flattened])

    def _inertial_from_fixed(self, time: np.ndarray) -> Rotation:
        angle = self.model.earth_angle(time)
        return Rotation.from_rotvec(np.column_stack([0 * angle, 0 * angle, angle]))

    def inertial(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Position (n, 3) m and velocity (n, 3) m/s."""
        state = self._solution(np.asarray(time)).T
        return state[:, :3], state[:, 3:]

    def earth_fixed(self, time: np.ndarray) -> np.ndarray:
        """Earth-fixed position (n, 3) m."""
        return np.asarray(self._inertial_from_fixed(time).inv().apply(self.inertial(time)[0]))

    def relative_velocity(self, time: np.ndarray) -> np.ndarray:
        """Velocity against the rotating Earth (n, 3) m/s, inertial axes."""
        position, velocity = self.inertial(time)
        return velocity - np.cross([0.0, 0.0, self.model.campaign.earth_rotation_rate], position)


def _orbital_axes(position: np.ndarray, velocity: np.ndarray) -> Rotation:
    """``orbit_from_inertial`` with x along the velocity, y against the orbit's normal, z down."""
    down = -position / np.linalg.norm(position, axis=1, keepdims=True)
    across = np.cross(down, velocity)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return Rotation.from_matrix(np.stack([np.cross(across, down), across, down], axis=1))


def _rotation(quaternion: np.ndarray) -> Rotation:
    return Rotation.from_quat(quaternion, scalar_first=True)


def _usual_attitude(model: AlignmentModel) -> Rotation:
    """``tracker_from_orbit`` in the middle of the first Doppler session, or of the tracker's data without one."""
    tracker = model.campaign.star_tracker
    sessions = model.campaign.arcs_of_kind("doppler")
    middle = 0.5 * (sessions[0].start + sessions[0].stop) if sessions else float(tracker.time[len(tracker.time) // 2])
    nearest = int(np.argmin(np.abs(tracker.time - middle)))
    at = np.clip(tracker.time[nearest : nearest + 1], model.campaign.gnss.time[0], model.campaign.gnss.time[-1])
    angle = model.earth_angle(at)
    turn = Rotation.from_rotvec(np.column_stack([0 * angle, 0 * angle, angle]))
    position = turn.apply(model.position(at))
    velocity = turn.apply(model.velocity(at)) + np.cross([0, 0, model.campaign.earth_rotation_rate], position)
    return _rotation(tracker.quaternion[nearest]) * _orbital_axes(position, velocity)[0].inv()


def options_of(model: AlignmentModel) -> list[Option]:
    """The arcs that can be asked for after this campaign, of the sizes that the campaign itself used."""
    campaign = model.campaign
    period = model.layout.orbital_period
    begin = float(max(campaign.gnss.time[-1], max((a.stop for a in campaign.arcs), default=0.0))) + WAIT
    free = campaign.arcs_of_kind("free_rotation")
    length = float(np.median([a.stop - a.start for a in free])) if free else 600.0
    rates = [float(np.linalg.norm(model.start.arc_states[a.name][1])) for a in free if a.name in model.start.arc_states]
    rate = float(np.median(rates)) if rates and np.median(rates) > 1e-4 else 0.5 * DEGREE
    options = []
    half = float(np.sqrt(0.5))
    for words, axis in (("x", (1, 0, 0)), ("y", (0, 1, 0)), ("z", (0, 0, 1)), ("x + y", (half, half, 0)),
                        ("y + z", (0, half, half)), ("x + z", (half, 0, half))):
        for phase in (0.0, 0.25):
            where = "" if phase == 0 else ", a quarter of an orbit later"
            asked = f"a free rotation about tracker {words} at {rate / DEGREE:.2f} deg/s for {length:.0f} s{where}"
            options.append(Option("free_rotation", asked, begin + phase * period, length,
                                  rate=(rate * axis[0], rate * axis[1], rate * axis[2])))
    pulses = campaign.arcs_of_kind("torque_pulse")
    if campaign.torque is not None and len(campaign.torque.start):
        size = float(np.max(np.abs(campaign.torque.command)))
        span = float(np.median([a.stop - a.start for a in pulses])) if pulses else 100.0
        for axis_number in range(3):
            options.append(Option("torque_pulse", f"a torque pulse of +-{size:.3g} N m on actuator axis "
                                  f"{'xyz'[axis_number]} for {span:.0f} s", begin, span, axis=axis_number, torque=size))
    if campaign.doppler is not None and len(model.doppler_epochs):
        sessions = campaign.arcs_of_kind("doppler")
        span = float(np.median([a.stop - a.start for a in sessions])) if sessions else 60.0
        attitudes = (("the usual attitude", (0, 0, 0), (0, 0, 0)),
                     ("a yaw of 90 deg about antenna z", (0, 0, 90), (0, 0, 0)),
                     ("a roll of 30 deg about antenna x", (30, 0, 0), (0, 0, 0)),
                     ("a pitch of 30 deg about antenna y", (0, 30, 0), (0, 0, 0)),
                     ("a slew of +-15 deg about antenna y", (0, 0, 0), (0, 15, 0)),
                     ("a slew of +-30 deg about antenna z", (0, 0, 0), (0, 0, 30)))
        for number, turn in enumerate((0.0, 0.25, 0.5)):
            moment = ("right after the campaign", "a quarter of an orbit later", "half an orbit later")[number]
            for words, offset, swing in attitudes:
                options.append(Option("doppler", f"a Doppler pass of {span:.0f} s with {words}, {moment}",
                                      begin + turn * period, span,
                                      offset=tuple(a * DEGREE for a in offset),  # type: ignore[arg-type]
                                      swing=tuple(a * DEGREE for a in swing)))  # type: ignore[arg-type]
    return options


def planned(model: AlignmentModel, option: Option, values: Values, orbit: _Orbit, usual: Rotation) -> _PlannedModel:
    """The option as a campaign of its own, noise-free, with the noise levels of the campaign at hand.

    Args:
        model: the campaign at hand.
        option: what is planned.
        values: the fitted unknowns.
        orbit: carried on from the campaign.
        usual: ``tracker_from_orbit`` of the campaign's Doppler sessions.
    """
    campaign = model.campaign
    tracker = campaign.star_tracker
    stop = option.start + option.duration
    step = max(float(np.median(np.diff(tracker.time))), 0.05)
    time = np.arange(option.start, stop + 1e-9, step)
    around = np.arange(option.start - MARGIN, stop + MARGIN, float(np.median(np.diff(campaign.gnss.time))))
    nominal = model.start
    antenna = _rotation(np.asarray(values.get("antenna_from_tracker", nominal.antenna_from_tracker)))
    actuator = np.asarray(values.get("actuator_from_tracker", nominal.actuator_from_tracker))
    trace = float(np.asarray(values.get("inertia_trace", [nominal.inertia_trace])).ravel()[0])
    normalized = np.array(matrix_of(np.asarray(values["normalized_inertia"]))) if "normalized_inertia" in values \
        else nominal.normalized_inertia
    normalized = np.asarray(normalized, dtype=float).reshape(3, 3)
    start_attitude = usual * _orbital_axes(*orbit.inertial(np.array([option.start])))[0]
    torque = None
    states: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    if option.kind == "doppler":
        phase = 2 * np.pi * (time - option.start) / option.duration
        angles = np.asarray(option.offset) + np.sin(phase)[:, None] * np.asarray(option.swing)
        turned = Rotation.from_rotvec(-angles)
        attitude = antenna.inv() * turned * antenna * usual * _orbital_axes(*orbit.inertial(time))
        quaternion = attitude.as_quat(scalar_first=True)
    else:
        if option.kind == "torque_pulse":
            torque = _pulse(option)
        quaternion = _rotating(start_attitude, np.asarray(option.rate), normalized, trace, time, torque,
                               _rotation(actuator))
        states["planned"] = (quaternion[0], np.asarray(option.rate, dtype=float))
    sigma = np.median(np.broadcast_to(tracker.standard_deviation, (len(tracker.time), 3)), axis=0)
    series = TrackerSeries(time, quaternion, np.tile(sigma, (len(time), 1)))
    doppler = None
    if option.kind == "doppler" and campaign.doppler is not None:
        doppler = _doppler(campaign.doppler, option, antenna, time, quaternion, orbit)
    position_sigma = np.median(np.broadcast_to(campaign.gnss.standard_deviation, campaign.gnss.position.shape), axis=0)
    noise = np.random.default_rng(7).standard_normal((len(around), 3)) * position_sigma
    gnss = GnssSeries(around, orbit.earth_fixed(around) + noise, np.tile(position_sigma, (len(around), 1)))
    future = replace(campaign, gnss=gnss, star_tracker=series, doppler=doppler, torque=torque, housekeeping={},
                     arcs=(Arc("planned", option.kind, option.start, stop),))  # type: ignore[arg-type]
    known = StartingPoint(antenna.as_quat(scalar_first=True), actuator, normalized, trace, states)
    return _PlannedModel(future, model.loss, known=known)


def _pulse(option: Option) -> TorqueCommands:
    edges = option.start + option.duration * np.array([0.05, 0.3, 0.55, 0.6, 0.8])
    command = np.zeros((3, 3))
    command[:, option.axis] = option.torque * np.array([1.0, -1.0, 0.5])
    return TorqueCommands(edges[[0, 1, 3]], edges[[1, 2, 4]], command)


def _rotating(attitude: Rotation, rate: np.ndarray, normalized: np.ndarray, trace: float, time: np.ndarray,
              torque: TorqueCommands | None, actuator: Rotation) -> np.ndarray:
    """Quaternions (n, 4) ``tracker_from_inertial`` of a rigid body from rest or rotation, by Euler's equations."""
    inverse = np.linalg.inv(normalized)
    edges = [] if torque is None else sorted({*torque.start.tolist(), *torque.stop.tolist()})
    bounds = [time[0], *[e for e in edges if time[0] < e < time[-1]], time[-1]]
    state = np.concatenate([attitude.as_quat(scalar_first=True), rate])
    result = np.zeros((len(time), 4))
    result[0] = state[:4]
    for first, last in pairwise(bounds):
        pushed = np.zeros(3)
        if torque is not None:
            middle = 0.5 * (first + last)
            for start, stop, command in zip(torque.start, torque.stop, torque.command, strict=True):
                if start < middle < stop:
                    pushed = pushed + actuator.inv().apply(command) / trace

        def derivative(_: float, x: np.ndarray, pushed: np.ndarray = pushed) -> np.ndarray:
            q, w = x[:4], x[4:]
            # tracker_from_inertial turns against the body's rate: q' = -(0, w) q / 2.
            slope = -0.5 * np.concatenate([[-(w @ q[1:])], q[0] * w + np.cross(w, q[1:])])
            return np.concatenate([slope, inverse @ (pushed - np.cross(w, normalized @ w))])

        solution = solve_ivp(derivative, (first, last), state, rtol=1e-9, atol=1e-12, dense_output=True)
        inside = (time > first) & (time <= last)
        result[inside] = solution.sol(time[inside])[:4].T
        state = solution.y[:, -1]
    return np.asarray(result / np.linalg.norm(result, axis=1, keepdims=True))


def _doppler(series: DopplerSeries, option: Option, antenna: Rotation, tracker_time: np.ndarray,
             quaternion: np.ndarray, orbit: _Orbit) -> DopplerSeries:
    within = np.diff(series.time)
    step = max(float(np.median(within)), float(tracker_time[1] - tracker_time[0]))
    every = max(1, round(step / float(tracker_time[1] - tracker_time[0])))
    time, attitude = tracker_time[::every], _rotation(quaternion[::every])
    beams = series.beam_direction if series.beam_direction.ndim == 2 else series.beam_direction.mean(axis=0)
    beams = beams / np.linalg.norm(beams, axis=1, keepdims=True)
    velocity = (antenna * attitude).apply(orbit.relative_velocity(time))
    sigma = np.median(np.broadcast_to(series.standard_deviation, series.frequency_shift.shape), axis=0)
    shift = 2 * series.carrier_frequency / 299_792_458.0 * velocity @ beams.T  # m/s
    return DopplerSeries(time, shift, np.tile(sigma, (len(time), 1)), beams, series.carrier_frequency)


# ---------------------------------------------------------------------------------------------------- the advice


def advise(model: AlignmentModel, group: Sequence[str], rest: Sequence[str],
           fits: Mapping[str, Values]) -> Advice | None:
    """Find the arc that separates a group best.

    Args:
        model: the campaign at hand, all of its data.
        group: names that explain it equally well.
        rest: effects that are in the model beside them.
        fits: for each name of the group, the fitted unknowns with it in the model.

    Returns:
        The advice, or None where nothing can be asked for or no name of the group has a signature.
    """
    values = fits[group[0]]
    effects = {e.name: e for e in model.effect_instances((*rest, *group))}
    sizes = {name: np.asarray(fits[name][name], dtype=float) for name in group if name in fits[name]}
    at_hand = _told(model, values, effects, rest, sizes)
    if at_hand is None:
        return None
    now = separation([at_hand], group, rest)
    options = options_of(model)
    if not options:
        return None
    orbit = _Orbit(model, max(o.start + o.duration for o in options) + MARGIN + 10.0)
    usual = _usual_attitude(model)
    prospects = []
    for option in options:
        future = planned(model, option, values, orbit, usual)
        told = _told(future, values, effects, rest, sizes)
        if told is not None:
            prospects.append(Prospect(option, separation([at_hand, told], group, rest)))
    if not prospects:
        return None
    return Advice(tuple(group), now, tuple(sorted(prospects, key=lambda p: -p.separation)))


def _told(model: AlignmentModel, values: Values, effects: Mapping[str, EffectInstance], rest: Sequence[str],
          sizes: Mapping[str, np.ndarray]) -> _Information | None:
    """What a campaign says about the shared unknowns and the effects, at the fitted values."""
    present = {e.name for name in effects for e in model_instances(model, name)}
    if not present:
        return None
    problem = alignment_problem(model, [n for n in rest if n in present],
                                candidates=[n for n in effects if n in present and n not in rest])
    point = dict(problem.start)
    for u in problem.unknowns:
        given = values.get(u.name)
        if u.name in (*SHARED, *rest) and given is not None and np.shape(given) == np.shape(point[u.name]):
            point[u.name] = np.asarray(given, dtype=float)
        if u.name.startswith(("attitude:", "rate:")) and given is not None:
            point[u.name] = np.asarray(given, dtype=float)
        if u.name in sizes and u.name not in rest and len(sizes[u.name]) == len(point[u.name]):
            searched = np.array([p.search is not None for p in effects[u.name].parameters])
            point[u.name] = np.where(searched, sizes[u.name], 0.0)
    problem = problem.prepared(point)
    # Parameters of this campaign alone (an offset of one session) are eliminated with its own unknowns.
    same = {n: e for n, e in effects.items() if n in {u.name for u in problem.unknowns}
            and problem.unknown(n).manifold.tangent == len(e.parameters)}
    return _information(problem, problem.linearize(point), same, {n: s for n, s in sizes.items() if n in same})


def model_instances(model: AlignmentModel, name: str) -> tuple[EffectInstance, ...]:
    """The instance of that name on a campaign, or nothing where the campaign has none (no session, no beam)."""
    from estimator.effects.library import load

    family = load()[name.split(":")[0]]
    return tuple(e for e in family.instances(model.layout) if e.name == name)


__all__ = ["Advice", "Option", "Prospect", "advise", "options_of", "planned", "separation"]
