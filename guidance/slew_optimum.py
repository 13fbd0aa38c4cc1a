"""The quickest (or the smoothest) slew: start, solve, refine, certify, and say why not.

What is returned keeps the limits everywhere, by the exact extremes of the piecewise polynomials; nothing that fails
this certificate is called solved.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import Any, NoReturn

import numpy as np

from estimator.models.errors import InfeasibleError
from guidance.eigenaxis_slew import turn
from guidance.jerk_profile import JerkProfile
from guidance.kinematics import (
    angle_between,
    conjugate,
    exponential,
    norm,
    product,
    rodrigues_from_quaternion,
    rotate,
)
from guidance.rodrigues_slew import rodrigues_slew
from guidance.slew_bounds import lower_bound
from guidance.slew_envelope import Envelope, envelope_of
from guidance.slew_problem import ROW_NAMES, STAGE, STATE, Extras, transcription
from guidance.slew_request import Limits, SlewRequest
from guidance.slew_start import PARTS, eigenaxis_profile, even_mesh, interpolated, starting_motion, switching_mesh

Array = np.ndarray

_MARGIN = 2e-7  # relative: the limits inside the solver, so that its tolerance does not break them outside
_PERMITTED = 1e-6  # relative: the most that a certified slew may exceed a limit
_MISSED = 4e-8  # rad: the most that a certified slew may miss its attitude, below 0.01 arcsec
_ACROSS = 0.22  # rates across the eigenaxis, over the root of angle times acceleration: above it no mesh is guessed
_NEAR_PROFILE = 0.015  # relative: an optimum this near the eigenaxis profile has its switches,
_NEARER = 0.004  # and this near where the ends accelerate
_FINE = 40  # intervals of a refined mesh
_REFINEMENTS = 3  # at most
_SETTLED = 1e-3  # relative gain of a refinement below which there is no other
_FINER, _SETTLED_FINER = 60, 3e-4  # the same where the ends accelerate
_LAST_PIECE = 1e-3  # of the time to build up the acceleration: length of the piece with the jerk asked for at the stop


# The barrier of the interior point stops at 1e-6, not at zero: it costs 2e-5 of the duration, saves a quarter of the
# iterations, and leaves an answer on the central path, from which a neighbouring one is a few steps away.
_BARRIER = 1e-6
_USUAL: dict[str, Any] = {"ipopt.mu_target": _BARRIER}
_QUICK: dict[str, Any] = {"ipopt.mu_init": 1e-3, "ipopt.mu_target": _BARRIER}  # for a start near the answer
_WARM: dict[str, Any] = {"ipopt.mu_init": _BARRIER, "ipopt.mu_target": _BARRIER, "ipopt.max_iter": 30,
                         "ipopt.warm_start_init_point": "yes", "ipopt.warm_start_bound_push": 1e-9,
                         "ipopt.warm_start_bound_frac": 1e-9, "ipopt.warm_start_slack_bound_push": 1e-9,
                         "ipopt.warm_start_slack_bound_frac": 1e-9, "ipopt.warm_start_mult_bound_push": 1e-9}
_BUILDING = [0.0]  # s, all the time this process has spent on making and compiling solvers


@dataclass(frozen=True)
class Scales:
    """Units of the solver's unknowns."""

    angle: float
    rate: float
    acceleration: float
    time: float


@dataclass(frozen=True)
class Optimum:
    """A solved slew.

    Attributes:
        profile: the slew, as its jerk.
        long_way: whether it goes the longer way round.
        seconds: time from request to answer, s, without that of making and compiling solvers, done once.
        iterations: of the solver, all solves together.
        solver: which one gave the answer.
        steps: what was tried, in words.
    """

    profile: JerkProfile
    long_way: bool
    seconds: float
    iterations: int
    solver: str
    steps: tuple[str, ...] = ()
    memory: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    @property
    def duration(self) -> float:
        """s."""
        return self.profile.duration


@dataclass
class _Attempt:
    """One solve: mesh, scales and the solver's answer."""

    fractions: Array
    scales: Scales
    x: Array
    lam_g: Array
    lam_x: Array
    success: bool
    status: str
    iterations: int
    solver: str
    duration: float
    worst: tuple[str, float]


