"""Orbit determination: a simulated transfer orbit with known truth, the real W3B tracking, files, and bad input."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from estimator.models.earth_orientation import tai_from_utc
from estimator.models.errors import (
    FileFormatError,
    GeometryError,
    InputError,
    MissingDataError,
    RequestError,
    TooFewDataError,
    UnitError,
)
from estimator.residuals import KernelResidual
from problems.geo_orbit.commands import app
from problems.geo_orbit.effects import instances
from problems.geo_orbit.initial_orbit import initial_state
from problems.geo_orbit.plausibility import kepler
from problems.geo_orbit.problem import OrbitModel, orbit_model, orbit_problem
from problems.geo_orbit.settings import OrbitSettings, settings_from
from problems.geo_orbit.simulator import simulated_tracking
from problems.geo_orbit.solution import OrbitSolution, solve_tracking
from problems.geo_orbit.tracking import Observations, Station, Tracking
from problems.readers.tracking_ccsds import Ephemeris, read_oem, read_tdm, write_oem, write_tdm
from problems.readers.tracking_files import kind_of, read_files

SHARED = Path(__file__).resolve().parents[1].parent / "shared" / "data"
W3B = SHARED / "geo-w3b"
needs_w3b = pytest.mark.skipif(not W3B.exists(), reason="the W3B tracking data are not beside the repository")
EXAMPLES = Path(__file__).resolve().parents[1] / "examples"

EPOCH = "2021-06-04T00:00:00"
POSITION, VELOCITY = (-40.5e6, -10.0e6, 0.17e6), (760.0, -1475.0, 55.0)
STATIONS = {
    name: Station(name, np.radians(latitude), np.radians(longitude), altitude)
    for name, latitude, longitude, altitude in (
        ("Africa", -25.9, 27.7, 1560.0),
        ("East", 36.1, 127.5, 180.0),
        ("South", -30.6, 151.6, 1160.0),
        ("West", 39.3, -104.8, 2095.0),
    )
}


def settings(**changes: object) -> OrbitSettings:
    """Settings of the generated case: 4 x 4 gravity, Sun and Moon."""
    tables = {
        "orbit": {"epoch": EPOCH, "frame": "GCRF", "position_m": list(POSITION), "velocity_m_s": list(VELOCITY)},
        "forces": {"degree": 4},
        "measurements": {"range_sigma_m": 5.0, "azimuth_sigma_deg": 0.01, "elevation_sigma_deg": 0.01},
    }
    return replace(settings_from(tables, STATIONS), **changes)  # type: ignore[arg-type]


def generated(
    chosen: OrbitSettings,
    hours: float = 10.0,
    seed: int = 1,
    *,
    effects: dict[str, np.ndarray] | None = None,
    noise: bool = True,
) -> Tracking:
    """Measurements of the settings' own orbit wherever a station sees it, with declared noise and given effects."""
    return replace(simulated_tracking(chosen, hours=hours, effects=effects, seed=seed if noise else None), stations={})


@pytest.fixture(scope="module")
def tracking() -> Tracking:
    return generated(settings())


@pytest.fixture(scope="module")
def solution(tracking: Tracking) -> OrbitSolution:
    far = settings(position=(-40.47e6, -10.03e6, 0.2e6), velocity=(762.0, -1473.0, 55.5))
    return solve_tracking(tracking, far)


def test_generated_orbit_is_recovered_within_its_covariance(solution: OrbitSolution) -> None:
    assert solution.status == "ok", solution.why
    error = np.concatenate([solution.position - POSITION, solution.velocity - VELOCITY])
    square = error @ np.linalg.solve(solution.covariance, error)
    assert square < 27.9  # chi-square of 6 degrees of freedom, 1e-4
    assert np.linalg.norm(error[:3]) < 100
    assert 0.75 < solution.estimate.chi_square_per_degree() < 1.25


