"""The best free rotations and torque pulses: principal axes of inertia and actuator axes as known as minutes allow.

What the star tracker tells along an arc depends on the initial rate and on the torque alone (its noise is tied to its
own axes), so an arc is a candidate with an information matrix: the sensitivities of the joint problem's own equation of
motion, summed over the samples, the state at the start eliminated. :func:`design_rotation` chooses the initial rates of
the free arcs under a rate limit and the direction and shape of the pulses under the actuators' limit and a rate limit:
the best choice among many candidates by exchange, with the bound that no choice among them beats, then each arc refined
without derivatives (Nelder-Mead).

The criterion is about six small angles (rad): of the principal axes of inertia (about each of them) and of the actuator
axes. The ratios of the principal moments and the trace are estimated with them and enter as what must not be known.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise, product
from typing import Any

import casadi as ca
import numpy as np

from estimator.models.errors import RequestError, ShapeError
from estimator.models.inertia import entries_of, matrix_of, smallest_second_moment
from estimator.propagation import PropagatedSignal
from estimator.unknowns import NormalizedInertia, UnitQuaternion, Unknown, Vector
from problems.alignment.campaign_design import (
    Criterion,
    best_shares,
    certified_bound,
    criterion_value,
    information_about,
)
from problems.alignment.kernels import ACTUATOR, INERTIA, inertia_trace_unknown, rotation_flow
from problems.alignment.simulation.scenario import Scenario

SHARED = 9  # unknowns of all arcs: normalized inertia 5, its trace 1, actuator 3
TURN_PER_STEP = 0.02  # rad, longest step of the integration
LONGEST_STEP = 2.0  # s, the same
SMALLEST_GAP = 0.01  # of the trace: principal moments closer than this have no axes of their own
EXCHANGE_STARTS = 6
REFINEMENTS = 36  # evaluations for each arc and round
DIRECTIONS = 60  # candidates of the initial rate on a half sphere

Segments = tuple[tuple[float, float, float], ...]


@dataclass(frozen=True, eq=False)
class RotationRequest:
    """What is given of the rotation arcs.

    Attributes:
        inertia: (3, 3) kg m2, nominal, tracker axes.
        actuator_from_tracker: (4) nominal.
        tracker_sigma: (3) rad about the tracker's axes.
        sample_step: s between tracker samples.
        free_arcs, free_duration: number; s.
        rate_limit: rad/s, size of the initial rate of a free arc.
        pulse_arcs, pulse_duration: number; s.
        pulse_shapes: the choices of (start, stop, share) of the torque limit in each segment of an arc, share within
            -1 and 1; one is chosen for all arcs.
        torque_limit: N m, of each actuator axis.
        pulse_rate_limit: rad/s, largest size of the rate anywhere in a pulse arc, which starts at rest; None for no
            limit.
    """

    inertia: np.ndarray
    actuator_from_tracker: np.ndarray
    tracker_sigma: np.ndarray
    sample_step: float
    free_arcs: int
    free_duration: float
    rate_limit: float
    pulse_arcs: int
    pulse_duration: float
    pulse_shapes: tuple[Segments, ...]
    torque_limit: float
    pulse_rate_limit: float | None = None

    def __post_init__(self) -> None:
        for name, shape in (("inertia", (3, 3)), ("actuator_from_tracker", (4,)), ("tracker_sigma", (3,))):
            value = np.asarray(getattr(self, name), dtype=float)
            if value.shape != shape:
                raise ShapeError("a part of the request has the wrong shape", where=name, value=f"shape {value.shape}",
                                 limit=str(shape))
            object.__setattr__(self, name, value)
        if not (np.allclose(self.inertia, self.inertia.T) and np.trace(self.inertia) > 0
                and smallest_second_moment(self.inertia) > 0):
            raise RequestError("the inertia tensor is not that of a body", where="inertia",
                               value=np.linalg.eigvalsh(self.inertia).tolist(),
                               limit="positive principal moments, none above the sum of the others")
        moments = np.linalg.eigvalsh(self.inertia) / np.trace(self.inertia)
        if np.min(np.diff(moments)) < SMALLEST_GAP:
            raise RequestError("two principal moments are equal: no principal axes to be known", where="inertia",
                               value=moments.tolist(), limit=f"{SMALLEST_GAP} of the trace apart")
        for name in ("sample_step", "free_duration", "rate_limit", "pulse_duration", "torque_limit"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise RequestError("the number must be more than 0", where=name, value=getattr(self, name),
                                   limit="more than 0")
        if self.free_arcs < 0 or self.pulse_arcs < 1 or not self.pulse_shapes:
            raise RequestError("actuator axes need a pulse", where="free_arcs, pulse_arcs, pulse_shapes",
                               value=(self.free_arcs, self.pulse_arcs, len(self.pulse_shapes)), limit="0, 1 and 1")
        for segments in self.pulse_shapes:
            for start, stop, share in segments:
                if not (0 <= start < stop <= self.pulse_duration and abs(share) <= 1):
                    raise RequestError("a torque segment is outside of its arc or above the limit",
                                       where="pulse_shapes", value=(start, stop, share),
                                       limit=f"0 to {self.pulse_duration} s, -1 to 1")

    @property
    def trace(self) -> float:
        """Trace of the inertia, kg m2."""
        return float(np.trace(self.inertia))


def rotation_request_of(scenario: Scenario, more_shapes: bool = True) -> RotationRequest:
    """The request with the arcs, limits and noise of a simulated campaign.

    Args:
        scenario: of the campaign.
        more_shapes: whether other shapes of the pulse than the scenario's may be chosen, all within its first and
            last instant of torque: one push, push and pull, push, pull and push.
    """
    top = max(abs(size) for *_, size in scenario.pulse_segments)
    own = tuple((a, b, size / top) for a, b, size in scenario.pulse_segments)
    shapes: list[Segments] = [own]
    if more_shapes:
        first, last = own[0][0], own[-1][1]
        for cuts in ((1.0,), (0.5, 1.0), (0.25, 0.75, 1.0)):
            ends = [first, *(first + c * (last - first) for c in cuts)]
            shape = tuple((a, b, float((-1) ** k)) for k, (a, b) in enumerate(pairwise(ends)))
            if shape not in shapes:
                shapes.append(shape)
    request = RotationRequest(
        np.asarray(scenario.inertia), np.asarray(scenario.actuator_from_tracker) /
        np.linalg.norm(scenario.actuator_from_tracker), np.asarray(scenario.star_tracker_noise),
        scenario.star_tracker_step, scenario.free_arcs, scenario.free_duration, scenario.free_rate,
        max(len(scenario.pulse_axes), 1), scenario.pulse_duration, tuple(shapes), top)
    # No pulse turns the spacecraft faster than the scenario's own pulses do.
    axes = sorted(set(scenario.pulse_axes)) or [0, 1, 2]
    arcs = _Arcs(request)
    fastest = max(arcs.fastest(own, np.eye(3)[axis] * top) for axis in axes)
    return RotationRequest(**{**request.__dict__, "pulse_rate_limit": float(fastest)})


class _Arcs:
    """Information of single arcs about the shared unknowns, in units of their scales."""

    def __init__(self, request: RotationRequest):
        self.request = request
        trace = request.trace
        self.shared = (INERTIA, inertia_trace_unknown(trace), ACTUATOR)
        self.scales = np.concatenate([u.scales for u in self.shared])
        self.values = {INERTIA.name: entries_of(request.inertia / trace), "inertia_trace": np.array([trace]),
                       ACTUATOR.name: request.actuator_from_tracker}
        self.starts = (Unknown("attitude", UnitQuaternion(), "rad", 0.1), Unknown("rate", Vector(3), "rad/s", 0.01))
        self.free_flow = rotation_flow(False, (), trace, 1)
        self.pulse_flow = rotation_flow(True, (), trace, 1)

    def _states(self, duration: float, rate: np.ndarray, segments: Segments,
                torque: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Node times, states (n, 7) and sensitivities (n, 6, columns) in tangent coordinates."""
        top = float(np.linalg.norm(rate))
        if torque is not None:
            least = float(np.linalg.eigvalsh(self.request.inertia)[0])
            top += float(np.linalg.norm(torque)) * max(stop - start for start, stop, _ in segments) / least
        longest = min(LONGEST_STEP, TURN_PER_STEP / max(top, 1e-9))
        cuts = np.unique([0.0, duration, *(t for a, b, _ in segments for t in (a, b))])
        pieces = [cuts[:1]]
        for a, b in pairwise(cuts):
            steps = int(np.ceil((b - a) / longest - 1e-9))
            pieces.append(a + (b - a) * np.arange(1, steps + 1) / steps)
        nodes = np.concatenate(pieces)
        held = np.zeros((len(nodes) - 1, 0))
        if torque is not None:
            middle = 0.5 * (nodes[1:] + nodes[:-1])
            shares = sum((share * ((middle > a) & (middle < b)) for a, b, share in segments), np.zeros(len(middle)))
            held = shares[:, None] * torque
        signal = PropagatedSignal("state", self.free_flow if torque is None else self.pulse_flow, self.starts, nodes,
                                  np.zeros((len(nodes), 0)), held, np.arange(len(nodes)))
        values = {**self.values, "attitude": np.array([1.0, 0.0, 0.0, 0.0]), "rate": np.asarray(rate, dtype=float)}
        states, sensitivities = signal.evaluate(values)
        return nodes, states, sensitivities

    def information(self, duration: float, rate: np.ndarray, segments: Segments = (),
                    torque: np.ndarray | None = None) -> np.ndarray:
        """Information (9, 9) of one arc in scaled coordinates, its initial state eliminated.

        Integrated over the nodes by the trapezoidal rule, times the number of samples per second.
        """
        nodes, _, sensitivities = self._states(duration, rate, segments, torque)
        step = np.diff(nodes)
        # One sample at each end of the arc: half a step more on either side.
        weight = np.convolve(step, [0.5, 0.5]) / self.request.sample_step
        weight[[0, -1]] += 0.5
        slope = sensitivities[:, :3] / self.request.tracker_sigma[:, None]
        states = np.concatenate([u.scales for u in self.starts])
        columns = slope.shape[2]
        slope = slope * np.concatenate([states, self.scales[: columns - 6]])
        rows = (slope * np.sqrt(weight)[:, None, None]).reshape(-1, columns)
        # Elimination by an orthogonal factor: the square of the rows would lose half of the digits.
        orthogonal, _ = np.linalg.qr(rows[:, :6])
        rest = rows[:, 6:] - orthogonal @ (orthogonal.T @ rows[:, 6:])
        full = np.zeros((SHARED, SHARED))
        full[: columns - 6, : columns - 6] = rest.T @ rest
        return full

    def fastest(self, segments: Segments, torque: np.ndarray) -> float:
        """Largest size of the rate (rad/s) in a pulse arc from rest."""
        _, states, _ = self._states(self.request.pulse_duration, np.zeros(3), segments, torque)
        return float(np.linalg.norm(states[:, 4:7], axis=1).max())

    def free(self, rate: np.ndarray) -> np.ndarray:
        """Information of a free arc with the direction of ``rate`` at the rate limit."""
        return self.information(self.request.free_duration, self.within_rate(rate))

    def within_rate(self, rate: np.ndarray) -> np.ndarray:
        """``rate`` (3) scaled to the rate limit."""
        return np.asarray(rate) * self.request.rate_limit / max(float(np.linalg.norm(rate)), 1e-300)

    def within_torque(self, segments: Segments, direction: np.ndarray) -> np.ndarray:
        """The largest torque (3, N m, actuator axes) along ``direction`` that keeps the torque and the rate limit."""
        torque = np.asarray(direction) * self.request.torque_limit / max(float(np.max(np.abs(direction))), 1e-300)
        limit = self.request.pulse_rate_limit
        if limit is not None:
            for _ in range(6):  # nearly linear: each round brings the excess down by orders of magnitude
                excess = self.fastest(segments, torque) / limit
                if excess <= 1.0 + 1e-6:
                    break
                torque = torque / (excess * (1 + 1e-7))
        return np.asarray(torque)

    def pulse(self, segments: Segments, direction: np.ndarray) -> np.ndarray:
        """Information of a pulse arc with the torque along ``direction`` at its limit."""
        return self.information(self.request.pulse_duration, np.zeros(3), segments,
                                self.within_torque(segments, direction))

    def interest(self) -> np.ndarray:
        """Map (6, 9) from scaled shared unknowns to rad: turns about each principal axis, turns about actuator axes."""
        inertia = self.request.inertia / self.request.trace
        step = ca.SX.sym("d", 5)
        moved = matrix_of(NormalizedInertia().retract(ca.DM(self.values[INERTIA.name]), step))
        slope = np.asarray(ca.Function("slope", [step], [ca.jacobian(ca.vec(moved), step)])(np.zeros(5)))
        moments, axes = np.linalg.eigh(inertia)
        rows = np.zeros((6, SHARED))
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            # A small turn t about axis k moves the coupling of axes i and j by t (J_i - J_j).
            coupling = np.einsum("a,abm,b->m", axes[:, i], slope.reshape(3, 3, 5, order="F"), axes[:, j])
            rows[k, :5] = coupling / (moments[i] - moments[j])
        rows[3:, 6:] = np.eye(3)
        return rows * self.scales


