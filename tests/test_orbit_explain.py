"""The discrepancy workflow on orbits: effects that the tracking hides are named, sized and proved."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.orbit_explain_study import ORBITS, Case, settings_of
from estimator.models.errors import MissingDataError, RequestError
from problems.geo_orbit.commands import app
from problems.geo_orbit.explanation import OrbitExplanation, explained
from problems.geo_orbit.settings import OrbitSettings, settings_from
from problems.geo_orbit.simulator import simulated_tracking
from problems.readers.tracking_files import read_files

W3B = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "geo-w3b"
needs_w3b = pytest.mark.skipif(not W3B.exists(), reason="the W3B tracking data are not beside the repository")

HIDDEN = [
    ("transfer", "constant-acceleration", (4e-7, -3e-7, 5e-7)),
    ("transfer", "range-scale-error", (8e-6,)),
    ("medium", "angle-bias", (3e-4, -2e-4)),
    ("medium", "range-bias:{}", (60.0,)),
    ("low", "geopotential-degree:9-20", (1.0,)),
    ("low", "timetag-offset:{}", (0.02,)),
]


def tracking_of(orbit: str, effects: dict[str, tuple[float, ...]] | None = None, seed: int = 4,
                ) -> tuple[OrbitSettings, OrbitExplanation, str]:
    """Settings, what the workflow says of their tracking, and the name of the effect ("{}" is a station in view)."""
    chosen = settings_of(Case("one", orbit, 2))
    hours, step = ORBITS[orbit][3:]
    plain = simulated_tracking(chosen, hours=hours, step=step, seed=None)
    station = max((o for o in plain.observations if o.kind == "range"), key=lambda o: len(o.time)).receiver
    told = {name.format(station): value for name, value in (effects or {}).items()}
    tracking = simulated_tracking(chosen, hours=hours, step=step, effects=told, seed=seed)
    answer = explained(tracking, chosen)
    assert isinstance(answer, OrbitExplanation)
    return chosen, answer, next(iter(told), "")


@pytest.mark.parametrize(("orbit", "name", "value"), HIDDEN)
def test_a_hidden_effect_is_named_and_sized(orbit: str, name: str, value: tuple[float, ...]) -> None:
    _, answer, name = tracking_of(orbit, {name: value})
    found = answer.findings
    assert found.verdict in ("named", "ambiguous"), found.why
    assert len(found.findings) == 1 and name in found.findings[0].group, found.why
    if found.findings[0].name == name:
        off = np.abs(found.final.values[name] - np.array(value)) / found.final.sigma_of(name)
        assert np.all(off < 4.0), off
    told = answer.as_dict()["effects"][0]
    assert told["held_out_after"] < min(told["held_out_before"], 1.15)


@pytest.mark.parametrize("orbit", list(ORBITS))
def test_nothing_is_named_where_nothing_is_hidden(orbit: str) -> None:
    _, answer, _ = tracking_of(orbit)
    assert answer.findings.verdict == "quiet", answer.findings.why
    assert not answer.findings.findings


def test_an_effect_outside_the_library_gets_no_single_name() -> None:
    chosen = settings_of(Case("one", "medium", 2))
    hours, step = ORBITS["medium"][3:]
    tracking = simulated_tracking(chosen, hours=hours, step=step, effects={"angle-bias": (2e-3, -1e-3)}, seed=4)
    answer = explained(tracking, chosen, without=["angle-bias"])
    assert answer.as_dict()["verdict"] in ("unknown", "ambiguous")
    assert "angle-bias" not in {e["name"].split(":")[0] for e in answer.as_dict()["effects"]}


def test_a_simulation_repeats_and_its_noise_is_as_declared() -> None:
    chosen = settings_of(Case("one", "medium", 2))
    first, again, bare = (simulated_tracking(chosen, seed=s) for s in (1, 1, None))
    for a, b, c in zip(first.observations, again.observations, bare.observations, strict=True):
        assert np.array_equal(a.value, b.value) and np.array_equal(a.time, c.time)
    ranges = np.concatenate([a.value - c.value for a, c in zip(first.observations, bare.observations, strict=True)
                             if a.kind == "range"])
    # 5 m, as in the settings; the band holds 99.9 % of such samples.
    assert np.std(ranges) == pytest.approx(5.0, rel=3.3 / np.sqrt(2 * len(ranges)))


@pytest.mark.parametrize(("changes", "error", "what"), [
    ({"effects": {"range-bias": (1.0, 2.0)}}, RequestError, "another number of parameters"),
    ({"effects": {"no-such-effect": (1.0,)}}, RequestError, "no-such-effect"),
    ({"kinds": ("phase",)}, RequestError, "no such kind"),
    ({"hours": 0.01}, RequestError, "no time to measure"),
    ({"minimum_elevation": 1.6}, MissingDataError, "no station sees"),
])
def test_what_cannot_be_simulated_is_refused(changes: dict, error: type[Exception], what: str) -> None:
    with pytest.raises(error, match=what):
        simulated_tracking(settings_of(Case("one", "medium", 2)), **changes)


def test_a_simulation_without_orbit_or_stations_is_refused() -> None:
    with pytest.raises(MissingDataError, match="epoch"):
        simulated_tracking(settings_from({}, {}))
    with pytest.raises(MissingDataError, match="station"):
        simulated_tracking(settings_from({"orbit": {"epoch": "2023-03-10T00:00:00"}}, {}))


SETTINGS = """
[orbit]
epoch = "2021-06-04T00:00:00"
frame = "GCRF"
position_m = [-40.5e6, -10.0e6, 0.17e6]
velocity_m_s = [760.0, -1475.0, 55.0]

[forces]
degree = 4

[measurements]
range_sigma_m = 5.0

[[stations]]
name = "East"
latitude_deg = 36.1
longitude_deg = 127.5
altitude_m = 180.0

[[stations]]
name = "South"
latitude_deg = -30.6
longitude_deg = 151.6
altitude_m = 1160.0
"""


def test_simulate_then_explain_on_the_command_line(tmp_path: Path) -> None:
    """What the command hides, with ranges as a TDM means them, the other command finds."""
    settings, data = tmp_path / "orbit.toml", tmp_path / "pass.tdm"
    settings.write_text(SETTINGS)
    runner = CliRunner()
    made = runner.invoke(app, ["simulate", str(settings), str(data), "--hours", "10", "--effect",
                               "timetag-offset:East=0.05", "--json"])
    assert made.exit_code == 0, made.output
    assert json.loads(made.stdout)["observations"]["East/range"] > 40
    asked = runner.invoke(app, ["explain", str(data), str(settings), "--json"])
    answer = json.loads(asked.stdout)
    assert [e["group"] for e in answer["effects"] if "timetag-offset:East" in e["group"]], answer["why"]


@needs_w3b
def test_real_tracking_is_explained_and_without_the_acceleration_its_name_is_found() -> None:
    """Eutelsat W3B: quiet with the published model; the small acceleration taken out is found again."""
    tracking, settings = read_files([W3B / "W3B.aer", *sorted(W3B.glob("bulletinb-*.txt"))],
                                    Path(__file__).resolve().parents[1] / "examples" / "w3b.toml")
    assert explained(tracking, settings).findings.verdict == "quiet"
    found = explained(tracking, replace(settings, acceleration=None)).findings
    assert found.verdict == "ambiguous"
    assert [f.group for f in found.findings] == [("constant-acceleration", "constant-acceleration:orbital")]