def test_jacobian_of_the_whole_problem_equals_finite_differences(tracking: Tracking) -> None:
    model = orbit_model(tracking, settings())
    names = [
        "constant-acceleration:orbital",
        "solar-radiation-pressure",
        "impulsive-manoeuvre",
        "range-bias:West",
        "station-position-error:South",
        "timetag-offset:East",
        "range-scale-error",
        "earth-rotation-offset",
        "tropospheric-delay:South",
        "ionospheric-delay:South",
    ]
    problem = orbit_problem(model, names)
    values = dict(problem.start)
    values["impulsive-manoeuvre"] = np.array([15000.0, 0.3, -0.5, 0.2])
    steps = {
        "position": 5.0,
        "velocity": 5e-3,
        "constant-acceleration:orbital": 1e-8,
        "solar-radiation-pressure": 0.5,
        "impulsive-manoeuvre": 1e-2,
        "range-bias:West": 1.0,
        "station-position-error:South": 1.0,
        "timetag-offset:East": 1e-3,
        "range-scale-error": 1e-8,
        "earth-rotation-offset": 1e-6,
        "tropospheric-delay:South": 0.1,
        "ionospheric-delay:South": 0.1,
    }
    for residual in problem.residuals:
        assert isinstance(residual, KernelResidual)
        exact = residual.linearize(values)
        column = 0
        for u in exact.columns:
            for i in range(u.manifold.tangent):
                h = steps[u.name] * (100 if u.name == "impulsive-manoeuvre" and i == 0 else 1)
                moved = []
                for sign in (1, -1):
                    there = {**values, u.name: values[u.name] + sign * h * np.eye(u.manifold.tangent)[i]}
                    moved.append(residual.linearize(there).whitened)
                numeric = (moved[0] - moved[1]) / (2 * h)
                found = exact.jacobian[:, :, column]
                scale = np.abs(found).max() + 1e-12
                # samples within a step of the manoeuvre's time see it on both sides
                far = np.abs(residual.time - 15000.0) > 3.0
                assert np.abs(numeric - found)[far].max() < 3e-3 * scale, (residual.name, u.name, i)
                column += 1


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("constant-acceleration", np.array([4e-6, -3e-6, 5e-6])),
        ("range-bias:West", np.array([120.0])),
        ("timetag-offset:East", np.array([0.05])),
        ("station-position-error:South", np.array([400.0, -300.0, 750.0])),
    ],
)
def test_effects_are_estimated_where_they_are_and_gap_is_said_where_they_are_not(name: str, value: np.ndarray) -> None:
    data = generated(settings(), effects={name: value})
    found = solve_tracking(data, settings(), effects=[name])
    assert found.status == "ok", found.why
    sigma = found.estimate.sigma_of(name)
    assert (np.abs(found.estimate.values[name] - value) < 4.5 * sigma).all()
    plain = solve_tracking(data, replace(settings(), rejection=float("inf")))
    assert plain.status == "model_gap"


def test_every_effect_vanishes_at_zero(tracking: Tracking) -> None:
    model = orbit_model(tracking, settings())
    library = [e.name for e in instances(model.layout)]
    assert len(library) == len(set(library))
    plain, full = orbit_problem(model), orbit_problem(model, [], candidates=library)
    assert full.held == frozenset(library)
    for one, two in zip(plain.residuals, full.residuals, strict=True):
        a, b = one.linearize(plain.start).residual, two.linearize(full.start).residual
        assert np.abs(a - b).max() < 1e-4 * (1 if one.channel == "range" else 1e-6)


def test_initial_orbit_is_found_from_the_data_alone(tracking: Tracking) -> None:
    blind = settings(position=None, velocity=None)
    epoch = tai_from_utc([EPOCH])[0]
    bare = OrbitModel(tracking, blind, epoch, np.full(3, np.nan), np.full(3, np.nan))
    position, _ = initial_state(bare)
    assert np.linalg.norm(position - POSITION) < 400e3
    found = solve_tracking(tracking, blind)
    assert found.status == "ok", found.why
    assert np.linalg.norm(found.position - POSITION) < 100


