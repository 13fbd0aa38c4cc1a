"""Tracking data that make no sense, through the command line: exit status, status, and a sentence that names the fault.

Exit status 2 where the input cannot be used, 1 where there is an answer that is not to be trusted, 0 else.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from estimator.losses import Quadratic
from estimator.models.earth_orientation import EARTH_ROTATION_RATE
from estimator.models.errors import InfeasibleError
from estimator.problem import Problem
from estimator.residuals import Kernel, KernelResidual
from estimator.signals import LinearSignal, Values
from estimator.solvers import solve
from estimator.unknowns import Unknown, Vector
from problems.geo_orbit.commands import app
from problems.geo_orbit.plausibility import kepler, shifted_times
from problems.geo_orbit.problem import orbit_model
from problems.geo_orbit.tracking import Tracking
from problems.readers.tracking_ccsds import write_tdm
from tests.test_orbit_determination import EPOCH, POSITION, STATIONS, VELOCITY, W3B, generated, needs_w3b, settings


def answered(*arguments: Path | str) -> tuple[int, dict[str, Any]]:
    """Exit status and JSON answer of ``boresight orbit solve``."""
    top = typer.Typer()
    top.add_typer(app, name="orbit")
    top.command("other")(lambda: None)
    result = CliRunner().invoke(top, ["orbit", "solve", *map(str, arguments), "--json"])
    return result.exit_code, json.loads(result.stdout)


@dataclass(frozen=True)
class Case:
    """Files of a generated transfer orbit, to be spoilt."""

    folder: Path
    tracking: Tracking

    def solved(
        self,
        tracking: Tracking | None = None,
        *,
        given: bool = True,
        edit: tuple[str, str] | None = None,
        legs: str = "half",
        station: str = "",
    ) -> tuple[int, dict[str, Any]]:
        """Write the files and solve.

        Args:
            tracking: other data.
            given: whether the settings have the initial orbit.
            edit: a substitution that spoils the TDM.
            legs: what the settings say of ranges, which are halves.
            station: name, coordinate and its wrong value.
        """
        data = self.folder / "pass.tdm"
        write_tdm(data, tracking or self.tracking)
        if edit:
            text = data.read_text()
            spoilt = re.sub(edit[0], edit[1], text, count=1)
            assert spoilt != text
            data.write_text(spoilt)
        lines = ["[forces]", "degree = 4", "[measurements]"]
        lines += ["range_sigma_m = 5.0", "azimuth_sigma_deg = 0.01", "elevation_sigma_deg = 0.01"]
        lines.append(f'range = "{legs}"')
        if given:
            lines += ["[orbit]", f'epoch = "{EPOCH}"', 'frame = "GCRF"']
            lines += [f"position_m = {list(POSITION)}", f"velocity_m_s = {list(VELOCITY)}"]
        moved = station.split()
        for name, s in STATIONS.items():
            place = {
                "latitude_deg": np.degrees(s.latitude),
                "longitude_deg": np.degrees(s.longitude),
                "altitude_m": s.altitude,
            }
            if moved and moved[0] == name:
                place[moved[1]] = float(moved[2])
            lines += ["[[stations]]", f'name = "{name}"', *(f"{k} = {v:.9f}" for k, v in place.items())]
        chosen = self.folder / "settings.toml"
        chosen.write_text("\n".join(lines) + "\n")
        return answered(data, "--settings", chosen)


@pytest.fixture(scope="module")
def tracking() -> Tracking:
    return generated(settings(), hours=8.0)


@pytest.fixture
def case(tmp_path: Path, tracking: Tracking) -> Case:
    return Case(tmp_path, tracking)


def shifted(tracking: Tracking, seconds: float) -> Tracking:
    """The data with all time tags later."""
    step = np.timedelta64(round(seconds * 1e6), "us")
    return replace(tracking, observations=tuple(replace(o, time=o.time + step) for o in tracking.observations))


def test_sound_files_are_answered(case: Case) -> None:
    code, answer = case.solved()
    assert (code, answer["status"]) == (0, "ok")


@pytest.mark.parametrize(
    ("kilometres", "words"),
    [("5000.0", "below the Earth's radius"), ("12.0", "shorter than any orbit"), ("4.2e7", "beyond the Moon")],
)
def test_one_impossible_range_is_refused_with_its_place(case: Case, kilometres: str, words: str) -> None:
    first = next(o for o in case.tracking.observations if o.kind == "range")
    value = first.value.copy()
    value[4] = 1e3 * float(kilometres)
    others = tuple(replace(o, value=value) if o is first else o for o in case.tracking.observations)
    code, answer = case.solved(replace(case.tracking, observations=others))
    assert (code, answer["status"]) == (2, "bad_input")
    assert words in answer["why"] and first.receiver in answer["why"]


@pytest.mark.parametrize("place", ["South longitude_deg -28.4", "East latitude_deg -36.1", "West longitude_deg 104.8"])
def test_a_station_on_the_wrong_continent_is_refused_by_name(case: Case, place: str) -> None:
    code, answer = case.solved(station=place)
    assert (code, answer["status"]) == (2, "bad_input")
    assert place.split()[0] in answer["why"] and "longitude" in answer["why"]


def test_a_station_on_the_wrong_continent_is_named_without_an_initial_orbit(case: Case) -> None:
    code, answer = case.solved(given=False, station="South longitude_deg -28.4")
    assert code in (1, 2) and answer["status"] in ("model_gap", "not_converged", "bad_input")
    assert "South" in answer["why"]


def test_a_lone_impossible_range_is_left_out_and_said(case: Case) -> None:
    code, answer = case.solved(edit=(r"(RANGE = \S+ )\S+", r"\g<1>5000.0"))
    first = next(o for o in case.tracking.observations if o.kind == "range")
    if code == 0:  # hours from its neighbours a satellite may have come near
        assert answer["rejected"] == {f"{first.receiver}/range": 1} and "left out" in answer["why"]
    else:
        assert code == 2 and "below the Earth's radius" in answer["why"]


def test_a_station_nowhere_on_the_earth_is_refused(case: Case) -> None:
    code, answer = case.solved(station="South altitude_m 116000.0")
    assert (code, answer["status"]) == (2, "bad_input")
    assert "altitude" in answer["why"] and "South" in answer["why"]


def test_times_in_an_unknown_scale_are_refused(case: Case) -> None:
    code, answer = case.solved(edit=("TIME_SYSTEM = UTC", "TIME_SYSTEM = MARS"))
    assert (code, answer["status"]) == (2, "bad_input") and "MARS" in answer["why"]


@pytest.mark.parametrize("hours", [-1.0, 2.0])
def test_local_time_for_utc_is_said_with_its_size(case: Case, hours: float) -> None:
    code, answer = case.solved(shifted(case.tracking, 3600 * hours))
    assert code == 1 and answer["status"] == "model_gap"
    found = re.search(r"all times (\d+) s (earlier|later)", answer["why"])
    assert found is not None, answer["why"]
    assert float(found[1]) == pytest.approx(3600 * abs(hours), rel=0.02)
    assert found[2] == ("earlier" if hours > 0 else "later")


def test_times_half_a_day_off_are_refused(case: Case) -> None:
    code, answer = case.solved(shifted(case.tracking, 12 * 3600.0))
    assert (code, answer["status"]) == (2, "bad_input") and "scale of the times" in answer["why"]


@pytest.mark.parametrize("seconds", [18.0, 37.0, -69.0])
def test_a_shift_of_a_time_scale_is_seen_as_far_as_the_initial_orbit_is_good(
    tracking: Tracking, seconds: float
) -> None:
    model = orbit_model(tracking, settings())
    state = kepler(model.position, model.velocity, np.array([-seconds]))[0]
    c, s = np.cos(EARTH_ROTATION_RATE * seconds), np.sin(EARTH_ROTATION_RATE * seconds)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    position, velocity = turn @ state[:3], turn @ state[3:]
    said = shifted_times(model, position + np.array([0.0, 0.0, 300.0]), velocity)
    assert re.search(rf"all times {abs(seconds):.0f} s {'earlier' if seconds > 0 else 'later'}", said)
    # an initial orbit that is wrong by more than the shift tells nothing
    assert shifted_times(model, position + np.array([0.0, 0.0, 200e3]), velocity) == ""
    assert shifted_times(model, model.position + 50.0, model.velocity) == ""


def test_two_measurements_are_too_few(case: Case) -> None:
    first = case.tracking.observations[0]
    two = replace(case.tracking, observations=(first.subset(np.arange(len(first.time)) < 2),))
    code, answer = case.solved(two)
    assert (code, answer["status"]) == (2, "bad_input") and "six unknowns" in answer["why"]


def test_a_short_pass_of_one_station_is_answered_as_unobservable(case: Case) -> None:
    first = next(o for o in case.tracking.observations if o.kind == "range")
    short = replace(case.tracking, observations=(first.subset(np.arange(len(first.time)) < 8),))
    code, answer = case.solved(short)
    assert (code, answer["status"]) == (1, "unobservable") and "do not determine" in answer["why"]
    assert answer["unobservable"]


def test_halves_of_ranges_taken_for_sums_are_refused(case: Case) -> None:
    code, answer = case.solved(legs="sum")
    assert (code, answer["status"]) == (2, "bad_input") and "half or the sum" in answer["why"]


@needs_w3b
@pytest.mark.parametrize(
    ("pattern", "replacement", "words"),
    [
        (r"(RANGE +Uralla +)\S+", r"\g<1>5000.0", "below the Earth's radius"),
        (r"(RANGE +Uralla +)\S+", r"\g<1>nan", "not finite"),
    ],
)
def test_spoilt_w3b_is_refused(tmp_path: Path, pattern: str, replacement: str, words: str) -> None:
    data = tmp_path / "W3B.aer"
    data.write_text(re.sub(pattern, replacement, (W3B / "W3B.aer").read_text(), count=1))
    code, answer = answered(data, W3B / "od_test_W3.in")
    assert (code, answer["status"]) == (2, "bad_input")
    assert words in answer["why"] and "Uralla, line" in answer["why"]


@needs_w3b
def test_w3b_station_mirrored_at_greenwich_is_named(tmp_path: Path) -> None:
    settings_file = tmp_path / "od.in"
    text = (W3B / "od_test_W3.in").read_text()
    settings_file.write_text(text.replace("=   13.6004229863", "=  -13.6004229863"))
    assert settings_file.read_text() != text
    code, answer = answered(W3B / "W3B.aer", settings_file)
    assert (code, answer["status"]) == (2, "bad_input") and "Fucino" in answer["why"]


class Cliff(LinearSignal):
    """The unknown itself, which cannot be evaluated above one: an orbit that meets the Earth."""

    def evaluate(self, values: Values) -> tuple[np.ndarray, np.ndarray]:
        if values["x"][0] > 1.0:
            raise InfeasibleError("above one")
        return super().evaluate(values)


def test_a_step_to_where_nothing_can_be_computed_is_taken_back() -> None:
    import casadi as ca

    x = Unknown("x", Vector(1), "1", 100.0)
    kernel = Kernel("cliff", [], [("s", Vector(1))], [], [], lambda seen: -ca.atan(seen["s"]))
    signal = Cliff("s", x, np.zeros((1, 1)), np.ones((1, 1, 1)))
    residual = KernelResidual(
        "r",
        "r",
        "1",
        kernel,
        (signal,),
        {},
        np.ones((1, 1)),
        np.zeros(1),
        np.zeros(1, dtype=int),
        ("a",),
        loss=Quadratic(),
    )
    # the first Gauss-Newton step leads from -1.5 to 1.69
    estimate = solve(Problem((x,), (residual,), {"x": np.array([-1.5])}))
    assert estimate.values["x"][0] == pytest.approx(0.0, abs=1e-6)
    with pytest.raises(InfeasibleError):
        solve(Problem((x,), (residual,), {"x": np.array([1.5])}))
