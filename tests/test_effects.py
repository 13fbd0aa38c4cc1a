"""Every effect of the library against the rules, and the physics of each against an independent computation."""

from __future__ import annotations

import importlib.metadata
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from estimator.effects import declaration, library
from estimator.effects.checks import numeric, problems_of, random_sample
from estimator.effects.declaration import Effect, EffectInstance, Layout, Parameter, Sample, Search, declare
from estimator.effects.documentation import EXAMPLE, main, render
from estimator.models import flexible_mode, propellant
from estimator.models.earth import GRAVITATIONAL_PARAMETER, ROTATION_RATE
from estimator.models.environment import gravity
from estimator.models.errors import RequestError
from estimator.models.radar import SPEED_OF_LIGHT
from estimator.models.three_by_three import solve

SHIPPED = library.shipped()
NAMES = (
    "gravity-gradient-torque", "residual-magnetic-dipole", "aerodynamic-torque", "solar-radiation-torque",
    "constant-body-torque", "internal-momentum", "viscous-damping", "flexible-appendage", "propellant-slosh",
    "torque-scale-error", "actuator-axis-nonorthogonality", "actuator-lag", "stellar-aberration",
    "tracker-timetag-offset", "tracker-low-frequency-error", "tracker-frame-jump", "carrier-frequency-offset",
    "doppler-bias", "beam-mispointing", "antenna-thermal-deformation", "doppler-timetag-offset", "gnss-lever-arm",
    "gnss-timetag-offset", "earth-rotation-offset", "second-order-doppler", "pointing-offset-per-session",
)


@pytest.fixture
def registry() -> Iterator[None]:
    """The registry as it was, after a test that adds to it."""
    before = dict(declaration._REGISTRY)
    files, entries = set(library._loaded_files), set(library._loaded_entry_points)
    yield
    declaration._REGISTRY.clear()
    declaration._REGISTRY.update(before)
    library._loaded_files.clear()
    library._loaded_files.update(files)
    library._loaded_entry_points.clear()
    library._loaded_entry_points.update(entries)


def instance(name: str, layout: Layout = EXAMPLE) -> EffectInstance:
    return next(i for i in SHIPPED[name.split(":")[0]].instances(layout) if i.name == name)


def contribution(name: str, sample: dict[str, np.ndarray], p: object) -> np.ndarray:
    return numeric(instance(name), EXAMPLE).contribution(sample, np.atleast_1d(np.asarray(p, dtype=float)))


def rotation(q: np.ndarray) -> Rotation:
    return Rotation.from_quat(q, scalar_first=True)


@pytest.fixture
def sample() -> dict[str, np.ndarray]:
    return random_sample(np.random.default_rng(5), EXAMPLE, 0)


# ---- the rules, for every effect of the registry ---------------------------------------------------------------------


def test_library_holds_every_named_effect() -> None:
    assert set(NAMES) <= set(SHIPPED)


@pytest.mark.parametrize("name", sorted(SHIPPED))
def test_effect_keeps_the_rules(name: str) -> None:
    assert problems_of(SHIPPED[name], EXAMPLE, seed=len(name), samples=6) == []


def _made(function: object, rows: tuple[Parameter, ...]) -> Effect:
    made = EffectInstance("made-up", "made-up", "torque", rows, function, "p = 0", "test")  # type: ignore[arg-type]
    return Effect("made-up", "torque", "made up", lambda layout: (made,))


@pytest.mark.parametrize(("function", "complaint"), [
    (lambda s, p: p + 1e-9, "not zero"),
    (lambda s, p: p * p, "no derivative"),
    (lambda s, p: p[:2], "rows"),
    (lambda s, p: p / ca.norm_2(p), "finite"),
    (lambda s, p: ca.floor(p * 1e9) / 1e9, "disagrees"),
])
def test_the_rules_can_be_broken(function: object, complaint: str) -> None:
    parameters = declaration.axes("torque", "N m", 1e-5, 1e-2)
    with np.errstate(invalid="ignore"):
        assert any(complaint in problem for problem in problems_of(_made(function, parameters), EXAMPLE))


def test_an_incomplete_declaration_is_found() -> None:
    wrong = (Parameter("torque_x", "", 1.0, (0.5, 0.7)), Parameter("torque_x", "N m", 1.0, (-1, 1), nominal=3.0),
             Parameter("torque_z", "N m", 1.0, (-2, 2)))
    text = " ".join(problems_of(_made(lambda s, p: p, wrong), EXAMPLE, samples=1))
    for complaint in ("same name", "unit", "zero is not in", "typical size", "nominal"):
        assert complaint in text


# ---- torques ---------------------------------------------------------------------------------------------------------


