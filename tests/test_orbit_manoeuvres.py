"""Manoeuvres of a geostationary satellite found in its ranges: number, times and sizes, against a simulated truth.

The truth is propagated with commanded burns, which enter the equations of motion as an outside input with edges of
their own; the search uses velocity steps and its own burns and is told neither times nor number.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimator.models.orbit_gravity import gravity_field
from estimator.models.orbit_integration import Tolerance, moved_grid, propagate
from estimator.models.orbit_motion import OBLIQUE_PRESSURE, SUN, THRUST, motion, motion_inputs
from estimator.orbit_signal import OrbitArc, VelocityStep, position_unknown, velocity_unknown
from estimator.residuals import KernelResidual
from estimator.unknowns import Unknown, Vector
from problems.geo_orbit.kept_orbit import KeptExplanation, consistent, explained_kept
from problems.geo_orbit.manoeuvres import Manoeuvre, _least_squares, neighbours
from problems.geo_orbit.problem import OrbitModel, orbit_model, orbit_problem
from problems.geo_orbit.settings import settings_from
from problems.geo_orbit.tracking import Observations, Station, Tracking

EPOCH = "2022-05-10T00:00:00"
DAY = 86400.0
STATIONS = {
    name: Station(name, np.radians(latitude), np.radians(longitude), altitude)
    for name, latitude, longitude, altitude in (
        ("Cape", -33.9, 18.5, 50.0),
        ("North", 52.0, 5.0, 30.0),
        ("West", 28.0, -16.0, 100.0),
        ("East", 35.0, 33.0, 200.0),
    )
}
NOISE = 2.0  # m


@dataclass(frozen=True)
class Burned:
    """A simulated burn: middle (s), duration (s), velocity in orbital axes (m/s)."""

    time: float
    duration: float
    velocity: tuple[float, float, float]


def tables(burns: tuple[Burned, ...]) -> dict:
    """Settings with commanded burns; without any, those of the search."""
    radius, longitude = 42164.5e3, np.radians(247.0)  # m; celestial longitude at the epoch
    speed = np.sqrt(3.986004418e14 / radius)
    start = np.datetime64(EPOCH, "us")

    def text(t: float) -> str:
        return str(start + np.timedelta64(round(t * 1e6), "us"))

    return {
        "satellite": {"mass_kg": 2000.0, "area_m2": 40.0},
        "orbit": {
            "epoch": EPOCH,
            "frame": "GCRF",
            "position_m": [radius * np.cos(longitude), radius * np.sin(longitude), 12e3],
            "velocity_m_s": [-speed * np.sin(longitude), speed * np.cos(longitude), 1.5],
        },
        "forces": {"degree": 4, "solar_radiation_pressure": {"coefficient": 1.4, "estimated": True}},
        "measurements": {"range_sigma_m": NOISE},
        "burns": [
            {
                "start": text(b.time - b.duration / 2),
                "stop": text(b.time + b.duration / 2),
                "acceleration_m_s2": [v / b.duration for v in b.velocity],
            }
            for b in burns
        ],
    }


def simulated(burns: tuple[Burned, ...], days: float, *, gap: tuple[float, float] = (0.0, 0.0), seed: int = 1,
              biases: bool = True) -> OrbitModel:
    """Ranges of four stations every hour with noise and station biases, in the model of the search."""
    step = 3600.0
    seconds = np.arange(900.0, days * DAY, step)
    seconds = seconds[(seconds < gap[0]) | (seconds > gap[1])]
    settings = settings_from(tables(burns), STATIONS)
    from estimator.models.earth_orientation import tai_from_utc

    tai = tai_from_utc([EPOCH])[0] + np.round(seconds * 1e6).astype("timedelta64[us]")
    rng = np.random.default_rng(seed)
    empty = Tracking(
        tuple(Observations("range", n, n, tai, np.full((len(tai), 1), 38e6)) for n in STATIONS), dict(STATIONS)
    )
    truth = orbit_problem(orbit_model(empty, settings))
    observations = []
    for k, (o, r) in enumerate(zip(empty.observations, truth.residuals, strict=True)):
        assert isinstance(r, KernelResidual)
        ideal = o.value - r.linearize(truth.start).residual
        bias = 30.0 * (k - 1.5) if biases else 0.0  # m
        observations.append(replace(o, value=ideal + bias + NOISE * rng.standard_normal(ideal.shape)))
    again = settings_from(tables(()), STATIONS)
    return orbit_model(Tracking(tuple(observations), dict(STATIONS)), again)


def check(explanation: KeptExplanation | None, burns: tuple[Burned, ...]) -> None:
    """Number, times and sizes within five sigmas, and the held-out data explained to their noise."""
    assert explanation is not None
    found = sorted((e for e in explanation.effects if e.name.startswith("impulsive-manoeuvre")),
                   key=lambda e: e.parameters["time"]["value"])
    assert len(found) == len(burns)
    for e, b in zip(found, burns, strict=True):
        p = e.parameters
        assert abs(p["time"]["value"] - b.time) < 5 * p["time"]["sigma"] + 30.0
        for name, v in zip(("radial", "along", "cross"), b.velocity, strict=True):
            # An impulse has the axes of the state before it, a burn those that turn with it: dv^2/(2 v) apart.
            assert abs(p[name]["value"] - v) < 5 * p[name]["sigma"] + np.sum(np.square(b.velocity)) / 3e3
        assert p["cross"]["sigma"] < 0.02
        before, after = e.proof.held_out["range"]
        assert after < before
        assert e.proof.p_value < 1e-3
    assert explanation.after["range"][1] < 1.3 * NOISE
    answer = explanation.as_dict()
    assert answer["verdict"] in ("named", "ambiguous")
    for key in ("where", "effects", "next_measurement", "seconds"):
        assert key in answer
    for e in answer["effects"]:
        assert {"name", "group", "parameters", "score", "p_value_after_search", "gap_before", "gap_after",
                "held_out_before", "held_out_after"} <= set(e)
        assert all(set(p) == {"value", "sigma", "unit"} for p in e["parameters"].values())


def test_derivatives_of_a_burn_follow_from_its_edges() -> None:
    """Time, velocity and duration of a burn, forward and backward in time, against differences."""
    model = simulated((), 3.0)
    position, velocity = position_unknown(), velocity_unknown()
    burn = Unknown("burn", Vector(5, ("time", "radial", "along", "cross", "duration")), "s", 1.0)
    equations = motion(gravity_field("EGM2008_120", 2), [SUN, OBLIQUE_PRESSURE, THRUST], [THRUST.name], 0.02)
    values = {"position": model.position, "velocity": model.velocity,
              "burn": np.array([1.2e5, 0.1, -0.2, 0.3, 5000.0])}
    times = np.array([2e4, 1.19e5, 1.21e5, 1.5e5, 2.5e5])
    for start in (0.0, 1.2e5, 2.5e5):
        arc = OrbitArc("arc", equations, motion_inputs(model.environment), start, (0.0, 2.5e5), position, velocity, (),
                       np.array([0.1, 0.1, 0.0, 0.0, 0.0]), (VelocityStep(burn, burning=True),), (), THRUST.name)
        _, derivative = arc.at(times, values)
        for k, h in enumerate((5.0, 1e-3, 1e-3, 1e-3, 5.0)):
            ends = []
            for sign in (1, -1):
                moved = values["burn"].copy()
                moved[k] += sign * h
                ends.append(arc.at(times, {**values, "burn": moved})[0])
            numerical = (ends[0] - ends[1]) / (2 * h)
            size = np.abs(numerical).max(axis=0) + 1e-12
            assert np.all(np.abs(derivative[:, :, 6 + k] - numerical).max(axis=0) < 1e-4 * size[:3].max())


def test_nothing_is_found_in_a_quiet_orbit() -> None:
    assert explained_kept(simulated((), 8.0)) is None


def test_three_manoeuvres_two_of_them_close() -> None:
    burns = (
        Burned(2.43 * DAY, 600.0, (0.0, 0.02, 0.5)),
        Burned(5.10 * DAY, 5400.0, (-0.06, 0.0, 0.12)),
        Burned(5.61 * DAY, 4500.0, (-0.05, 0.01, -0.11)),
    )
    check(explained_kept(simulated(burns, 9.0)), burns)


def test_one_manoeuvre_in_a_gap_of_the_data() -> None:
    burns = (Burned(4.05 * DAY, 1200.0, (0.01, 0.05, -0.3)),)
    model = simulated(burns, 8.0, gap=(3.8 * DAY, 4.4 * DAY), seed=3)
    check(explained_kept(model), burns)


def test_steps_that_moved_a_little_integrate_alike() -> None:
    """Steps carried over to neighbouring ends give the same orbit; ends far away get none."""
    model = simulated((), 3.0)
    equations = motion(gravity_field("EGM2008_120", 2), [SUN, THRUST], [], 0.02)
    inputs = motion_inputs(model.environment)
    start = equations.step.start(np.concatenate([model.position, model.velocity]))
    parameters = np.array([0.0, 0.0, 0.0])
    tolerance = Tolerance(1e-12, (1e-3, 1e-3, 1e-3, 1e-7, 1e-7, 1e-7))
    ends = (0.0, 6e4)
    _, grid = propagate(equations.step, start, parameters, inputs, np.array(ends), tolerance=tolerance)
    near = (0.0, 6e4 + 300.0)
    moved = moved_grid(grid, ends, near, inputs)
    assert moved is not None
    again, _ = propagate(equations.step, start, parameters, inputs, np.array(near), grid=moved)
    exact, _ = propagate(equations.step, start, parameters, inputs, np.array(near))
    assert np.linalg.norm(again.values[-1][:3] - exact.values[-1][:3]) < 0.02  # m
    assert moved_grid(grid, ends, (0.0, 9e4), inputs) is None
    assert moved_grid(grid, ends, (6e4, 0.0), inputs) is None


def test_burns_without_a_measurement_between_them_are_neighbours() -> None:
    steps = {n: Manoeuvre(t, np.zeros(3)) for n, t in (("a", 100.0), ("b", 300.0), ("c", 2000.0), ("d", 5000.0))}
    times = np.array([0.0, 1000.0, 3000.0, 4000.0, 6000.0])
    sure = dict.fromkeys(steps, 1.0)
    assert neighbours(steps, sure, times) == [("a", "b")]
    assert neighbours(steps, {**sure, "c": 1600.0}, times) == [("a", "b"), ("b", "c"), ("c", "d")]


def test_a_name_is_believed_where_successive_arcs_agree() -> None:
    def offer(value: float, sigma: float) -> tuple[np.ndarray, np.ndarray]:
        return np.array([value]), np.array([sigma])

    arcs = [(0.0, 1.0), (1.0, 2.0)]
    assert consistent([{"x": offer(1.0, 0.1)}, {"x": offer(1.1, 0.1)}], arcs) == (("x",), ())
    believed, rejected = consistent([{"x": offer(1.0, 0.1)}, {"x": offer(-1.0, 0.1)}], arcs)
    assert not believed and "another size" in rejected[0]
    believed, rejected = consistent([{"x": offer(1.0, 0.1)}, {}], arcs)
    assert not believed and "one arc of 2 alone" in rejected[0]
    assert consistent([{"x": offer(1.0, 0.1)}], arcs[:1]) == (("x",), ())


def test_a_number_that_no_row_tells_gets_no_step() -> None:
    draw = np.random.default_rng(2)
    rows = draw.standard_normal((30, 5))
    right = draw.standard_normal(30)
    full = _least_squares(rows, right)
    np.testing.assert_allclose(full, np.linalg.lstsq(rows, right, rcond=None)[0], rtol=1e-10)
    silent = rows.copy()
    silent[:, 2] = 0.0
    step = _least_squares(silent, right)
    assert abs(step[2]) < 1e-12
    others = [0, 1, 3, 4]
    np.testing.assert_allclose(step[others], _least_squares(rows[:, others], right), rtol=1e-8)