def _effective_stop(request: SlewRequest, limits: Limits) -> tuple[SlewRequest, JerkProfile | None]:
    """The request up to the last short piece, and that piece, where a jerk at the last instant is asked for."""
    jerk = request.stop.jerk
    if jerk is None:
        return request, None
    length = _LAST_PIECE * min(limits.acceleration / limits.jerk, 1.0)
    stop = request.stop
    acceleration = stop.acceleration - length * jerk
    rate = stop.rate - length * stop.acceleration + length**2 / 2 * jerk
    size = float(np.linalg.norm(acceleration))
    if size > limits.acceleration * (1 + _PERMITTED):
        raise InfeasibleError(
            f"the jerk at the stop needs a larger acceleration just before it: {size:.6g} rad/s2 against the limit "
            f"{limits.acceleration:.6g} rad/s2", limit="acceleration", excess=size - limits.acceleration)
    last = JerkProfile(np.array([1.0, 0, 0, 0]), rate, acceleration, np.array([length]), jerk[None])
    quaternion = product(stop.quaternion, conjugate(last.final()[0]))
    return replace(request, stop=replace(stop, quaternion=quaternion, rate=rate, acceleration=acceleration,
                                         jerk=None)), last


def _reference(request: SlewRequest, long_way: bool) -> tuple[Array, Array]:
    """Half-way attitude and the parameters of the stop against it (those of the start are the opposite)."""
    phi = turn(request, long_way)
    half = float(np.linalg.norm(phi)) / 2
    axis = phi / (2 * half) if half > 0 else np.array([1.0, 0.0, 0.0])
    return product(request.start.quaternion, exponential(phi / 2)), np.tan(half / 4) * axis


def _default(name: str) -> dict[str, Any]:
    """Options of a solver for a start far from the answer."""
    return _USUAL if name == "ipopt" else {}


def _solve(request: SlewRequest, limits: Limits, envelope: Envelope, long_way: bool, fractions: Array, sigma: Array,
           rate: Array, acceleration: Array, duration: float, *, name: str = "ipopt", scales: Scales | None = None,
           margin: Array | float = 0.0, dual: tuple[Array, Array] | None = None, x0: Array | None = None,
           options: dict[str, Any] | None = None) -> _Attempt:
    """One call of the solver from the motion at the nodes of a mesh, or from the unknowns ``x0`` of another call."""
    count = len(fractions)
    begun = time.perf_counter()
    problem = transcription(count, envelope.extras)
    solver = problem.solver(name, **(_default(name) if options is None else options))
    _BUILDING[0] += time.perf_counter() - begun
    reference, stop = _reference(request, long_way)
    if scales is None:
        peak = max(float(np.max(norm(rate))), float(np.linalg.norm(stop)) / duration, 1e-9)
        scales = Scales(max(peak * duration / 2, 1e-6), peak, max(float(np.max(norm(acceleration))), peak / duration),
                        duration)
    if x0 is None:
        jerk = np.diff(acceleration, axis=0) / (fractions * duration)[:, None] / limits.jerk
        jerk *= np.minimum(1, 0.95 / np.maximum(norm(jerk), 1e-12))[:, None]
        state = np.concatenate([sigma / scales.angle, rate / scales.rate, acceleration / scales.acceleration,
                                np.full((count + 1, 1), duration / scales.time)], axis=1)
        x0 = np.concatenate([np.concatenate([state[:-1], jerk], axis=1).ravel(), state[-1]])
    lower, upper = np.full(problem.size, -np.inf), np.full(problem.size, np.inf)
    for begin, value, end in ((0, -stop, request.start), (STAGE * count, stop, request.stop)):
        fixed = np.concatenate([value / scales.angle, end.rate / scales.rate, end.acceleration / scales.acceleration])
        lower[begin:begin + STATE - 1] = upper[begin:begin + STATE - 1] = fixed
        x0[begin:begin + STATE - 1] = fixed
    smooth = request.objective == "smoothness"
    if smooth:
        lower[STATE - 1] = upper[STATE - 1] = float(request.duration or duration) / scales.time
    else:
        lower[STATE - 1], upper[STATE - 1] = 1e-3, 1e3
    inside = 1 - _MARGIN
    shared = np.concatenate([[scales.angle, scales.rate, scales.acceleration, scales.time, limits.rate * inside,
                              limits.acceleration * inside, limits.jerk * inside, float(smooth)],
                             envelope.parameters(reference, margin)])
    own = np.stack([fractions, np.concatenate([[0.0], np.ones(count - 1)])], axis=1).ravel()
    call: dict[str, Any] = {"x0": x0, "lbx": lower, "ubx": upper, "lbg": problem.lbg, "ubg": problem.ubg,
                            "p": np.concatenate([shared, own])}
    if dual is not None:
        call |= {"lam_g0": dual[0], "lam_x0": dual[1]}
    answer = solver(**call)
    stats = solver.stats()
    x = answer["x"].full().ravel()
    g = answer["g"].full().ravel().reshape(count, problem.height)
    broken = np.concatenate([np.max(np.abs(g[:, :STATE]), axis=0), np.max(g[:, STATE:], axis=0)])
    names = ("attitude",) * 3 + ("rate",) * 3 + ("acceleration",) * 3 + ("duration",) + ROW_NAMES + tuple(
        envelope.extras.names)
    k = int(np.argmax(broken)) if np.all(np.isfinite(broken)) else 0
    return _Attempt(fractions, scales, x, answer["lam_g"].full().ravel(), answer["lam_x"].full().ravel(),
                    bool(stats["success"]) and bool(np.all(np.isfinite(x))), str(stats.get("return_status", "")),
                    int(stats.get("iter_count", 0)), name, float(x[-1]) * scales.time, (names[k], float(broken[k])))


