"""What a disagreement goes with: the level of false names under noise and under unrelated structure, and the power."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import binom

from estimator.discrepancy.dependence import LEVEL, Covariate, Dependence, dependences
from estimator.discrepancy.gap import find_gap
from estimator.discrepancy.score import stack
from estimator.discrepancy.subject import SubjectWithCovariates
from estimator.problem import Problem
from estimator.residuals import Kernel, KernelResidual
from estimator.solvers import solve
from estimator.unknowns import Unknown, Vector
from problems.alignment.covariates import campaign_covariates
from problems.alignment.investigation import AlignmentSubject
from problems.alignment.simulator import preset, simulate

ARCS, SAMPLES, SIGMA = 12, 60, 0.3  # arcs, samples of each, Hz
LINE = Unknown("line", Vector(2, ("level", "slope")), "Hz", 10.0)
TIME = np.concatenate([1800.0 * k + np.linspace(0.0, 60.0, SAMPLES) for k in range(ARCS)])  # s
LABEL = np.repeat(np.arange(ARCS), SAMPLES)
INSIDE = (TIME - 1800.0 * LABEL) / 60.0  # place in the arc, 0 to 1
PERIOD = 5900.0  # s


def _build(x: dict[str, ca.SX]) -> ca.SX:
    line = x["line"][0] + x["line"][1] * x["time"] / 1e4
    return x["measured"] - ca.vertcat(line, line)


KERNEL = Kernel("two_beams_one_line", [LINE], (), (("time", 1), ("measured", 2)), (), _build)


def problem_of(measured: np.ndarray) -> Problem:
    """Two beams that share a line, the last fifth of every arc held out."""
    residual = KernelResidual("doppler", "doppler", "Hz", KERNEL, (), {"time": TIME[:, None], "measured": measured},
                              np.full(measured.shape, SIGMA), TIME, LABEL, tuple(f"pass-{k}" for k in range(ARCS)),
                              accepted=INSIDE <= 0.8)
    return Problem((LINE,), (residual,), {"line": np.zeros(2)}, frozenset())


def temperature(time: np.ndarray) -> np.ndarray:
    return 291.0 + 14.0 * np.cos(2 * np.pi * time / PERIOD - 0.7)  # K


def covariates(channel: str, time: np.ndarray) -> Mapping[str, Covariate]:
    assert channel == "doppler" and (np.diff(time) >= 0).all()
    arc = np.floor(time / 1800.0)
    rate = 0.01 * np.sin(2 * np.pi * (time - 1800.0 * arc) / 90.0 + 1.7 * arc)  # rad/s
    look = 0.6 + 0.1 * np.sin(2.3 * arc)[:, None] + np.array([0.0, 0.2]) + 0.05 * np.cos(time / 25.0)[:, None]
    return {
        "time": Covariate(time, "s"),
        "orbit_phase": Covariate((2 * np.pi * time / 6000.0 + np.pi) % (2 * np.pi) - np.pi, "rad", angle=True),
        "antenna_temperature": Covariate(temperature(time), "K"),
        "body_rate": Covariate(rate, "rad/s"),
        "off_nadir_angle": Covariate(look, "rad"),
        "never_known": Covariate(np.full(len(time), np.nan), "1"),
        "always_the_same": Covariate(np.full(len(time), 3.0), "1"),
    }


def told(measured: np.ndarray, given: object = covariates) -> tuple[Dependence, ...]:
    estimate = solve(problem_of(measured))
    values = dict(estimate.values)
    prepared = estimate.problem.prepared(values)
    parts = prepared.linearize(values)
    return dependences(prepared, parts, stack(prepared, parts), "doppler", given)  # type: ignore[arg-type]


def noise(draw: np.random.Generator) -> np.ndarray:
    return 2.0 + SIGMA * draw.standard_normal((len(TIME), 2))


def structure(draw: np.random.Generator, kind: str) -> np.ndarray:
    """Structure (n,), Hz, with no relation to any covariate."""
    if kind == "offsets":  # one constant per arc
        return 1.5 * draw.standard_normal(ARCS)[LABEL]
    if kind == "drifts":  # a parabola per arc
        a, b, c = 1.5 * draw.standard_normal((3, ARCS))
        return a[LABEL] + b[LABEL] * (2 * INSIDE - 1) + c[LABEL] * (2 * INSIDE - 1) ** 2
    if kind == "wander":  # a random walk that starts anew in each arc
        return np.concatenate([np.cumsum(0.2 * draw.standard_normal(SAMPLES)) for _ in range(ARCS)])
    if kind == "comb":  # 17 s, its phase free in each arc
        return 1.5 * np.sin(2 * np.pi * TIME / 17.0 + draw.uniform(0, 2 * np.pi, ARCS)[LABEL])
    return np.zeros(len(TIME))


@pytest.mark.parametrize(("kind", "trials"), [("none", 80), ("offsets", 80), ("drifts", 80), ("wander", 80),
                                              ("comb", 80)])
def test_covariates_are_not_named_without_a_relation(kind: str, trials: int) -> None:
    """At most the stated level, by 80 campaigns of each kind (binomial bound at 99.9 %)."""
    draw = np.random.default_rng([7, len(kind)])
    alarms = 0
    for _ in range(trials):
        measured = noise(draw)
        measured[:, 1] += structure(draw, kind)
        alarms += bool(told(measured))
    assert alarms <= binom.ppf(0.999, trials, LEVEL)


def test_a_planted_relation_is_named_with_its_size() -> None:
    """A shift of one beam that grows with a temperature: 0.28 Hz RMS under 0.3 Hz of noise, 30 campaigns."""
    draw = np.random.default_rng(12)
    named = told_first = within = 0
    for _ in range(30):
        measured = noise(draw)
        measured[:, 1] += 0.03 * (temperature(TIME) - 280.0)
        found = told(measured)
        named += any("antenna_temperature" in (d.covariate, *d.alike) for d in found)
        if found and found[0].covariate == "antenna_temperature" and found[0].form == "linear":
            told_first += 1
            assert found[0].components == (1,) and found[0].covariate_unit == "K" and found[0].unit == "Hz"
            assert found[0].share > 0.9 and found[0].p_value < LEVEL
            assert found[0].slope is not None and "grows with antenna_temperature" in found[0].sentence
            within += abs(found[0].slope - 0.03) < 0.004  # four sigma: 0.3 / sqrt(576) / 9.9 K, and the shared line
    assert named >= 29 and told_first >= 24 and within == told_first


def test_a_relation_inside_the_arcs_is_named_and_plain_time_is_not() -> None:
    """A rate that takes another course in every arc, against a drift that is the same in every arc; 12 campaigns."""
    draw = np.random.default_rng(14)
    rate = 0.01 * np.sin(2 * np.pi * (TIME - 1800.0 * LABEL) / 90.0 + 1.7 * LABEL)
    for _ in range(12):
        measured = noise(draw)
        measured[:, 0] += 60.0 * rate
        found = told(measured)
        assert found and found[0].covariate == "body_rate" and found[0].components == (0,)
        assert found[0].slope == pytest.approx(60.0, abs=12.0)
        measured = noise(draw)
        measured[:, 0] += 1.5 * (2 * INSIDE - 1) + 2.0 * INSIDE**2
        assert told(measured) == ()


def test_both_beams_together_and_a_second_covariate_beside_the_first() -> None:
    draw = np.random.default_rng(15)
    measured = noise(draw)
    measured += np.array([0.05, 0.08]) * (temperature(TIME) - 280.0)[:, None]
    found = told(measured)
    assert found[0].covariate == "antenna_temperature" and found[0].components == (0, 1)
    rate = 0.01 * np.sin(2 * np.pi * (TIME - 1800.0 * LABEL) / 90.0 + 1.7 * LABEL)
    measured = noise(draw)
    measured[:, 1] += 0.1 * (temperature(TIME) - 280.0) + 80.0 * rate

    def without_phase(channel: str, time: np.ndarray) -> Mapping[str, Covariate]:
        # Over 12 arcs a phase of 6000 s copies a temperature of 5900 s well enough to be taken for it.
        return {n: c for n, c in covariates(channel, time).items() if n != "orbit_phase"}

    both = {d.covariate for d in told(measured, without_phase)}
    assert both == {"antenna_temperature", "body_rate"}


def test_samples_without_the_covariate_are_left_out() -> None:
    """Telemetry that ends before the last two arcs: the relation is found in the others, nothing is extrapolated."""

    def partly(channel: str, time: np.ndarray) -> Mapping[str, Covariate]:
        return {"antenna_temperature": Covariate(np.where(time < 10 * 1800.0, temperature(time), np.nan), "K")}

    draw = np.random.default_rng(16)
    measured = noise(draw)
    measured[:, 1] += 0.1 * (temperature(TIME) - 280.0) * (TIME < 10 * 1800.0)
    found = told(measured, partly)
    assert [d.covariate for d in found] == ["antenna_temperature"]
    assert found[0].slope == pytest.approx(0.1, abs=0.01)
    assert told(measured, lambda channel, time: {}) == ()


def test_a_relation_in_a_whole_campaign_names_the_telemetry_and_the_beam() -> None:
    """The fit takes a part of it up in the mounting, and the tracker's noise ties the beams together."""
    campaign, _ = simulate(preset("compact", housekeeping=True, doppler_sessions=12), 5)
    doppler, series = campaign.doppler, campaign.housekeeping["antenna_temperature"]
    assert doppler is not None
    shift = doppler.frequency_shift.copy()
    shift[:, 1] += 0.6 * (np.interp(doppler.time, series.time, series.values) - 291.0)  # Hz, 0.6 Hz/K
    subject = AlignmentSubject(replace(campaign, doppler=replace(doppler, frequency_shift=shift)))
    assert isinstance(subject, SubjectWithCovariates)
    estimate = solve(subject.problem((), (), hold_out=True))
    values = dict(estimate.values)
    prepared = estimate.problem.prepared(values)
    parts = prepared.linearize(values)
    rows = stack(prepared, parts)
    assert find_gap(prepared, rows, parts).places[0].channel == "doppler"
    found = dependences(prepared, parts, rows, "doppler", subject.covariates)
    assert len(found) == 1
    assert found[0].covariate == "antenna_temperature" and found[0].components == (1,)
    assert found[0].slope == pytest.approx(0.6, abs=0.06)
    assert found[0].share > 0.9


