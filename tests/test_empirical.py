"""The empirical term: the right form, its size with an honest sigma, and the proof on samples that no fit used."""

from __future__ import annotations

import json
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from estimator.discrepancy.empirical import EmpiricalTerm, empirical_terms
from estimator.discrepancy.gap import Gap, Place, find_gap
from estimator.discrepancy.score import stack
from estimator.problem import Problem
from estimator.residuals import Kernel, KernelResidual
from estimator.solvers import solve
from estimator.unknowns import Unknown, Vector
from problems.alignment.explain_answer import answer_of, text_of
from problems.alignment.explain_report import page_of
from problems.alignment.explanation import explained
from problems.alignment.simulator import preset, simulate
from problems.console import jsonable

# Effects that would take a part of it up.
OTHERS = ("beam-mispointing", "carrier-frequency-offset", "tracker-frame-jump", "doppler-timetag-offset",
          "doppler-bias", "second-order-doppler", "flexible-appendage", "propellant-slosh", "stellar-aberration")

ARCS, SAMPLES, SIGMA = 8, 200, 0.3  # arcs, samples of each, Hz
LINE = Unknown("line", Vector(2, ("level", "slope")), "Hz", 10.0)
TIME = np.concatenate([1800.0 * k + np.linspace(0.0, 100.0, SAMPLES) for k in range(ARCS)])  # s
LABEL = np.repeat(np.arange(ARCS), SAMPLES)
INSIDE = (TIME - 1800.0 * LABEL) / 100.0  # place in the arc, 0 to 1
FITTED = INSIDE <= 0.8
EVERY = tuple(f"pass-{k}" for k in range(ARCS))


def _build(x: dict[str, ca.SX]) -> ca.SX:
    line = x["line"][0] + x["line"][1] * x["time"] / 1e4
    return x["measured"] - ca.vertcat(line, line)


KERNEL = Kernel("two_beams_one_line_long", [LINE], (), (("time", 1), ("measured", 2)), (), _build)


def carried(measured: np.ndarray, gap: Gap | None = None, *, held_out: bool = True) -> tuple[EmpiricalTerm, ...]:
    """The terms of two beams that share a line; without a given gap those of the places that the gap test finds."""
    residual = KernelResidual("doppler", "doppler", "Hz", KERNEL, (), {"time": TIME[:, None], "measured": measured},
                              np.full(measured.shape, SIGMA), TIME, LABEL, EVERY,
                              accepted=FITTED if held_out else None)
    estimate = solve(Problem((LINE,), (residual,), {"line": np.zeros(2)}, frozenset()))
    values = dict(estimate.values)
    prepared = estimate.problem.prepared(values)
    parts = prepared.linearize(values)
    rows = stack(prepared, parts)
    return empirical_terms(prepared, parts, rows, find_gap(prepared, rows, parts) if gap is None else gap)


def noise(draw: np.random.Generator) -> np.ndarray:
    return 2.0 + SIGMA * draw.standard_normal((len(TIME), 2))


def place(*components: int, arcs: tuple[str, ...] = EVERY) -> Gap:
    return Gap((Place("doppler", arcs, components, 1.0, "Hz", 1.0, SIGMA, 1e-9, "doppler"),), (), 1e-9)


def test_a_period_is_carried_and_borne_out_by_held_out_samples() -> None:
    draw = np.random.default_rng(1)
    measured = noise(draw)
    measured[:, 1] += 0.8 * np.sin(2 * np.pi * TIME / 17.0 + 0.4)
    (term,) = carried(measured)
    assert (term.channel, term.component, term.form, term.unit) == ("doppler", 1, "periodic", "Hz")
    assert term.period == pytest.approx(17.0, abs=0.005)
    assert abs(term.amplitude - 0.8) < 4 * term.sigma
    assert term.sigma == pytest.approx(SIGMA * np.sqrt(2 / FITTED.sum()), rel=0.1)
    assert term.rms == pytest.approx(0.8 / np.sqrt(2), rel=0.1)
    whole = np.sqrt(SIGMA**2 + 0.32)  # noise and 0.8 Hz of amplitude
    assert term.fitted_before == pytest.approx(whole, rel=0.06) and term.held_out_before is not None
    assert term.fitted_after == pytest.approx(SIGMA, rel=0.06)
    assert term.held_out_before == pytest.approx(whole, rel=0.12)
    assert term.held_out_after == pytest.approx(SIGMA, rel=0.12)
    assert "EMPIRICAL: not a name" in term.sentence and "17 s" in term.sentence and "beam 1" in term.sentence


def test_sigma_of_the_amplitude_is_its_scatter() -> None:
    """40 campaigns: the pull of the amplitude has variance 1 (standard error 0.22) and mean 0 (0.16)."""
    draw = np.random.default_rng(2)
    pulls = []
    for _ in range(40):
        measured = noise(draw)
        measured[:, 0] += 0.5 * np.cos(2 * np.pi * TIME / 20.0)
        (term,) = carried(measured, place(0))
        assert term.form == "periodic" and len(term.parameters) == 2
        pulls.append((term.amplitude - 0.5) / term.sigma)
    assert abs(np.mean(pulls)) < 0.6
    assert 0.4 < np.var(pulls) < 1.9