def _profile(request: SlewRequest, limits: Limits, attempt: _Attempt) -> JerkProfile:
    """The slew of a solver's answer, with the last rounding errors at the stop taken out of the jerk."""
    count = len(attempt.fractions)
    jerks = np.concatenate([attempt.x, np.zeros(STAGE - STATE)]).reshape(count + 1, STAGE)[:-1, STATE:]
    jerks = jerks * limits.jerk * (1 - _MARGIN)
    profile = JerkProfile(request.start.quaternion, request.start.rate, request.start.acceleration,
                          attempt.fractions * attempt.duration, jerks)
    if request.objective == "smoothness" and request.duration is not None:
        profile = replace(profile, durations=attempt.fractions * request.duration)
    return _closed(profile, request)


def _closed(profile: JerkProfile, request: SlewRequest) -> JerkProfile:
    """The profile with the least change of jerk that brings it exactly to the stop (a step of Newton's method)."""
    joints = np.concatenate([[0.0], np.cumsum(profile.durations)])
    h, total = profile.durations, joints[-1]
    middle = (joints[:-1] + joints[1:]) / 2
    weight = np.array([1.0] * 3 + [total] * 3 + [total**2] * 3)
    for _ in range(2):
        motion = profile.motion(np.append(middle, total), longest_step=0.5)
        missing = np.concatenate([
            _small_rotation(motion.quaternion[-1], request.stop.quaternion),
            request.stop.rate - motion.rate[-1], request.stop.acceleration - motion.acceleration[-1]])
        size = float(np.max(np.abs(missing)))
        if size < 1e-11 or size > 1e-4:
            break
        # A change of jerk in piece k changes the rate at t by (t - t_k) h, and that turns the end by its integral
        # seen from the body at the end.
        to_end = rotate(product(conjugate(motion.quaternion[-1:]), motion.quaternion[:-1])[:, None, :], np.eye(3))
        turned = np.cumsum((to_end * h[:, None, None])[::-1], axis=0)[::-1]
        moment = np.cumsum((to_end * (h * middle)[:, None, None])[::-1], axis=0)[::-1]
        blocks = np.zeros((9, len(h), 3))
        blocks[:3] = ((moment - turned * middle[:, None, None]) * h[:, None, None]).transpose(2, 0, 1)
        for i in range(3):
            blocks[3 + i, :, i] = (total - middle) * h
            blocks[6 + i, :, i] = h
        weighted = blocks.reshape(9, -1) * weight[:, None]
        change = weighted.T @ np.linalg.lstsq(weighted @ weighted.T, missing * weight, rcond=1e-14)[0]
        profile = replace(profile, jerks=profile.jerks + change.reshape(-1, 3))
        if size < 1e-7:  # what is left is of the second order
            break
    return profile