def test_gravity_gradient_is_the_torque_on_point_masses(sample: dict[str, np.ndarray]) -> None:
    rng = np.random.default_rng(1)
    arms = rng.standard_normal((3, 3)).astype(np.longdouble)
    arms = np.concatenate([arms, -arms])  # pairs of equal masses about the centre
    masses = np.repeat(np.array([3.0, 5.0, 7.0], dtype=np.longdouble)[None], 2, axis=0).ravel()
    inertia = sum(m * (a @ a * np.eye(3) - np.outer(a, a)) for m, a in zip(masses, arms, strict=True))
    centre = rotation(sample["attitude"]).apply(sample["position"]).astype(np.longdouble)
    torque = np.zeros(3, dtype=np.longdouble)
    for m, a in zip(masses, arms, strict=True):
        place = centre + a
        torque += np.cross(a, -m * np.longdouble(GRAVITATIONAL_PARAMETER) * place / np.sqrt(place @ place) ** 3)
    sample["inertia"] = np.asarray(inertia, dtype=float)
    found = contribution("gravity-gradient-torque", sample, 1.0)
    assert found == pytest.approx(np.asarray(torque, dtype=float), rel=1e-5)  # next multipole: arm over radius, 4e-7


def test_dipole_is_a_current_loop_in_the_field(sample: dict[str, np.ndarray]) -> None:
    first, second = np.array([0.3, -0.2, 0.5]), np.array([0.1, 0.4, 0.2])
    angle = np.linspace(0, 2 * np.pi, 201)
    points = np.outer(np.cos(angle), first) + np.outer(np.sin(angle), second)
    field = rotation(sample["attitude"]).apply(sample["magnetic_field"])
    current = 2.0  # A
    edges, middles = np.diff(points, axis=0), (points[1:] + points[:-1]) / 2
    torque = np.sum(np.cross(middles, current * np.cross(edges, field)), axis=0)
    area = np.sum(np.cross(points[:-1], points[1:]), axis=0) / 2
    assert contribution("residual-magnetic-dipole", sample, current * area) == pytest.approx(torque, rel=1e-9)


def test_pressures_act_along_wind_and_light(sample: dict[str, np.ndarray]) -> None:
    turn = rotation(sample["attitude"])
    arm, area, coefficient = np.array([0.1, -0.4, 0.2]), 6.0, 2.2
    wind = turn.apply(sample["earth_fixed_velocity"])
    drag = -0.5 * sample["density"] * coefficient * area * np.linalg.norm(wind) * wind
    found = contribution("aerodynamic-torque", sample, arm * area * coefficient)
    assert found == pytest.approx(np.cross(arm, drag), rel=1e-12)
    push = -1361.0 / SPEED_OF_LIGHT * area * turn.apply(sample["sun"])  # solar constant, W/m2
    found = contribution("solar-radiation-torque", sample, arm * area)
    assert found == pytest.approx(np.cross(arm, push), rel=2e-3)
    sample["sunlit"] = np.array(0.0)
    assert np.all(contribution("solar-radiation-torque", sample, arm * area) == 0)


def test_internal_momentum_and_damping(sample: dict[str, np.ndarray]) -> None:
    momentum = np.array([0.3, 1.0, -2.0])
    torque = contribution("internal-momentum", sample, momentum)
    assert abs(torque @ sample["rate"]) < 1e-15  # it does no work
    assert torque == pytest.approx(-np.cross(sample["rate"], momentum))
    assert contribution("viscous-damping", sample, [1e-3, 2e-3, 3e-3]) @ sample["rate"] < 0
    assert contribution("constant-body-torque", sample, momentum) == pytest.approx(momentum)


# ---- coupled modes ---------------------------------------------------------------------------------------------------


def test_a_mode_of_one_coupling_vector(sample: dict[str, np.ndarray]) -> None:
    """The six-parameter form equals body and one scalar mode, solved as four equations."""
    rng = np.random.default_rng(2)
    d, q, speed = 3.0 * rng.standard_normal(3), 1e-2 * rng.standard_normal(3), 1e-3 * rng.standard_normal(3)
    frequency, damping = 0.11, 0.01
    n = 2 * np.pi * frequency
    system = np.block([[sample["inertia"], d[:, None]], [d[None, :], np.ones((1, 1))]])
    right = np.concatenate([sample["other_torque"] - np.cross(sample["rate"], d * (d @ speed)),
                            [-n * n * (d @ q) - 2 * damping * n * (d @ speed)]])
    answer = np.linalg.solve(system, right)
    coupling = np.outer(d, d)
    p = [*np.diag(coupling), coupling[0, 1], coupling[0, 2], coupling[1, 2], frequency, damping]
    functions = numeric(instance("flexible-appendage"), EXAMPLE)
    values = {**sample, "state": np.concatenate([q, speed])}
    torque = functions.contribution(values, np.array(p))
    assert torque == pytest.approx(sample["inertia"] @ answer[:3] - sample["other_torque"], rel=1e-9, abs=1e-13)
    assert functions.state_derivative is not None
    assert d @ functions.state_derivative(values, np.array(p))[3:] == pytest.approx(answer[3], rel=1e-9)