def test_two_body_orbit_keeps_energy_and_momentum_and_returns() -> None:
    r, v = np.array(POSITION), np.array(VELOCITY)
    mu = 3.986004418e14
    period = 2 * np.pi * np.sqrt((1 / (2 / np.linalg.norm(r) - v @ v / mu)) ** 3 / mu)
    states = kepler(r, v, np.array([-0.3 * period, 0.0, 0.4 * period, period]))
    assert np.cross(states[:, :3], states[:, 3:]) == pytest.approx(np.tile(np.cross(r, v), (4, 1)), rel=1e-9)
    assert states[3, :3] == pytest.approx(r, abs=1e-2) and states[1, :3] == pytest.approx(r, abs=1e-6)


def test_an_outlier_is_left_out_and_said(tracking: Tracking) -> None:
    first = tracking.observations[0]
    value = first.value.copy()
    value[3] += 4000.0
    wrong = replace(tracking, observations=(replace(first, value=value), *tracking.observations[1:]))
    found = solve_tracking(wrong, settings())
    assert found.rejected == {f"{first.name}/{first.kind}": 1}
    assert "left out" in found.why and found.status == "ok"
    assert np.linalg.norm(found.position - POSITION) < 100


# ------------------------------------------------------------------------------------------------ real data


@needs_w3b
def test_w3b_reaches_the_published_numbers() -> None:
    data, chosen = read_files([W3B / "W3B.aer", W3B / "od_test_W3.in"])
    found = solve_tracking(data, chosen)
    assert found.status == "ok", found.why
    assert found.frame == "EME2000"
    assert np.linalg.norm(found.position - [-40541446.236, -9905357.943, 206777.082]) < 10.0
    assert np.linalg.norm(found.velocity - [759.0685, -1476.5156, 54.7931]) < 1e-3
    rows = found.residuals()
    assert rows["all/range"]["count"] == 182 and rows["all/range"]["standard_deviation"] <= 4.4
    assert rows["all/azimuth"]["count"] == 339 and rows["all/azimuth"]["standard_deviation"] <= 0.0101
    assert rows["all/elevation"]["standard_deviation"] <= 0.0117
    leak = found.estimate.values["constant-acceleration:linear"][:3]
    assert np.linalg.norm(leak) == pytest.approx(8.005e-6, rel=0.02)
    published = {
        "CastleRock": 11274.42,
        "Fucino": 13467.84,
        "Kumsan": 13512.49,
        "Pretoria": 13594.18,
        "Uralla": 13450.23,
    }
    for station, bias in published.items():
        assert found.parameters()[f"range-bias:{station}"]["value"] == pytest.approx(bias, abs=2.0)


@needs_w3b
def test_settings_of_the_example_give_the_same_orbit_on_the_command_line(tmp_path: Path) -> None:
    top = typer.Typer()
    top.add_typer(app, name="orbit")
    top.command("other")(lambda: None)
    out = tmp_path / "w3b.oem"
    result = CliRunner().invoke(
        top,
        [
            "orbit",
            "solve",
            str(W3B / "W3B.aer"),
            "--settings",
            str(EXAMPLES / "w3b.toml"),
            str(W3B / "bulletinb-274.txt"),
            "--json",
            "--oem",
            str(out),
        ],
    )
    assert result.exit_code == 0, result.output
    answer = json.loads(result.stdout)
    assert set(answer) >= {
        "status",
        "why",
        "epoch",
        "frame",
        "position_m",
        "velocity_m_s",
        "covariance",
        "parameters",
        "residuals",
        "effects",
        "seconds",
    }
    assert np.linalg.norm(np.array(answer["position_m"]) - [-40541446.236, -9905357.943, 206777.082]) < 10.0
    assert set(answer["residuals"]["Uralla/range"]) >= {"count", "rms", "unit"}
    ephemeris = read_oem(out)
    assert ephemeris.frame == "EME2000"
    assert ephemeris.state[0, :3] == pytest.approx(answer["position_m"], abs=1e-3)


# ------------------------------------------------------------------------------------------------ files