def test_constants_of_arcs_are_told_from_curves() -> None:
    draw = np.random.default_rng(3)
    levels = np.array([0.9, -0.7, 0.4, -1.1, 0.8, 0.1, -0.9, 0.5])
    measured = noise(draw)
    measured[:, 0] += levels[LABEL]
    (term,) = carried(measured, place(0))
    assert term.form == "constant" and term.period is None and len(term.parameters) == ARCS
    told = np.array([p.value for p in term.parameters])
    # The shared line takes a line of the levels up; what differs from a line is what can be told.
    line = np.polyfit(np.arange(ARCS), told - levels, 1)
    np.testing.assert_allclose(told - levels, np.polyval(line, np.arange(ARCS)), atol=5 * SIGMA / np.sqrt(160))
    assert term.held_out_after is not None and term.held_out_before is not None
    assert term.held_out_after < 0.7 * term.held_out_before
    bend = 2 * INSIDE / 0.8 - 1
    measured = noise(draw)
    measured[:, 0] += levels[LABEL] * bend**2 * 3
    (curve,) = carried(measured, place(0))
    assert curve.form == "smooth"
    # It says nothing of the end of the arc, and says that it does not.
    assert curve.held_out_after is None and curve.held_out_before is not None
    assert "not proved there" in curve.sentence
    assert curve.fitted_after == pytest.approx(SIGMA, rel=0.08)


def test_a_phase_of_its_own_in_every_arc() -> None:
    draw = np.random.default_rng(4)
    measured = noise(draw)
    measured[:, 1] += 0.9 * np.sin(2 * np.pi * TIME / 12.0 + draw.uniform(0, 2 * np.pi, ARCS)[LABEL])
    (term,) = carried(measured, place(1))
    assert term.form == "periodic by arc"
    assert term.period == pytest.approx(12.0, abs=0.1)
    assert term.amplitude == pytest.approx(0.9, abs=0.1)
    assert term.held_out_after is not None and term.held_out_after == pytest.approx(SIGMA, rel=0.15)


def test_what_held_out_samples_refute_is_refused() -> None:
    """Levels that turn round where the held-out part begins: constants fit, and predict worse than nothing."""
    draw = np.random.default_rng(5)
    levels = 0.8 * draw.choice([-1.0, 1.0], ARCS)
    measured = noise(draw)
    measured[:, 0] += np.where(FITTED, 1.0, -1.0) * levels[LABEL]
    terms = carried(measured, place(0))
    assert all(t.form != "constant" for t in terms)
    assert all(t.held_out_after is None for t in terms)
    assert all("constant" in t.refused for t in terms if t.refused)
    # Without held-out samples there is nothing to refute it.
    (kept,) = carried(measured, place(0), held_out=False)
    assert kept.held_out_before is None and kept.held_out_after is None and kept.refused == ()


def test_noise_carries_no_term_and_a_trace_is_not_carried_twice() -> None:
    """30 campaigns of noise, asked for a term in both beams: at most 2 get one."""
    draw = np.random.default_rng(6)
    assert sum(bool(carried(noise(draw), place(0, 1))) for _ in range(30)) <= 2
    measured = noise(draw)
    measured[:, 1] += np.linspace(-2.0, 2.0, ARCS)[LABEL] ** 2
    both = carried(measured, place(0, 1))
    # Through the line that the beams share, the levels of one show in the other.
    assert [t.component for t in both] == [1]


def test_a_place_in_one_arc_gets_a_term_there() -> None:
    draw = np.random.default_rng(7)
    measured = noise(draw)
    measured[:, 0] += 0.7 * (LABEL == 3)
    (term,) = carried(measured, place(0, arcs=("pass-3",)))
    assert term.arcs == ("pass-3",) and term.form == "constant"
    assert abs(term.amplitude - 0.7) < 4 * term.sigma


def test_answer_text_and_page_of_an_unknown_campaign_say_it() -> None:
    """A shift of one beam that grows with a temperature, which no effect of the library does."""
    campaign, _ = simulate(preset("compact", housekeeping=True, doppler_sessions=12), 13)
    doppler, series = campaign.doppler, campaign.housekeeping["antenna_temperature"]
    assert doppler is not None
    shift = doppler.frequency_shift.copy()
    shift[:, 1] += 0.6 * (np.interp(doppler.time, series.time, series.values) - 291.0)  # Hz, 0.6 Hz/K
    explanation = explained(replace(campaign, doppler=replace(doppler, frequency_shift=shift)), without=OTHERS)
    answer = answer_of(explanation)
    assert answer["verdict"] == "unknown" and answer["effects"] == []
    for place_ in (*answer["where"], *answer["left"]):
        assert {"channel", "arcs", "time_scale_s", "unit", "excess", "depends_on", "sentence"} <= set(place_)
        assert place_["channel"] == "doppler"
        (relation,) = place_["depends_on"]
        assert relation["covariate"] == "antenna_temperature" and relation["components"] == [1]
        assert relation["slope"] == pytest.approx(0.6, abs=0.08) and relation["slope_unit"] == "Hz/K"
        assert 0.9 < relation["share"] <= 1.0 and relation["p_value"] < 0.005
        assert "grows with antenna_temperature" in relation["sentence"]
        assert "grows with antenna_temperature" in place_["sentence"]
    terms = answer["empirical"]
    assert terms[0]["label"] == "EMPIRICAL" and terms[0]["component"] == 1 and terms[0]["form"] == "constant"
    assert terms[0]["held_out_after"] < 0.8 * terms[0]["held_out_before"]
    assert terms[0]["held_out_after"] == pytest.approx(terms[0]["floor"], rel=0.15)
    json.dumps(jsonable(answer), allow_nan=False)
    assert "antenna_temperature" in answer["next_measurement"]
    text, page = text_of(explanation), page_of(explanation, "flight.nc")
    assert "EMPIRICAL: not a name" in text and "grows with antenna_temperature" in text
    assert "EMPIRICAL: not a name" in page and "<b>antenna_temperature</b>" in page
    assert page.count("<svg") >= len(terms)
    assert "default-src 'none'" in page and "<script" not in page