def test_propellant_is_a_point_mass_on_springs(sample: dict[str, np.ndarray]) -> None:
    """The matrix form equals body and one mass, solved as six equations with the reaction at the mass."""
    rng = np.random.default_rng(3)
    mass, b = 12.0, np.array([0.4, -0.7, 0.5])
    displacement, speed = 0.05 * rng.standard_normal((3, 3)), 1e-2 * rng.standard_normal((3, 3))
    frequency, damping = 0.05, 0.1
    n, w = 2 * np.pi * frequency, sample["rate"]
    xi, xi_dot = displacement @ b, speed @ b
    r = b + xi
    force = -mass * (n * n * xi + 2 * damping * n * xi_dot)
    at_rest = mass * (b @ b * np.eye(3) - np.outer(b, b))
    hub = sample["inertia"] - at_rest
    # other torque holds minus w x (J w) of the whole body; the hub alone has its own gyroscopic term
    outer = sample["other_torque"] + np.cross(w, sample["inertia"] @ w)
    cross_r = np.cross(r, np.eye(3)).T  # a -> r x a
    system = np.block([[hub, np.zeros((3, 3))], [-mass * cross_r, mass * np.eye(3)]])
    right = np.concatenate([outer - np.cross(w, hub @ w) - np.cross(r, force),
                            force - mass * (2 * np.cross(w, xi_dot) + np.cross(w, np.cross(w, r)))])
    answer = np.linalg.solve(system, right)
    moment = mass * np.outer(b, b)
    p = np.array([*np.diag(moment), moment[0, 1], moment[0, 2], moment[1, 2], frequency, damping])
    functions = numeric(instance("propellant-slosh"), EXAMPLE)
    values = {**sample, "state": np.concatenate([displacement.T.ravel(), speed.T.ravel()])}
    torque = functions.contribution(values, p)
    assert torque == pytest.approx(sample["inertia"] @ answer[:3] - sample["other_torque"], rel=1e-9, abs=1e-13)
    assert functions.state_derivative is not None
    acceleration = functions.state_derivative(values, p)[9:].reshape(3, 3).T
    assert acceleration @ b == pytest.approx(answer[3:], rel=1e-9)


@pytest.mark.parametrize("kind", ["flexible", "propellant"])
def test_modes_keep_momentum_and_lose_energy_at_the_damper(kind: str) -> None:
    inertia = np.array([[800.0, -30, 10], [-30, 760, -120], [10, -120, 720]])
    moment = np.array([[40.0, 10, 5], [10, 30, -8], [5, -8, 60]])
    n, damping, size = 2 * np.pi * 0.05, 0.05, 3 if kind == "flexible" else 9
    w = ca.SX.sym("w", 3)
    x, v = ca.SX.sym("x", size), ca.SX.sym("v", size)
    other = -ca.cross(w, ca.mtimes(inertia, w))
    if kind == "flexible":
        a, b = x, v
        answer = flexible_mode.reaction(inertia, w, other, a, b, moment, n, damping)
        momentum = flexible_mode.momentum(inertia, w, b, moment)
        energy = flexible_mode.energy(inertia, w, a, b, moment, n)
        loss = 2 * damping * n * ca.mtimes([b.T, moment, b])
    else:
        a, b = ca.reshape(x, 3, 3), ca.reshape(v, 3, 3)
        answer = propellant.reaction(inertia, w, other, a, b, moment, n, damping)
        momentum = propellant.momentum(inertia, w, a, b, moment)
        energy = propellant.energy(inertia, w, a, b, moment, n)
        loss = 2 * damping * n * ca.trace(ca.mtimes([b, moment, b.T]))
    body = solve(ca.SX(inertia), other + answer.torque)
    rate = ca.Function("rate", [ca.vertcat(w, x, v)], [ca.vertcat(body, v, ca.vec(answer.acceleration), loss)])
    check = ca.Function("check", [ca.vertcat(w, x, v)], [momentum, energy])

    def derivative(_t: float, y: np.ndarray) -> np.ndarray:
        a, u, turn = y[0], y[1:4], y[4:7]
        product = np.concatenate([[-u @ turn], a * turn + np.cross(u, turn)])
        return np.concatenate([product / 2, np.array(rate(y[4:-1]))[:, 0]])

    start = np.concatenate([[1.0, 0, 0, 0], [0.02, -0.03, 0.05], np.zeros(2 * size), [0.0]])
    answer_ivp = solve_ivp(derivative, (0, 60), start, method="DOP853", rtol=1e-9, atol=1e-12)
    first, last = answer_ivp.y[:, 0], answer_ivp.y[:, -1]
    h0, e0 = (np.array(o).ravel() for o in check(first[4:-1]))
    h1, e1 = (np.array(o).ravel() for o in check(last[4:-1]))
    assert Rotation.from_quat(last[:4], scalar_first=True).apply(h1) == pytest.approx(h0, rel=1e-6)
    assert e0 - e1 == pytest.approx(last[-1:], rel=1e-4)
    assert last[-1] > 1e-5 * e0[0]  # the damper has done something