def test_tdm_is_read_as_it_was_written(tmp_path: Path, tracking: Tracking) -> None:
    path = tmp_path / "pass.tdm"
    bistatic = Observations(
        "range_rate", "East", "Africa", tracking.observations[0].time[:5], np.linspace(-40, 40, 5)[:, None]
    )
    both = tracking.merged(Tracking((bistatic,)))
    write_tdm(path, replace(both, satellite="SAT"))
    again = read_tdm(path)
    assert again.satellite == "SAT" and kind_of(path) == "tdm"
    assert {(o.kind, o.name) for o in again.observations} == {(o.kind, o.name) for o in both.observations}
    for o in both.observations:
        same = next(p for p in again.observations if (p.kind, p.name) == (o.kind, o.name))
        assert (np.abs((same.time - o.time) / np.timedelta64(1, "us")) < 1).all()
        assert same.value == pytest.approx(o.value, abs=1e-5 if o.kind == "range" else 1e-9)


def test_tdm_states_its_time_scale(tmp_path: Path, tracking: Tracking) -> None:
    path = tmp_path / "pass.tdm"
    write_tdm(path, tracking)
    text = path.read_text()
    path.write_text(text.replace("TIME_SYSTEM = UTC", "TIME_SYSTEM = GPS"))
    shifted = read_tdm(path).observations[0].time - read_tdm_text(tmp_path, text).observations[0].time
    assert (shifted == np.timedelta64(-18, "s")).all()  # GPS was 18 s ahead of UTC in 2021
    path.write_text(text.replace("TIME_SYSTEM = UTC", "TIME_SYSTEM = MARS"))
    with pytest.raises(RequestError, match="scale of the times"):
        read_tdm(path)
    path.write_text(text.replace("RANGE_UNITS = km", "RANGE_UNITS = RU"))
    with pytest.raises(RequestError, match="unit of range"):
        read_tdm(path)


def read_tdm_text(folder: Path, text: str) -> Tracking:
    """A TDM of this text."""
    path = folder / "text.tdm"
    path.write_text(text)
    return read_tdm(path)


def test_oem_is_read_as_it_was_written_and_refuses_nonsense(tmp_path: Path) -> None:
    time = tai_from_utc(["2021-06-04T00:00:00", "2021-06-04T00:10:00", "2021-06-04T00:20:00"])
    states = kepler(np.array(POSITION), np.array(VELOCITY), np.array([0.0, 600.0, 1200.0]))
    path = tmp_path / "a.oem"
    write_oem(path, Ephemeris("SAT", "2021-001A", "GCRF", time, states))
    again = read_oem(path)
    assert again.frame == "GCRF" and again.identifier == "2021-001A"
    assert again.state[:, :3] == pytest.approx(states[:, :3], abs=1e-5) and (again.time == time).all()
    with pytest.raises(InputError, match="increase"):
        write_oem(path, Ephemeris("SAT", "X", "GCRF", time[::-1], states))
    with pytest.raises(InputError, match="finite"):
        write_oem(path, Ephemeris("SAT", "X", "GCRF", time, states * np.nan))
    path.write_text(path.read_text().replace("CENTER_NAME = EARTH", "CENTER_NAME = MARS"))
    with pytest.raises(RequestError, match="Earth"):
        read_oem(path)


def test_gmd_day_count_and_legs(tmp_path: Path) -> None:
    path = tmp_path / "r.gmd"
    path.write_text("29947.006238 Range 9002 0 99 78717.485944\n29947.089572 Range 9002 0 99 78720.705187\n")
    data, chosen = read_files([path, EXAMPLES / "telstar11n.toml"])
    assert data.observations[0].time[0] == tai_from_utc(["2023-01-03T00:08:58.963200"])[0]
    assert data.observations[0].value[0, 0] == pytest.approx(78717485.944)
    assert chosen.legs == "sum" and len(chosen.stations) == 7
    path.write_text("12.5 Range 9002 0 99 1.0\n129.0 Range 9002 0 99 1.0\n")
    with pytest.raises(FileFormatError, match="no modified Julian date"):
        read_files([path])


# ------------------------------------------------------------------------------------------------ bad input


def with_value(data: Tracking, kind: str, change) -> Tracking:  # type: ignore[no-untyped-def]
    """The data with the values of the first residual of a kind changed."""
    done, result = False, []
    for o in data.observations:
        if o.kind == kind and not done:
            o, done = replace(o, value=change(o.value.copy())), True
        result.append(o)
    return replace(data, observations=tuple(result))