def _small_rotation(reached: Array, wanted: Array) -> Array:
    d = product(conjugate(reached), wanted)
    return 2 * d[1:] * (1 if d[0] >= 0 else -1)


def certificate(profile: JerkProfile, limits: Limits) -> dict[str, float]:
    """Relative excess over the limits on rate, acceleration and jerk, exact; at most zero where they hold."""
    rate, acceleration, jerk = profile.largest()
    return {"rate": rate / limits.rate - 1, "acceleration": acceleration / limits.acceleration - 1,
            "jerk": jerk / limits.jerk - 1}


def _uniform_start(request: SlewRequest, limits: Limits, long_way: bool, bound: float, count: int) \
        -> tuple[Array, Array, Array, Array, float] | None:
    """Mesh and motion of the degree-5 polynomial in its least feasible time."""
    law = rodrigues_slew(request, 5, limits, bound, long_way=long_way, accurate=False)
    if law is None:
        return None
    fractions = np.full(count, 1.0 / count)
    motion = law.motion(np.linspace(0, law.duration, count + 1))
    relative = product(conjugate(law.reference), motion.quaternion)
    sigma = rodrigues_from_quaternion(relative, shortest=False)
    return fractions, sigma, motion.rate, motion.acceleration, law.duration


def _refined(attempt: _Attempt, limits: Limits, count: int) -> tuple[Array, Array, Array, Array]:
    """A finer mesh where the jerk changes most, and the answer interpolated to it: fractions and state at the nodes."""
    n = len(attempt.fractions)
    stages = np.concatenate([attempt.x, np.zeros(STAGE - STATE)]).reshape(n + 1, STAGE)
    jerks = stages[:-1, STATE:]
    h = attempt.fractions
    joints = np.concatenate([[0.0], np.cumsum(h)])
    change = norm(np.diff(jerks, axis=0))
    activity = np.full(n, 0.0)
    activity[:-1] += change / 2
    activity[1:] += change / 2
    # One part of the intervals is spread evenly in time, one evenly over the old mesh, one over the change of jerk.
    share = 0.2 * h + 0.4 / n + 0.4 * activity / max(float(np.sum(activity)), 1e-12)
    density = np.concatenate([[0.0], np.cumsum(share)]) / np.sum(share)
    new = np.interp(np.linspace(0, 1, count + 1), density, joints)
    state = interpolated(new, joints, stages[:, :STATE])
    s = attempt.scales
    return np.diff(new), state[:, 0:3] * s.angle, state[:, 3:6] * s.rate, state[:, 6:9] * s.acceleration