# ---- actuators -------------------------------------------------------------------------------------------------------


def _lagged_run(time_constant: float, step: float, until: float) -> tuple[np.ndarray, np.ndarray]:
    """Momentum and its integral after Runge-Kutta steps with the effect as declared."""
    effect = instance("actuator-lag")
    y, u, s, h, tau = (ca.SX.sym(n, k) for n, k in (("y", 3), ("u", 3), ("s", 1), ("h", 1), ("t", 1)))
    inputs = Sample(state=y, command=u, step=h, step_fraction=s)
    assert effect.state_derivative is not None
    call = ca.Function("f", [y, u, s, h, tau], [effect.function(inputs, tau) + u, effect.state_derivative(inputs, tau)])
    state = np.zeros(9)  # rate, angle, lagged command
    for k in range(round(until / step)):
        t = (k + 0.5) * step
        command = np.array([0.6 * (10 < t < 20), -0.6 * (15 < t < 25), 0.0])

        def rate(x: np.ndarray, fraction: float, command: np.ndarray = command) -> np.ndarray:
            torque, change = call(x[6:], command, fraction, step, time_constant)
            return np.concatenate([np.array(torque)[:, 0], x[:3], np.array(change)[:, 0]])

        k1 = rate(state, 0.0)
        k2 = rate(state + step / 2 * k1, 0.5)
        k3 = rate(state + step / 2 * k2, 0.5)
        k4 = rate(state + step * k3, 1.0)
        state = state + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return state[:3], state[3:6]


def _lagged_exactly(time_constant: float, until: float) -> tuple[np.ndarray, np.ndarray]:
    rate, angle = np.zeros(3), np.zeros(3)
    for start, step in ((10, [0.6, 0, 0]), (20, [-0.6, 0, 0]), (15, [0, -0.6, 0]), (25, [0, 0.6, 0])):
        a, jump = until - start, np.array(step)
        settled = 1 - np.exp(-a / time_constant) if time_constant > 0 else 1.0
        rate += jump * (a - time_constant * settled)
        angle += jump * (a * a / 2 - time_constant * a + time_constant**2 * settled)
    return rate, angle


@pytest.mark.parametrize("time_constant", [0.0, 1e-4, 0.02, 0.1, 1.5, 10.0])
@pytest.mark.parametrize("step", [0.25, 1.0])
def test_lag_is_exact_at_every_ratio_of_time_constant_to_step(time_constant: float, step: float) -> None:
    found, expected = _lagged_run(time_constant, step, 30.0), _lagged_exactly(time_constant, 30.0)
    assert found[0] == pytest.approx(expected[0], abs=1e-11)
    assert found[1] == pytest.approx(expected[1], abs=1e-10)


def test_lag_has_the_derivative_of_the_exact_motion_at_zero() -> None:
    small = 1e-5
    found = [(a - b) / (2 * small) for a, b in zip(_lagged_run(small, 0.25, 30.0), _lagged_run(-small, 0.25, 30.0),
                                                   strict=True)]
    expected = [(a - b) / small for a, b in zip(_lagged_exactly(small, 30.0), _lagged_exactly(0.0, 30.0), strict=True)]
    assert found[0] == pytest.approx(expected[0], abs=1e-6)
    assert found[1] == pytest.approx(expected[1], rel=1e-5)


def test_gains_and_axes_of_the_actuators(sample: dict[str, np.ndarray]) -> None:
    command = sample["command"]
    assert contribution("torque-scale-error", sample, [0.1, 0.2, 0.3]) == pytest.approx(command * [0.1, 0.2, 0.3])
    angle = 0.01
    columns = [command * 0]
    for axis in range(3):
        values = {**sample, "command": np.eye(3)[axis]}
        columns.append(np.eye(3)[axis] + contribution("actuator-axis-nonorthogonality", values, [angle, 0, 0]))
    x, y, z = columns[1:]
    between = np.arccos(x @ y / np.linalg.norm(x) / np.linalg.norm(y))
    assert between == pytest.approx(np.pi / 2 - angle, abs=1e-6)
    assert abs(x @ z) < 1e-15
    assert abs(y @ z) < 1e-15