@dataclass(frozen=True, eq=False)
class RotationDesign:
    """The best arcs that were found.

    Attributes:
        request: what was asked for.
        criterion: A, D or E.
        free_rates: (free_arcs, 3) rad/s, initial rates, tracker axes.
        pulse_shape: (start, stop, share) of each segment.
        pulse_torques: (pulse_arcs, 3) N m, actuator axes; a segment commands its share of them.
        information: (6, 6) 1/rad^2 about the principal axes (about each, in order of rising moment) and the actuator
            axes.
        value: the criterion.
        bound: no choice among the candidates of this pulse shape has a smaller criterion; the refined arcs may.
        arc_values: (name, minutes, factor): how much worse the criterion is without the arc (a ratio; for D a
            difference).
        seconds: wall time.
    """

    request: RotationRequest
    criterion: Criterion
    free_rates: np.ndarray
    pulse_shape: Segments
    pulse_torques: np.ndarray
    information: np.ndarray
    value: float
    bound: float
    arc_values: tuple[tuple[str, float, float], ...]
    seconds: float

    @property
    def covariance(self) -> np.ndarray:
        """Covariance (6, 6) rad^2 of the turns."""
        return np.linalg.inv(self.information)

    @property
    def axes_sigma(self) -> float:
        """Bound of the total error of the principal axes, rad."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3])))

    @property
    def actuator_sigma(self) -> float:
        """Bound of the total error of the actuator quaternion, rad."""
        return float(np.sqrt(np.trace(self.covariance[3:, 3:])))

    @property
    def minutes(self) -> float:
        """Length of all arcs, min."""
        r = self.request
        return (r.free_arcs * r.free_duration + r.pulse_arcs * r.pulse_duration) / 60.0


def rotation_information(request: RotationRequest, free_rates: np.ndarray, pulse_shape: Segments,
                         pulse_torques: np.ndarray) -> np.ndarray:
    """Information (6, 6) 1/rad^2 about principal and actuator axes of given arcs (as in :class:`RotationDesign`)."""
    arcs = _Arcs(request)
    total = sum((arcs.information(request.free_duration, rate) for rate in np.reshape(free_rates, (-1, 3))),
                np.zeros((SHARED, SHARED)))
    total = total + sum(arcs.information(request.pulse_duration, np.zeros(3), pulse_shape, torque)
                        for torque in np.reshape(pulse_torques, (-1, 3)))
    return information_about(arcs.interest(), total)


def half_sphere(count: int) -> np.ndarray:
    """Unit vectors (count, 3) spread evenly over a half sphere (a motion and its reverse tell the same)."""
    k = np.arange(count)
    z = (k + 0.5) / count
    azimuth = np.pi * (1 + np.sqrt(5)) * k
    across = np.sqrt(1 - z * z)
    return np.column_stack([across * np.cos(azimuth), across * np.sin(azimuth), z])


@dataclass
class _Choice:
    """A choice of arcs while it is being improved: parameters and information of each."""

    criterion: Criterion
    interest: np.ndarray
    parameters: list[np.ndarray] = field(default_factory=list)
    parts: list[np.ndarray] = field(default_factory=list)

    def value(self, parts: Sequence[np.ndarray]) -> float:
        return criterion_value(self.criterion, information_about(self.interest, sum(parts, np.zeros((SHARED, SHARED)))))


def design_rotation(request: RotationRequest, criterion: Criterion = "A", *, refine: bool = True) -> RotationDesign:
    """The arcs that make principal axes and actuator axes best known.

    Args:
        request: the arcs and their limits.
        criterion: A, D or E, on the six angles in rad.
        refine: whether the candidates that were chosen are refined.

    Raises:
        RequestError: arcs that leave an angle undetermined whatever is chosen.
    """
    began = time.perf_counter()
    arcs = _Arcs(request)
    interest = arcs.interest()
    spins = half_sphere(DIRECTIONS) if request.free_arcs else np.zeros((0, 3))
    free = np.array([arcs.free(d) for d in spins]).reshape(-1, SHARED, SHARED)
    pushes = np.array([d for d in product((-1.0, 0.0, 1.0), repeat=3) if tuple(d) > (0.0, 0.0, 0.0)])
    best: tuple[float, _Choice, Segments, np.ndarray] | None = None
    for shape in request.pulse_shapes:
        pulses = np.array([arcs.pulse(shape, d) for d in pushes])
        choice = _exchanged(request, criterion, interest, spins, free, pushes, pulses)
        value = choice.value(choice.parts)
        if best is None or value < best[0]:
            best = value, choice, shape, pulses
    assert best is not None
    value, choice, shape, pulses = best
    if not np.isfinite(value):
        raise RequestError("no choice of arcs determines principal axes and actuator axes",
                           where="free_arcs, pulse_arcs", value=(request.free_arcs, request.pulse_arcs),
                           remedy="add an arc or a pulse")
    bound = _bound(request, criterion, interest, free, pulses)
    if refine:
        _refine(request, arcs, choice, shape)
    rates = np.array([arcs.within_rate(p) for p in choice.parameters[: request.free_arcs]]).reshape(-1, 3)
    torques = np.array([arcs.within_torque(shape, p) for p in choice.parameters[request.free_arcs :]])
    information = rotation_information(request, rates, shape, torques)
    value = criterion_value(criterion, information)
    return RotationDesign(request, criterion, rates, shape, torques, information, value, bound,
                          _arc_values(request, choice, value), time.perf_counter() - began)


def _exchanged(request: RotationRequest, criterion: Criterion, interest: np.ndarray, spins: np.ndarray,
               free: np.ndarray, pushes: np.ndarray, pulses: np.ndarray) -> _Choice:
    """Candidates for every arc: drawn at first, each exchanged for the best while anything improves; the best start."""
    pools = [(spins, free)] * request.free_arcs + [(pushes, pulses)] * request.pulse_arcs
    draw = np.random.default_rng(0)
    best: tuple[float, _Choice] | None = None
    for _ in range(EXCHANGE_STARTS):
        first = [int(draw.integers(len(pool[0]))) for pool in pools]
        choice = _Choice(criterion, interest, [p[0][i] for p, i in zip(pools, first, strict=True)],
                         [p[1][i] for p, i in zip(pools, first, strict=True)])
        if criterion == "E":
            # The worst direction alone leads nowhere from a poor start; the sum of all does.
            choice.criterion = "A"
            _exchange(choice, pools)
            choice.criterion = "E"
        value = _exchange(choice, pools)
        if best is None or value < best[0]:
            best = value, choice
    assert best is not None
    return best[1]


def _exchange(choice: _Choice, pools: Sequence[tuple[np.ndarray, np.ndarray]]) -> float:
    """Exchange single candidates in place while the criterion falls; its value."""
    value = choice.value(choice.parts)
    for _ in range(20):
        before = value
        for k, (parameters, parts) in enumerate(pools):
            rest = sum((p for i, p in enumerate(choice.parts) if i != k), np.zeros((SHARED, SHARED)))
            values = [choice.value([rest, part]) for part in parts]
            pick = int(np.argmin(values))
            if values[pick] < value:
                value = values[pick]
                choice.parameters[k], choice.parts[k] = parameters[pick], parts[pick]
        if not value < before:
            break
    return value


def _bound(request: RotationRequest, criterion: Criterion, interest: np.ndarray, free: np.ndarray,
           pulses: np.ndarray) -> float:
    """What no choice among the candidates goes below: shares in place of whole arcs."""
    kinds = [(request.free_arcs, free), (request.pulse_arcs, pulses)]
    kinds = [(count, parts) for count, parts in kinds if count]
    width = max(len(parts) for _, parts in kinds)
    stack = np.stack([np.resize(count * len(kinds) * parts, (width, SHARED, SHARED)) for count, parts in kinds])
    shares = best_shares(stack, criterion, interest=interest, tolerance=2e-3, iterations=3000)
    return certified_bound(criterion, shares.information, stack, interest=interest)


def _refine(request: RotationRequest, arcs: _Arcs, choice: _Choice, shape: Segments) -> None:
    """Each arc in turn by Nelder-Mead, the others held, for two rounds."""
    from scipy.optimize import minimize

    for _ in range(2):
        for k in range(len(choice.parts)):
            part: Callable[[np.ndarray], np.ndarray] = arcs.free
            if k >= request.free_arcs:
                def part(d: np.ndarray) -> np.ndarray:
                    return arcs.pulse(shape, d)
            rest = sum((p for i, p in enumerate(choice.parts) if i != k), np.zeros((SHARED, SHARED)))
            start = choice.parameters[k] / np.max(np.abs(choice.parameters[k]))
            here = choice.value(choice.parts)
            simplex = np.vstack([start, start + 0.2 * (np.eye(3) - np.outer(start, start) / (start @ start))])

            def cost(d: np.ndarray, rest: np.ndarray = rest, part: Any = part, here: float = here) -> float:
                found = choice.value([rest, part(d)])
                if not np.isfinite(found):
                    return 1e3
                return found - here if choice.criterion == "D" else float(np.log(found / here))

            answer = minimize(cost, start, method="Nelder-Mead",
                              options={"initial_simplex": simplex, "maxfev": REFINEMENTS, "xatol": 1e-3, "fatol": 1e-4})
            if answer.fun < 0:
                choice.parameters[k], choice.parts[k] = answer.x, part(answer.x)


def _arc_values(request: RotationRequest, choice: _Choice, value: float) -> tuple[tuple[str, float, float], ...]:
    values = []
    for k in range(len(choice.parts)):
        without = choice.value([p for i, p in enumerate(choice.parts) if i != k])
        free = k < request.free_arcs
        name = f"free-{k + 1}" if free else f"torque-{k + 1 - request.free_arcs}"
        minutes = (request.free_duration if free else request.pulse_duration) / 60.0
        loss = without - value if choice.criterion == "D" else without / value
        values.append((name, minutes, float(loss)))
    return tuple(values)