def _one_way(request: SlewRequest, limits: Limits, envelope: Envelope, long_way: bool, name: str, steps: list[str]) \
        -> tuple[_Attempt | None, int]:
    """The best answer of one way round and the iterations spent; the last failure where there is none."""
    axis, speed = eigenaxis_profile(request, limits, long_way)
    label = "long way" if long_way else "short way"
    plain = speed.fits and not envelope.extras.rows and request.objective == "time"
    alone = not any(np.linalg.norm(v - (v @ axis) * axis) > 1e-12 * limits.rate for e in (request.start, request.stop)
                    for v in (e.rate, e.acceleration))
    pushed = max(float(np.linalg.norm(e.acceleration)) for e in (request.start, request.stop)) / limits.acceleration
    spent, best = 0, None

    def attempt(what: str, *args: Any, options: dict[str, Any] | None = None) -> _Attempt:
        nonlocal spent, best
        result = _solve(request, limits, envelope, long_way, *args, name=name, options=options)
        if not result.success and name != "ipopt":
            spent += result.iterations
            steps.append(f"{label}, {what}: {name} did not converge, falling back to ipopt")
            result = _solve(request, limits, envelope, long_way, *args)
        spent += result.iterations
        steps.append(f"{label}, {what}: {result.status or result.success}, {result.iterations} iterations")
        smooth = request.objective == "smoothness"  # of equal durations the later answer is on the finer mesh
        if (best is None or result.success > best.success
                or (result.success == best.success and (smooth or result.duration < best.duration))):
            best = result
        return result

    quick = _QUICK if name == "ipopt" else {}
    across = max(float(np.linalg.norm(e.rate - (e.rate @ axis) * axis)) for e in (request.start, request.stop))
    difficult = pushed > 0.1 or across > _ACROSS * np.sqrt(max(speed.angle, 1e-9) * limits.acceleration)
    if speed.fits and speed.duration > 0:
        usual = plain and not difficult
        mesh = switching_mesh(speed, limits, exact=alone) if usual else even_mesh(speed.duration, limits, _FINE)
        first = attempt("from the eigenaxis profile", mesh, *starting_motion(request, axis, speed, mesh), options=quick)
        near = _NEARER if pushed > 0.02 else _NEAR_PROFILE
        if usual and first.success and abs(first.duration / speed.duration - 1) < near:
            return first, spent
    if best is None or not best.success:
        bound = max(lower_bound(request, limits, long_way=long_way), 1e-3)
        start = _uniform_start(request, limits, long_way, bound, _FINE)
        if start is not None:
            attempt("from the polynomial", *start)
        if best is None or not best.success:
            duration = 2 * max(bound, speed.duration, 1e-3)
            mesh = np.full(_FINE, 1 / _FINE)
            sigma, rate, acceleration, _ = starting_motion(request, axis, replace(
                speed, durations=np.maximum(speed.durations, duration / 7)), mesh)
            attempt("from a slower start", mesh, sigma, rate, acceleration, duration)
    if best is not None and best.success:
        # Accelerated ends have more switches, at places that are not known beforehand.
        count, settled = (_FINER, _SETTLED_FINER) if pushed > 0.02 else (_FINE, _SETTLED)
        for _ in range(_REFINEMENTS):
            before = best.duration
            fractions, sigma, rate, acceleration = _refined(best, limits, count)
            attempt("on a refined mesh", fractions, sigma, rate, acceleration, best.duration, options=quick)
            if best.duration > before * (1 - settled):
                break
    return best, spent


def optimal_slew(request: SlewRequest, *, near: Optimum | None = None) -> Optimum:
    """The quickest slew within the limits, or the smoothest one of the duration asked for.

    Args:
        request: the slew.
        near: the answer to a neighbouring request, from which to start (replanning).

    Raises:
        InfeasibleError: no slew keeps the limits; says which limit and by how much.
    """
    began = time.perf_counter() - _BUILDING[0]
    limits, envelope = envelope_of(request)
    envelope.check_ends(request)
    inner, last = _effective_stop(request, limits)
    name = request.solver
    steps: list[str] = []
    if near is not None:
        again = _replanned(inner, limits, envelope, near, name)
        if again is not None:
            profile = _with_last(again[0], last)
            seconds = time.perf_counter() - _BUILDING[0] - began
            return Optimum(profile, near.long_way, seconds, again[1].iterations, again[1].solver,
                           ("from the neighbouring answer",), again[2])
        steps.append("the neighbouring answer did not help")
    if inner.objective == "smoothness" and inner.duration is not None:
        quickest = optimal_slew(replace(inner, objective="time", duration=None))
        if quickest.duration > inner.duration:
            raise _too_short(quickest.duration, inner.duration)
    best: _Attempt | None = None
    best_way, total = False, 0
    failures: list[_Attempt] = []
    for long_way in (False, True):
        if best is not None and (float(np.linalg.norm(turn(inner, True))) / limits.rate >= best.duration
                                 or lower_bound(inner, limits, long_way=True) >= best.duration):
            continue
        if long_way and inner.objective == "smoothness" and best is not None:
            continue
        found, spent = _one_way(inner, limits, envelope, long_way, name, steps)
        total += spent
        if found is None:
            continue
        if not found.success:
            failures.append(found)
        elif best is None or found.duration < best.duration:
            best, best_way = found, long_way
    if best is None:
        _explain_failure(failures)
    profile = _profile(inner, limits, best)
    if envelope.extras.rows:
        profile, best, more = _tightened(inner, limits, envelope, best_way, best, profile, steps)
        total += more
    excess = certificate(profile, limits)
    worst = max(excess, key=lambda k: excess[k])
    error = float(angle_between(profile.final()[0], inner.stop.quaternion))
    if excess[worst] > _PERMITTED or error > _MISSED:
        raise InfeasibleError(f"the solver's answer exceeds the {worst} limit by {excess[worst]:.2e} of it and misses "
                              f"the attitude by {error:.2e} rad: no slew was certified", limit=worst,
                              excess=excess[worst])
    seconds = time.perf_counter() - _BUILDING[0] - began
    return Optimum(_with_last(profile, last), best_way, seconds, total, best.solver, tuple(steps), {"attempt": best})