def test_covariates_of_a_campaign_are_what_they_say() -> None:
    campaign, truth = simulate(preset("compact", housekeeping=True), 6)
    subject = AlignmentSubject(campaign)
    doppler = campaign.doppler
    assert doppler is not None
    time = doppler.time
    given = subject.covariates("doppler", time)
    assert {"time", "orbit_phase", "sunlit", "body_rate_x", "body_rate_y", "body_rate_z", "body_rate",
            "off_nadir_angle", "look_azimuth", "doppler_shift", "antenna_temperature", "heater_current"} == set(given)
    quaternion, rate = truth.attitude(time)
    position, _ = truth.inertial_state(time)
    inertial = (Rotation.from_quat(truth.antenna_from_tracker, scalar_first=True)
                * Rotation.from_quat(quaternion, scalar_first=True)).inv()
    for beam in range(doppler.frequency_shift.shape[1]):
        looking = inertial.apply(doppler.beam_direction[beam])
        down = -position / np.linalg.norm(position, axis=1, keepdims=True)
        angle = np.arccos(np.sum(looking * down, axis=1))
        np.testing.assert_allclose(given["off_nadir_angle"].values[:, beam], angle, atol=3e-4)
    smooth = np.column_stack([given[f"body_rate_{axis}"].values for axis in "xyz"])
    assert np.sqrt(np.mean((smooth - rate) ** 2)) < 0.05 * np.sqrt(np.mean(rate**2))
    phase = np.unwrap(given["orbit_phase"].values)
    period = 2 * np.pi * np.sqrt(7071.0e3**3 / 3.986004418e14)  # s
    assert (phase[-1] - phase[0]) / (time[-1] - time[0]) == pytest.approx(2 * np.pi / period, rel=0.01)
    series = campaign.housekeeping["antenna_temperature"]
    outside = np.array([series.time[0] - 5.0, series.time[0] + 15.0])
    told_there = campaign_covariates(subject.everything, "gnss", outside)["antenna_temperature"].values
    assert np.isnan(told_there[0]) and told_there[1] == pytest.approx(series.values[:2].mean())
    assert "body_rate" not in subject.covariates("gnss", campaign.gnss.time)