def test_a_range_below_any_orbit_is_refused(tracking: Tracking) -> None:
    with pytest.raises(UnitError, match="shorter than any orbit"):
        orbit_model(with_value(tracking, "range", lambda v: v * 1e-3), settings())


def test_a_single_range_below_the_earths_radius_is_refused(tracking: Tracking) -> None:
    def change(value: np.ndarray) -> np.ndarray:
        value[4] = 5.0e6
        return value

    with pytest.raises(GeometryError, match="below the Earth's radius"):
        orbit_model(with_value(tracking, "range", change), settings())


def test_sums_of_both_legs_taken_for_halves_are_refused(tracking: Tracking) -> None:
    double = replace(
        tracking,
        observations=tuple(replace(o, value=2 * o.value) if o.kind == "range" else o for o in tracking.observations),
    )
    with pytest.raises(UnitError, match="half or the sum"):
        orbit_model(double, settings())


def test_two_measurements_are_too_few(tracking: Tracking) -> None:
    two = replace(
        tracking, observations=(tracking.observations[0].subset(np.arange(len(tracking.observations[0].time)) < 2),)
    )
    with pytest.raises(TooFewDataError, match="six unknowns"):
        orbit_model(two, settings())


def test_one_short_arc_of_ranges_is_said_to_be_unobservable(tracking: Tracking) -> None:
    first = next(o for o in tracking.observations if o.kind == "range")
    short = replace(tracking, observations=(first.subset(np.arange(len(first.time)) < 8),))
    found = solve_tracking(short, settings())
    assert found.status in ("unobservable", "not_converged")
    assert "do not determine" in found.why or "converge" in found.why


@pytest.mark.parametrize("longitude", [-151.6, 13.0])
def test_a_station_on_the_wrong_continent_is_named(tracking: Tracking, longitude: float) -> None:
    wrong = settings()
    stations = {**wrong.stations, "South": replace(wrong.stations["South"], longitude=np.radians(longitude))}
    try:
        found = solve_tracking(tracking, replace(wrong, stations=stations))
    except GeometryError as error:
        assert "South" in str(error) and ("horizon" in str(error) or "do not fit the initial orbit" in str(error))
    else:
        assert found.status != "ok" and "South" in found.why


def test_times_an_hour_off_are_refused_or_said(tracking: Tracking) -> None:
    shifted = replace(
        tracking,
        observations=tuple(replace(o, time=o.time + np.timedelta64(6 * 3600, "s")) for o in tracking.observations),
    )
    try:
        found = solve_tracking(shifted, settings())
    except InputError as error:
        assert "time" in str(error)
    else:
        assert found.status != "ok"


def test_unknown_station_setting_and_file_are_named(tracking: Tracking, tmp_path: Path) -> None:
    with pytest.raises(MissingDataError, match="the settings do not have"):
        orbit_model(tracking, replace(settings(), stations={}))
    with pytest.raises(RequestError, match="did you mean 'degree'"):
        settings_from({"forces": {"degre": 4}}, {})
    with pytest.raises(UnitError, match="metres, not kilometres"):
        settings_from({"orbit": {"epoch": EPOCH, "position_m": [42164.0, 0, 0], "velocity_m_s": [0, 3070.0, 0]}}, {})
    junk = tmp_path / "junk.txt"
    junk.write_text("hello\n")
    with pytest.raises(FileFormatError, match="no tracking file"):
        read_files([junk])
    with pytest.raises(FileFormatError, match="cannot be read"):
        read_files([tmp_path / "absent.aer"])
    with pytest.raises(RequestError, match="no effect"):
        orbit_problem(orbit_model(tracking, settings()), ["warp-drive"])


def test_a_date_without_earth_orientation_is_refused(tracking: Tracking) -> None:
    late = replace(
        tracking,
        observations=tuple(replace(o, time=o.time + np.timedelta64(20 * 365, "D")) for o in tracking.observations),
    )
    with pytest.raises(InputError, match="orientation"):
        orbit_model(late, settings(position=None, velocity=None, epoch=None))