# ---- star tracker ----------------------------------------------------------------------------------------------------


def _aberrated(star: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """Apparent direction by the Lorentz transformation of the photon's wave vector, rest frame to moving observer."""
    speed = np.linalg.norm(beta)
    gamma = 1 / np.sqrt(1 - speed**2)
    along = beta / speed
    wave = -star  # the photon flies against the direction of the star; its frequency is 1
    parallel = gamma * (wave @ along - speed)
    moved = wave - (wave @ along) * along + parallel * along
    return -moved / np.linalg.norm(moved)


def test_aberration_turns_the_attitude_of_a_field_of_stars(sample: dict[str, np.ndarray]) -> None:
    turn = rotation(sample["attitude"])
    beta = turn.apply(sample["velocity"] + sample["earth_velocity"]) / SPEED_OF_LIGHT
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    field = 1e-3  # rad, radius of the ring of stars about the boresight
    stars = np.stack([np.sin(field) * np.cos(angle), np.sin(field) * np.sin(angle), np.full(12, np.cos(field))], axis=1)
    seen = np.array([_aberrated(s, beta) for s in stars])
    measured, _ = Rotation.align_vectors(seen, stars)  # catalogue to apparent, tracker axes: measured o true*
    found = contribution("stellar-aberration", sample, 1.0)
    # about the boresight a ring determines less and the shift is not a rigid turn: field times beta
    assert found[:2] == pytest.approx(measured.as_rotvec()[:2], abs=2e-10)
    assert found[2] == pytest.approx(0.0, abs=1e-20)
    assert 1e-5 < np.linalg.norm(found) < 2e-4


def test_aberration_follows_the_boresight_of_the_layout(sample: dict[str, np.ndarray]) -> None:
    layout = Layout(3, EXAMPLE.sessions, EXAMPLE.span, 5900.0, EXAMPLE.tracker_span, tracker_boresight=(1.0, 0.0, 0.0))
    (along_x,) = SHIPPED["stellar-aberration"].instances(layout)
    found = numeric(along_x, layout).contribution(sample, np.array([1.0]))
    assert found[0] == 0
    assert np.linalg.norm(found) > 1e-6


def test_tracker_clock(sample: dict[str, np.ndarray]) -> None:
    offset = 0.1
    body_turn = Rotation.from_rotvec(sample["rate"] * offset)  # of the body in its own axes during the offset
    later = (rotation(sample["attitude"]).inv() * body_turn).inv()
    found = Rotation.from_rotvec(contribution("tracker-timetag-offset", sample, offset))
    assert ((found * rotation(sample["attitude"])) * later.inv()).magnitude() < 1e-15


def test_tracker_error_repeats_with_the_orbit_and_jumps_once(sample: dict[str, np.ndarray]) -> None:
    p = np.arange(1, 7) * 1e-5
    found = {}
    for phase in (0.0, np.pi / 2, np.pi):
        found[phase] = contribution("tracker-low-frequency-error", {**sample, "orbit_phase": np.array(phase)}, p)
    assert found[0.0] == pytest.approx(p[3:])
    assert found[np.pi / 2] == pytest.approx(p[:3])
    assert found[np.pi] == pytest.approx(-p[3:])
    jump = np.array([1e-4, -2e-4, 3e-4, 1000.0])
    before, after = ({**sample, "time": np.array(t)} for t in (998.0, 1002.0))
    assert contribution("tracker-frame-jump", before, jump) == pytest.approx(np.zeros(3), abs=1e-18)
    assert contribution("tracker-frame-jump", after, jump) == pytest.approx(jump[:3], rel=1e-12)
    at = numeric(instance("tracker-frame-jump"), EXAMPLE).along_parameters({**sample, "time": np.array(1000.02)}, jump)
    assert np.all(at[:, 3] == 0)  # samples do not see when, only between which two of them


# ---- radar -----------------------------------------------------------------------------------------------------------


def _shift(sample: dict[str, np.ndarray], attitude: Rotation | None = None, velocity: np.ndarray | None = None,
           beams: np.ndarray | None = None, deformation: Rotation | None = None) -> np.ndarray:
    turn = attitude if attitude is not None else rotation(sample["attitude"])
    speed = velocity if velocity is not None else sample["earth_fixed_velocity"]
    in_antenna = rotation(sample["antenna_from_tracker"]).apply(turn.apply(speed))
    if deformation is not None:
        in_antenna = deformation.apply(in_antenna)
    directions = beams if beams is not None else sample["beam_direction"]
    return 2 * sample["carrier_frequency"] / SPEED_OF_LIGHT * directions @ in_antenna


@pytest.mark.parametrize("beam", [0, 1, 2])
def test_one_beam_leaves_its_direction(sample: dict[str, np.ndarray], beam: int) -> None:
    angles = np.array([7e-5, -5e-5])
    beams = sample["beam_direction"].copy()
    beams[beam] = Rotation.from_rotvec([*angles, 0.0]).apply(beams[beam])
    found = contribution(f"beam-mispointing:{beam}", sample, angles)
    assert found == pytest.approx(_shift(sample, beams=beams) - _shift(sample), abs=1e-8)
    assert np.count_nonzero(found) == 1
    assert [p.name for p in instance(f"beam-mispointing:{beam}").parameters] == ["angle_x", "angle_y"]


def test_a_beam_along_another_axis_turns_about_the_other_two() -> None:
    layout = Layout(1, (), (0.0, 1.0), 5900.0, (0.0, 1.0), beam_directions=((0.98, 0.1, -0.17),))
    (made,) = SHIPPED["beam-mispointing"].instances(layout)
    assert [p.name for p in made.parameters] == ["angle_y", "angle_z"]
    assert problems_of(SHIPPED["beam-mispointing"], layout, samples=3) == []


def test_shift_of_a_pulse_reflected_at_rest() -> None:
    """Times of two echoes of a transmitter that approaches a wall give the exact two-way shift."""
    speed, carrier = 7000.0, 9.6e9
    distance = 1e6

    def echo(emitted: float) -> float:  # emitted at distance - speed t; back at the transmitter later
        at_wall = emitted + (distance - speed * emitted) / SPEED_OF_LIGHT
        return (at_wall + (distance / SPEED_OF_LIGHT)) / (1 + speed / SPEED_OF_LIGHT)

    shift = carrier * (1.0 / (echo(1.0) - echo(0.0)) - 1.0)
    values = random_sample(np.random.default_rng(0), EXAMPLE, 0)
    one = np.array([1.0, 0, 0, 0])
    values |= {"attitude": one, "antenna_from_tracker": one, "earth_fixed_velocity": np.array([0, 0, speed]),
               "beam_direction": np.array([[0, 0, 1.0]] * 3), "carrier_frequency": np.array(carrier)}
    found = 2 * carrier * speed / SPEED_OF_LIGHT + contribution("second-order-doppler", values, 1.0)
    assert found == pytest.approx(np.full(3, shift), abs=5e-4)  # Hz: rounding of the echo times on 9.6 GHz
    assert contribution("second-order-doppler", values, 1.0)[0] == pytest.approx(10.46, abs=0.02)  # Hz


def test_scale_bias_and_frames_of_the_radar(sample: dict[str, np.ndarray]) -> None:
    assert contribution("carrier-frequency-offset", sample, 3e-6) == pytest.approx(3e-6 * _shift(sample), rel=1e-12)
    assert contribution("doppler-bias", sample, 4.0) == pytest.approx(np.full(3, 4.0))
    p = np.array([1e-4, -2e-4, 3e-5, 2e-4, 5e-5, -1e-4])
    turn = Rotation.from_rotvec(np.sin(sample["orbit_phase"]) * p[:3] + np.cos(sample["orbit_phase"]) * p[3:])
    expected = _shift(sample, deformation=turn) - _shift(sample)
    assert contribution("antenna-thermal-deformation", sample, p) == pytest.approx(expected, abs=1e-8)
    turned = Rotation.from_euler("z", 2e-4).apply(sample["earth_fixed_velocity"])
    expected = _shift(sample, velocity=turned) - _shift(sample)
    assert contribution("earth-rotation-offset", sample, 2e-4) == pytest.approx(expected, abs=1e-8)


def test_an_offset_in_one_session_leaves_the_others(sample: dict[str, np.ndarray]) -> None:
    p = np.array([1e-4, -2e-4, 3e-4, -3e-4, 1e-4, 2e-4])
    for k, (start, stop) in enumerate(EXAMPLE.sessions):
        turned = Rotation.from_rotvec(p[3 * k : 3 * k + 3]) * rotation(sample["attitude"])
        for time in (start, (start + stop) / 2, stop):
            found = contribution("pointing-offset-per-session", {**sample, "time": np.array(time)}, p)
            assert found == pytest.approx(_shift(sample, attitude=turned) - _shift(sample), abs=1e-8)
    assert np.all(contribution("pointing-offset-per-session", {**sample, "time": np.array(1000.0)}, p) == 0)


def _orbit(offset: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Position and velocity now and after ``offset``, central gravity and J2, by an independent integrator."""
    start = np.array([6.9e6, 3e5, -1.2e6, 1.3e3, -9e2, 7.3e3])

    def derivative(_t: float, y: np.ndarray) -> np.ndarray:
        return np.concatenate([y[3:], gravity(y[None, :3])[0]])

    end = solve_ivp(derivative, (0, offset), start, method="DOP853", rtol=1e-13, atol=1e-9).y[:, -1]
    return start[:3], start[3:], end[:3], end[3:]


def test_clocks_of_receiver_and_radar(sample: dict[str, np.ndarray]) -> None:
    offset = 0.5
    r0, v0, r1, v1 = _orbit(offset)
    spin = np.array([0, 0, ROTATION_RATE])
    angle = float(sample["earth_angle"])
    sample |= {"position": r0, "velocity": v0, "acceleration": gravity(r0[None])[0],
               "earth_fixed_velocity": v0 - np.cross(spin, r0)}
    expected = (Rotation.from_euler("z", -(angle + ROTATION_RATE * offset)).apply(r1)
                - Rotation.from_euler("z", -angle).apply(r0))
    found = contribution("gnss-timetag-offset", sample, offset)
    assert found == pytest.approx(expected, abs=1e-3)  # m: next term, jerk 0.01 m/s3 times offset^3/6
    later = (rotation(sample["attitude"]).inv() * Rotation.from_rotvec(sample["rate"] * offset)).inv()
    expected = _shift(sample, attitude=later, velocity=v1 - np.cross(spin, r1)) - _shift(sample)
    found = contribution("doppler-timetag-offset", sample, offset)
    assert found == pytest.approx(expected, abs=0.2)  # Hz: next term, jerk times offset^2/2 times 64 Hz/(m/s)
    assert np.max(np.abs(found)) > 100.0


# ---- navigation receiver ---------------------------------------------------------------------------------------------


def test_lever_arm_turns_with_the_body(sample: dict[str, np.ndarray]) -> None:
    arm = np.array([1.4, -0.8, 2.1])
    inertial = rotation(sample["attitude"]).inv().apply(arm)
    expected = Rotation.from_euler("z", -float(sample["earth_angle"])).apply(inertial)
    assert contribution("gnss-lever-arm", sample, arm) == pytest.approx(expected, abs=1e-12)
    assert np.all(contribution("gnss-lever-arm", {**sample, "inside_arc": np.array(0.0)}, arm) == 0)


# ---- discovery and documentation -------------------------------------------------------------------------------------

USER_EFFECT = '''
"""A torque fixed in inertial space."""

from estimator.effects import axes, declare
from estimator.models.rotations import rotate


def contribution(sample, p):
    return rotate(sample.attitude, p)


declare("inertial-torque", "torque", axes("torque", "N m", 1e-5, 1e-2), contribution,
        summary="A torque fixed in inertial axes.", formula="tracker_from_inertial torque", zero="torque = 0",
        reference="example")
'''


def test_page_is_up_to_date() -> None:
    page = Path(__file__).resolve().parents[1] / "docs" / "effects.md"
    assert page.read_text() == render(SHIPPED), "run python -m estimator.effects.documentation"
    for effect in SHIPPED.values():
        assert f"### `{effect.name}`" in page.read_text()


@pytest.mark.usefixtures("registry")
@pytest.mark.parametrize("way", ["file", "directory", "variable"])
def test_an_effect_in_a_users_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, way: str) -> None:
    file = tmp_path / "effects" / "mine.py"
    file.parent.mkdir()
    file.write_text(USER_EFFECT)
    (file.parent / "_helper.py").write_text("raise RuntimeError('not an effect')")
    monkeypatch.delenv(library.VARIABLE, raising=False)
    places = [file if way == "file" else file.parent]
    if way == "variable":
        monkeypatch.setenv(library.VARIABLE, str(file.parent))
        places = []
    found = library.load(places)
    assert set(found) == set(SHIPPED) | {"inertial-torque"}
    assert library.load(places) == found  # a second time changes nothing
    assert problems_of(found["inertial-torque"], EXAMPLE, samples=3) == []
    assert [i.name for i in library.select(["inertial-torque"], EXAMPLE, places)] == ["inertial-torque"]
    output = tmp_path / "page.md"
    assert main(["--output", str(output), *(f"--effects-file={p}" for p in places)]) == 0
    assert ("### `inertial-torque`" in output.read_text()) == (way != "variable")


@pytest.mark.usefixtures("registry")
def test_an_effect_of_an_installed_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "installed_effects.py").write_text(USER_EFFECT)
    monkeypatch.syspath_prepend(tmp_path)
    entry = importlib.metadata.EntryPoint("mine", "installed_effects", library.GROUP)
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: (entry,) if group == library.GROUP else ())
    assert "inertial-torque" in library.load()
    sys.modules.pop("installed_effects", None)


@pytest.mark.usefixtures("registry")
@pytest.mark.parametrize(("text", "complaint"), [
    ("this has no meaning", "SyntaxError"),
    (USER_EFFECT + "\nraise RuntimeError('late')", "late"),
    (USER_EFFECT.replace("inertial-torque", "gravity-gradient-torque"), "registered already"),
])
def test_a_broken_file_is_named_and_leaves_nothing(tmp_path: Path, text: str, complaint: str) -> None:
    library.load()
    before = set(declaration.registry())
    file = tmp_path / "broken.py"
    file.write_text(text)
    with pytest.raises(RequestError, match=r"broken\.py") as caught:
        library.load([file])
    assert complaint in str(caught.value)
    assert set(declaration.registry()) == before


def test_a_place_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="nothing-here"):
        library.load([tmp_path / "nothing-here.py"])


def test_effects_are_chosen_by_name() -> None:
    names = [i.name for i in library.select(["beam-mispointing:1", "beam-mispointing", "doppler-bias"], EXAMPLE)]
    assert names == ["beam-mispointing:1", "beam-mispointing:0", "beam-mispointing:2", "doppler-bias"]
    with pytest.raises(RequestError, match="gravity-gradient-torque"):
        library.select(["gravity-gradient"], EXAMPLE)
    with pytest.raises(RequestError, match="beam-mispointing:2"):
        library.select(["beam-mispointing:7"], EXAMPLE)
    without = Layout(0, (), (0.0, 1.0), 5900.0, (0.0, 0.0))
    existing = library.instances(without)
    assert not {"beam-mispointing:0", "pointing-offset-per-session", "tracker-frame-jump"} & set(existing)
    with pytest.raises(RequestError, match="does not exist on this campaign"):
        library.select(["pointing-offset-per-session"], without)


@pytest.mark.usefixtures("registry")
def test_a_name_is_given_once() -> None:
    with pytest.raises(ValueError, match="registered already"):
        declare("doppler-bias", "doppler", (Parameter("bias", "Hz", 1.0, (-1.0, 1.0)),), lambda s, p: p,
                summary="", formula="", zero="", reference="")


def test_the_library_costs_no_heavy_import() -> None:
    code = ("import sys; from estimator.effects import library; library.load(); "
            "print([m for m in ('astropy', 'ppigrf', 'matplotlib', 'pandas', 'xarray') if m in sys.modules])")
    answer = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == "[]"


@pytest.mark.parametrize("name", sorted(SHIPPED))
def test_instances_of_one_layout_are_the_same(name: str) -> None:
    assert SHIPPED[name].instances(EXAMPLE) == SHIPPED[name].instances(EXAMPLE)
    assert len({hash(i) for i in SHIPPED[name].instances(EXAMPLE)}) == len(SHIPPED[name].instances(EXAMPLE))


def test_a_search_goes_through_its_values_in_even_steps_of_its_measure() -> None:
    for search in (Search(0.01, 0.6, 13, "square-root"), Search(0.1, 10.0, 5, "logarithmic"),
                   Search(-2.0, 4.0, 7, "linear"), Search.of([1.0, 2.0, 10.0, 11.0, 50.0])):
        values = search.values()
        assert len(values) == search.number and np.all(np.diff(values) > 0)
        assert values[0] == pytest.approx(search.low) and values[-1] == pytest.approx(search.high)
        for a, b in pairwise(values):
            assert search.moved(float(a), 1.0) == pytest.approx(float(b), rel=1e-9)
            assert search.moved(float(b), -1.0) == pytest.approx(float(a), rel=1e-9, abs=1e-12)
            assert a < search.moved(float(a), 0.5) < b
        assert search.low < search.middle() < search.high


def test_jump_times_lie_inside_every_stretch_and_once_between_two() -> None:
    stretches = ((0.0, 60.0), (1000.0, 1300.0), (2000.0, 2030.0))
    layout = Layout(3, EXAMPLE.sessions, EXAMPLE.span, 5900.0, (0.0, 2030.0), tracker_stretches=stretches)
    (jump,) = SHIPPED["tracker-frame-jump"].instances(layout)
    search = jump.parameters[-1].search
    assert search is not None
    times = search.values()
    for start, stop in stretches:
        inside = times[(times > start) & (times < stop)]
        assert len(inside) >= 4 and np.max(np.diff(inside)) <= 15.0
    assert np.sum((times > 60.0) & (times < 1000.0)) == 1 and np.sum((times > 1300.0) & (times < 2000.0)) == 1