def _with_last(profile: JerkProfile, last: JerkProfile | None) -> JerkProfile:
    if last is None:
        return profile
    return replace(profile, durations=np.append(profile.durations, last.durations),
                   jerks=np.concatenate([profile.jerks, last.jerks]))


def _replanned(request: SlewRequest, limits: Limits, envelope: Envelope, near: Optimum, name: str) \
        -> tuple[JerkProfile, _Attempt, dict[str, Any]] | None:
    """A solve from a neighbouring answer, primal and dual; None where it is not certified."""
    old: _Attempt | None = near.memory.get("attempt")
    if old is None or envelope.extras.rows:
        return None
    empty = np.zeros((1, 3))
    result = _solve(request, limits, envelope, near.long_way, old.fractions, empty, empty, empty, old.duration,
                    scales=old.scales, x0=old.x.copy(), dual=(old.lam_g, old.lam_x),
                    options=_WARM)
    if not result.success:
        return None
    profile = _profile(request, limits, result)
    error = float(angle_between(profile.final()[0], request.stop.quaternion))
    if max(certificate(profile, limits).values()) > _PERMITTED or error > _MISSED:
        return None
    return profile, result, {"attempt": result}


def _tightened(request: SlewRequest, limits: Limits, envelope: Envelope, long_way: bool, first: _Attempt,
               profile: JerkProfile, steps: list[str]) -> tuple[JerkProfile, _Attempt, int]:
    """Solve again with the margins of the additional rows enlarged until they hold between the nodes."""
    margin = np.zeros(envelope.extras.rows)
    attempt, spent = first, 0
    empty = np.zeros((1, 3))
    for _ in range(8):
        worst = envelope.largest(profile)
        if np.all(worst <= 1e-7):
            return profile, attempt, spent
        margin = margin + np.where(worst > 1e-7, 1.2 * worst + 1e-7, 0.0)
        again = _solve(request, limits, envelope, long_way, attempt.fractions, empty, empty, empty, attempt.duration,
                       scales=attempt.scales, x0=attempt.x.copy(), margin=margin, options=_QUICK)
        spent += again.iterations
        steps.append(f"margin {float(np.max(margin)):.1e} between nodes: {again.status}, {again.iterations} iterations")
        if not again.success:
            break
        attempt, profile = again, _profile(request, limits, again)
    worst = envelope.largest(profile)
    k = int(np.argmax(worst))
    if worst[k] > _PERMITTED:
        raise InfeasibleError(f"the {envelope.names[k]} is exceeded between the nodes by {worst[k]:.2e} (relative) "
                              "and no margin mends it", limit=envelope.names[k], excess=float(worst[k]))
    return profile, attempt, spent


def _too_short(needed: float, duration: float) -> InfeasibleError:
    ratio = needed / duration
    return InfeasibleError(
        f"the duration {duration:.6g} s is too short: the quickest slew within the limits takes {needed:.6g} s; "
        f"keeping it needs limits about {ratio:.4g} (rate), {ratio**2:.4g} (acceleration) and {ratio**3:.4g} (jerk) "
        "times as large", limit="duration", excess=needed - duration)


def _explain_failure(failures: list[_Attempt]) -> NoReturn:
    """Raise the error that says which limit stood in the way, and by how much."""
    if not failures:
        raise InfeasibleError("no starting point was found", limit="", excess=None)
    worst = min(failures, key=lambda a: a.worst[1])
    name, excess = worst.worst
    raise InfeasibleError(f"no slew was found ({worst.status}): nearest to one, the {name} still misses by "
                          f"{excess:.3e} of its scale", limit=name, excess=excess)


def prepare() -> None:
    """Make and compile what the usual slew needs, so that the first answer is as quick as the later ones."""
    begun = time.perf_counter()
    transcription(2 * (PARTS[0] + PARTS[1] + PARTS[2]) + PARTS[3], Extras()).solver("ipopt", **_QUICK)
    transcription(_FINE, Extras()).solver("ipopt", **_QUICK)
    _BUILDING[0] += time.perf_counter() - begun
