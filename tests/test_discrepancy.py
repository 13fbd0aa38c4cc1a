"""Parts of the discrepancy workflow against independent computations: full refits, integrals, simulated searches."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import binom, chi2

from estimator.discrepancy.false_alarm import Looks, after_search, counted_looks
from estimator.discrepancy.gap import find_gap
from estimator.discrepancy.proof import _prediction, misfit, proved, shifts
from estimator.discrepancy.score import (
    Signature,
    Stack,
    log_evidence,
    orthonormalized,
    products,
    scored,
    settings,
    signature,
    stack,
    white_noise_scale,
)
from estimator.effects.declaration import EffectInstance, Parameter, Search
from estimator.problem import Problem
from estimator.residuals import Kernel, KernelResidual, Linearization
from estimator.solvers import solve
from estimator.unknowns import Unknown, Vector

LINE = Unknown("line", Vector(2, ("level", "slope")), "Hz", 10.0)


def effect(*parameters: Parameter, name: str = "candidate") -> EffectInstance:
    return EffectInstance(name, name, "doppler", parameters, lambda sample, p: p, "p = 0", "none")


def ordinary(count: int, scale: float = 1.0) -> EffectInstance:
    return effect(*(Parameter(f"p{i}", "Hz", scale, (-1e3, 1e3)) for i in range(count)))


def stack_of(jacobian: np.ndarray, residual: np.ndarray) -> Stack:
    unknown = Unknown("calibration", Vector(jacobian.shape[1]), "1", 1.0)
    return orthonormalized(residual, {"all": (np.arange(jacobian.shape[1]), jacobian)}, (unknown,), {"all": 1.0})


def candidate(declared: EffectInstance, columns: np.ndarray) -> Signature:
    return Signature(declared, np.zeros(len(declared.parameters)), np.arange(columns.shape[1]), {"all": columns},
                     {"all": slice(0, len(columns))})


def square_after(jacobian: np.ndarray, residual: np.ndarray) -> float:
    return float(np.sum((residual - jacobian @ np.linalg.lstsq(jacobian, residual, rcond=None)[0]) ** 2))


# ---------------------------------------------------------------------------------------------------- scores


def test_stack_by_residuals_is_that_of_the_whole_jacobian() -> None:
    """Residuals that feel different unknowns, one of them more columns than it has rows, one direction unseen."""
    draw = np.random.default_rng(11)
    felt = {"a": np.arange(6), "b": np.array([0, 6, 7]), "c": np.array([1, 2, 6, 8])}
    rows = {"a": 4, "b": 50, "c": 30}
    jacobians = {name: (index, draw.standard_normal((rows[name], len(index)))) for name, index in felt.items()}
    jacobians["c"][1][:, 3] = jacobians["c"][1][:, 2]  # nothing but c feels column 8, and b tells 6 from it
    jacobians["b"][1][:, 1] = 0.0  # but b does not
    whole = np.zeros((84, 9))
    start = 0
    for index, block in jacobians.values():
        whole[start : start + len(block), index] = block
        start += len(block)
    residual, columns = draw.standard_normal(84), draw.standard_normal((84, 3))
    unknown = Unknown("calibration", Vector(9), "1", 1.0)
    made = orthonormalized(residual, jacobians, (unknown,), dict.fromkeys(felt, 1.0))
    assert made.blocks == {"a": slice(0, 4), "b": slice(4, 54), "c": slice(54, 84)}
    rank = np.linalg.matrix_rank(whole)
    assert rank == 8 and made.basis.shape == (84, rank)
    np.testing.assert_allclose(made.basis.T @ made.basis, np.eye(rank), atol=1e-13)
    np.testing.assert_allclose(made.jacobian, whole)
    np.testing.assert_allclose(made.gram, whole.T @ whole, atol=1e-12)
    some = Signature(ordinary(3), np.zeros(3), np.arange(3), {"b": columns[4:54]}, made.blocks)
    np.testing.assert_allclose(made.along(some), whole[4:54].T @ columns[4:54], atol=1e-12)
    np.testing.assert_array_equal(some.columns[4:54], columns[4:54])
    assert not some.columns[:4].any() and not some.columns[54:].any()
    parts = {"c": columns[54:, :2], "a": columns[:4, 1:]}
    other = Signature(ordinary(2), np.zeros(2), np.arange(2), parts, made.blocks)
    found = products(made, (some, other), residual[:, None])
    both = np.concatenate([some.columns, other.columns], axis=1)
    rest = both - made.basis @ (made.basis.T @ both)
    assert found.places == (slice(0, 3), slice(3, 5))
    np.testing.assert_allclose(found.raw, both.T @ both, atol=1e-12)
    np.testing.assert_allclose(found.left, rest.T @ rest, atol=1e-12)
    np.testing.assert_allclose(found.against, rest.T @ residual[:, None], atol=1e-12)
    np.testing.assert_allclose(made.carried(columns), made.basis.T @ columns, atol=1e-12)
    left = columns - whole @ np.linalg.lstsq(whole, columns, rcond=1e-12)[0]
    np.testing.assert_allclose(made.projected(columns), left, atol=1e-12)


@pytest.mark.parametrize("columns", [1, 3, 6])
def test_score_is_the_drop_of_a_full_refit(columns: int) -> None:
    draw = np.random.default_rng(columns)
    jacobian, block, residual = draw.standard_normal((300, 7)), draw.standard_normal((300, columns)), \
        draw.standard_normal(300) * 2
    declared = ordinary(columns, scale=0.25)
    score = scored(stack_of(jacobian, residual), candidate(declared, block))
    both = np.hstack([jacobian, block])
    assert score.degrees == columns
    assert score.score == pytest.approx(square_after(jacobian, residual) - square_after(both, residual), rel=1e-9)
    refit = -np.linalg.lstsq(both, residual, rcond=None)[0][7:] * 0.25
    covariance = np.linalg.inv(both.T @ both)[7:, 7:] * 0.25**2
    np.testing.assert_allclose(score.size, refit, rtol=1e-8)
    np.testing.assert_allclose(score.sigma, np.sqrt(np.diag(covariance)), rtol=1e-8)


def test_what_the_calibration_absorbs_carries_no_evidence() -> None:
    draw = np.random.default_rng(3)
    jacobian, residual = draw.standard_normal((200, 5)), draw.standard_normal(200)
    inside = jacobian @ draw.standard_normal((5, 2))
    hidden = scored(stack_of(jacobian, residual), candidate(ordinary(2), inside))
    assert hidden.degrees == 0 and hidden.score == 0 and hidden.p_value == 1
    assert hidden.absorbed_by == ("calibration",)
    assert np.isinf(hidden.sigma).all()
    half = np.column_stack([inside[:, 0], draw.standard_normal(200)])
    partly = scored(stack_of(jacobian, residual), candidate(ordinary(2), half))
    assert partly.degrees == 1
    assert np.isinf(partly.sigma[0]) and np.isfinite(partly.sigma[1])


def test_scores_without_the_effect_are_chi_square() -> None:
    draw = np.random.default_rng(5)
    jacobian, block = draw.standard_normal((120, 4)), draw.standard_normal((120, 3))
    values = [scored(stack_of(jacobian, draw.standard_normal(120)), candidate(ordinary(3), block)).score
              for _ in range(600)]
    # Mean 3 and variance 6 of 600 draws: standard errors 0.1 and about 0.55.
    assert np.mean(values) == pytest.approx(3.0, abs=0.4)
    assert np.var(values) == pytest.approx(6.0, abs=2.2)


def test_evidence_is_the_integral_over_the_prior() -> None:
    information, gradient = 7.0, 4.2
    plain = effect(Parameter("p", "Hz", 2.0, (-1e3, 1e3)))
    known = effect(Parameter("p", "1", 1.0, (0.0, 2.0), nominal=1.0))
    for declared, centre, width in ((plain, 0.0, 3.0), (known, 1.0, 0.02)):
        def integrand(x: float, centre: float = centre, width: float = width) -> float:
            prior = np.exp(-0.5 * ((x - centre) / width) ** 2) / (width * np.sqrt(2 * np.pi))
            return float(np.exp(gradient * x - 0.5 * information * x**2) * prior)

        integral = quad(integrand, centre - 12 * width, centre + 12 * width, limit=400)[0]
        found = log_evidence(declared, np.array([0]), np.array([[information]]), np.array([gradient]))
        assert found == pytest.approx(np.log(integral), abs=1e-6)


def test_settings_are_the_grid_of_the_searched_parameters() -> None:
    declared = effect(Parameter("size", "1", 1.0, (-1.0, 1.0)),
                      Parameter("frequency", "Hz", 1.0, (0.0, 9.0), search=Search(0.1, 10.0, 3, "logarithmic")),
                      Parameter("time", "s", 1.0, (0.0, 9.0), search=Search(0.0, 4.0, 5, "linear")))
    grid = np.array(settings(declared))
    assert (grid[:, 0] == 0).all()
    np.testing.assert_allclose(np.unique(grid[:, 1]), [0.1, 1.0, 10.0])
    assert set(grid[:, 2]) <= {0.0, 1.0, 2.0, 3.0, 4.0} and 2.0 in grid[:, 2]
    np.testing.assert_allclose(settings(ordinary(2)), [[0.0, 0.0]])


# ---------------------------------------------------------------------------------------------------- false alarms


def looks_of(blocks: list[np.ndarray], names: list[str] | None = None) -> Looks:
    together = np.concatenate(blocks, axis=1)
    degrees = [b.shape[1] for b in blocks]
    ends = np.cumsum([0, *degrees])
    return counted_looks(together.T @ together, degrees, [slice(a, b) for a, b in pairwise(ends)],
                         names or [str(k) for k in range(len(blocks))])


def test_looks_make_the_simulated_search_keep_its_level() -> None:
    """Brute force: noise, every candidate fitted by its own least squares, the smallest p of the whole library."""
    draw = np.random.default_rng(8)
    common = draw.standard_normal((60, 4))
    blocks = [common[:, : 1 + k % 3] + 0.5 * draw.standard_normal((60, 1 + k % 3)) for k in range(12)]
    blocks += [draw.standard_normal((60, 2)) for _ in range(6)]
    looks = looks_of(blocks).names
    assert 3 < looks < len(blocks) * 1.3
    bases = [np.linalg.qr(b)[0] for b in blocks]
    trials = 6000
    noise = draw.standard_normal((trials, 60))
    smallest = np.min([chi2.sf(np.sum((noise @ q) ** 2, axis=1), q.shape[1]) for q in bases], axis=0)
    alarms = int(np.sum([after_search(p, looks) < 0.01 for p in smallest]))
    low, high = binom.ppf([0.0005, 0.9995], trials, 0.01)
    # The number of looks is itself estimated from 4000 draws at the 2 % level: 11 % more room on either side.
    assert 0.8 * low <= alarms <= 1.2 * high


def test_one_candidate_is_one_look_and_many_independent_ones_are_many() -> None:
    basis = np.eye(80)
    assert looks_of([basis[:, :1]]).names == pytest.approx(1.0, rel=0.3)
    many = looks_of([basis[:, k : k + 1] for k in range(80)]).names
    assert many == pytest.approx(80, rel=0.25)
    copies = looks_of([basis[:, :1] for _ in range(80)]).names
    assert copies == pytest.approx(1.0, rel=0.3)
    assert counted_looks(np.zeros((0, 0)), [], [], []) == Looks()


def test_settings_share_the_level_of_their_name() -> None:
    """One name at 60 settings beside three of one each: the whole keeps its level, the three pay for four names."""
    draw = np.random.default_rng(4)
    blocks = [draw.standard_normal((80, 2)) for _ in range(63)]
    names = ["mode"] * 60 + ["a", "b", "c"]
    looks = looks_of(blocks, names)
    assert looks.names == pytest.approx(4, rel=0.2)
    assert looks.own["mode"] == pytest.approx(60, rel=0.25) and set(looks.own) == {"mode"}
    assert looks.after(1e-3, "a") == pytest.approx(4e-3, rel=0.2)
    assert looks.after(1e-5, "mode") == pytest.approx(2.4e-3, rel=0.35)
    trials = 6000
    noise = draw.standard_normal((trials, 80))
    p_values = np.array([chi2.sf(np.sum((noise @ np.linalg.qr(b)[0]) ** 2, axis=1), 2) for b in blocks])
    alarms = sum(min(looks.after(float(p), n) for p, n in zip(column, names, strict=True)) < 0.01
                 for column in p_values.T)
    low, high = binom.ppf([0.0005, 0.9995], trials, 0.01)
    assert 0.8 * low <= alarms <= 1.2 * high


def test_probability_after_the_search() -> None:
    assert after_search(0.01, 10.0) == pytest.approx(1 - 0.99**10)
    assert after_search(1e-9, 100.0) == pytest.approx(1e-7, rel=1e-6)
    assert after_search(1.0, 5.0) == pytest.approx(1.0)


# ---------------------------------------------------------------------------------------------------- a whole problem


def problem_of(time: np.ndarray, measured: np.ndarray, sigma: float, *, arcs: int = 1, curved: bool = False,
               accepted: np.ndarray | None = None) -> Problem:
    """Two beams that share a line of level and slope; with ``curved`` a candidate on the second beam."""
    unknowns = [LINE]
    if curved:
        unknowns.append(Unknown("candidate", Vector(1, ("p0",)), "Hz", 0.5))

    def build(x: dict[str, ca.SX]) -> ca.SX:
        line = x["line"][0] + x["line"][1] * x["time"]
        bent = line + (x["candidate"] * x["time"] ** 2 if curved else 0)
        return x["measured"] - ca.vertcat(line, bent)

    kernel = Kernel(f"two_beams_{'curved' if curved else 'plain'}", unknowns, (), (("time", 1), ("measured", 2)), (),
                    build)
    label = np.minimum((arcs * np.arange(len(time))) // len(time), arcs - 1)
    residual = KernelResidual("doppler", "doppler", "Hz", kernel, (), {"time": time[:, None], "measured": measured},
                              np.full(measured.shape, sigma), time, label, tuple(f"pass-{k}" for k in range(arcs)),
                              accepted=accepted)
    start = {u.name: np.zeros(u.manifold.ambient) for u in unknowns}
    return Problem(tuple(unknowns), (residual,), start, frozenset({"candidate"} if curved else ()))


def irregular(draw: np.random.Generator, count: int = 160) -> np.ndarray:
    """Samples with jitter and a long gap."""
    time = np.sort(draw.uniform(-1, 1, 2 * count))
    return time[(time < 0.1) | (time > 0.4)][:count]


def fitted(problem: Problem) -> tuple[Problem, Stack, list[Linearization], dict[str, np.ndarray]]:
    estimate = solve(problem)
    values = dict(estimate.values)
    prepared = problem.prepared(values)
    parts = prepared.linearize(values)
    return prepared, stack(prepared, parts), parts, values


def test_score_of_a_problem_predicts_its_refit() -> None:
    draw = np.random.default_rng(21)
    time = irregular(draw)
    truth = np.column_stack([3 + 2 * time, 3 + 2 * time + 1.3 * time**2])
    problem = problem_of(time, truth + 0.2 * draw.standard_normal(truth.shape), 0.2, curved=True)
    prepared, rows, parts, _ = fitted(problem)
    declared = ordinary(1, scale=0.5)
    score = scored(rows, signature(rows, prepared, parts, declared, np.zeros(1)))
    before, after = solve(problem), solve(problem.freeing("candidate"))
    drop = sum(p.cost for p in before.parts) - sum(p.cost for p in after.parts)
    assert score.score == pytest.approx(drop, rel=1e-6)
    assert score.size[0] == pytest.approx(float(after.values["candidate"][0]), rel=1e-6)
    assert score.sigma[0] == pytest.approx(float(after.sigma_of("candidate")[0]), rel=1e-6)
    assert abs(score.size[0] - 1.3) < 4 * score.sigma[0]
    moved = shifts(before, after)["line"]
    step = np.asarray(after.values["line"]) - np.asarray(before.values["line"])
    assert moved == pytest.approx(float(np.sqrt(step @ np.linalg.inv(after.covariance_of("line")) @ step)), rel=1e-6)


def test_gap_keeps_its_level_and_finds_what_is_there() -> None:
    draw = np.random.default_rng(33)
    trials, alarms = 300, 0
    for _ in range(trials):
        time = irregular(draw)
        line = (1 - 4 * time)[:, None] * np.ones(2)
        prepared, rows, parts, _ = fitted(problem_of(time, line + 0.3 * draw.standard_normal(line.shape), 0.3, arcs=2))
        alarms += find_gap(prepared, rows, parts).present
    assert alarms <= binom.ppf(0.999, trials, 0.01)
    bent = line.copy()
    bent[:, 1] += 0.6 * np.sin(9 * time)
    prepared, rows, parts, _ = fitted(problem_of(time, bent + 0.3 * draw.standard_normal(line.shape), 0.3, arcs=2))
    gap = find_gap(prepared, rows, parts)
    assert gap.present
    assert gap.places[0].channel == "doppler" and gap.places[0].components == (1,)
    assert gap.places[0].unit == "Hz" and gap.places[0].floor == pytest.approx(0.3)
    # 0.6 Hz of amplitude is 0.42 Hz RMS; the line takes a part of it.
    assert 0.2 < gap.places[0].excess < 0.5


def test_a_period_too_fast_for_smooth_functions_is_found_in_all_arcs_together() -> None:
    """0.35 of the noise in each of six passes, with a phase of its own: 12 sigma in all, invisible in any one."""
    draw = np.random.default_rng(17)
    time = np.linspace(-1, 1, 600)
    line = (2 + time)[:, None] * np.ones(2)
    label = np.minimum((6 * np.arange(600)) // 600, 5)
    phase = draw.uniform(0, 2 * np.pi, 6)[label]
    measured = line + 0.3 * draw.standard_normal(line.shape)
    quiet = problem_of(time, measured, 0.3, arcs=6)
    shaken = measured.copy()
    shaken[:, 0] += 0.35 * 0.3 * np.sqrt(2) * np.sin(2 * np.pi * time / 0.021 + phase)
    prepared, rows, parts, _ = fitted(quiet)
    assert not find_gap(prepared, rows, parts).present
    prepared, rows, parts, _ = fitted(problem_of(time, shaken, 0.3, arcs=6))
    gap = find_gap(prepared, rows, parts)
    (place,) = gap.places
    assert place.components == (0,)
    assert place.time_scale == pytest.approx(0.021, rel=0.05) and "repeats every" in place.sentence


def test_structure_below_the_declared_noise_is_no_gap() -> None:
    draw = np.random.default_rng(19)
    time = np.linspace(-1, 1, 400)
    line = (2 + time)[:, None] * np.ones(2)
    measured = line + 0.1 * draw.standard_normal(line.shape) + 0.12 * np.sin(7 * time)[:, None]
    prepared, rows, parts, _ = fitted(problem_of(time, measured, 0.1))
    assert find_gap(prepared, rows, parts).present
    prepared, rows, parts, _ = fitted(problem_of(time, measured, 0.3))  # declared: twice what there is
    assert not find_gap(prepared, rows, parts).present


def test_larger_white_noise_is_not_taken_for_structure() -> None:
    draw = np.random.default_rng(4)
    time = np.sort(draw.uniform(-1, 1, 400))
    line = (2 + time)[:, None] * np.ones(2)
    problem = problem_of(time, line + 0.45 * draw.standard_normal(line.shape), 0.3)
    prepared, rows, parts, _ = fitted(problem)
    assert white_noise_scale(parts[0]) == pytest.approx(1.5, rel=0.12)
    gap = find_gap(prepared, rows, parts)
    assert not gap.present
    assert gap.white and gap.white[0][0] == "doppler" and gap.white[0][1] == pytest.approx(1.5, rel=0.12)


def test_held_out_samples_leave_the_fit_alone_and_tell_the_miss() -> None:
    draw = np.random.default_rng(6)
    time = np.linspace(-1, 1, 200)
    line = (2 + time)[:, None] * np.ones(2)
    measured = line + 0.1 * draw.standard_normal(line.shape)
    used = time < 0.6
    spoiled = measured.copy()
    spoiled[~used] += 5.0
    first, second = (solve(problem_of(time, m, 0.1, accepted=used)) for m in (measured, spoiled))
    np.testing.assert_allclose(first.values["line"], second.values["line"], rtol=1e-12)
    kept, missed = (misfit(e.problem, e.parts, held_out=True)["doppler"] for e in (first, second))
    assert kept.count == missed.count == 2 * int((~used).sum())
    assert kept.floor == pytest.approx(0.1)
    assert kept.ratio == pytest.approx(1.0, abs=0.25)
    assert missed.rms == pytest.approx(5.0, rel=0.05)
    inside = misfit(first.problem, first.parts, held_out=False)["doppler"]
    assert inside.count == 2 * int(used.sum())
    assert inside.square == pytest.approx(sum(p.cost for p in first.parts), rel=1e-9)


def test_an_addition_pays_where_held_out_samples_bear_it_out() -> None:
    """A curve on the second beam that goes on into the held-out end pays; one that turns round there does not."""
    draw = np.random.default_rng(8)
    time = np.linspace(-1, 1, 300)
    used = time < 0.5
    line = (2 + time)[:, None] * np.ones(2)
    noise = 0.1 * draw.standard_normal(line.shape)

    def verdict(curve: np.ndarray) -> bool:
        measured = line + noise
        measured[:, 1] += curve
        plain = solve(problem_of(time, measured, 0.1, accepted=used))
        bent = solve(problem_of(time, measured, 0.1, curved=True, accepted=used).freeing("candidate"))
        return not proved(plain, bent, ("doppler",)).refuted

    assert verdict(0.5 * time**2)
    assert not verdict(np.where(used, 0.5 * time**2, -1.0))


def test_held_out_misses_are_weighed_by_the_covariance_of_the_prediction() -> None:
    """In a linear problem their weighed sum of squares is what the minimum rises by when the samples are fitted too."""
    draw = np.random.default_rng(21)
    time = np.linspace(-1, 1, 120)
    used = time < 0.3
    measured = (2 + time)[:, None] * np.ones(2) + 0.1 * draw.standard_normal((len(time), 2))
    part = solve(problem_of(time, measured, 0.1, accepted=used))
    whole = solve(problem_of(time, measured, 0.1))
    predicted = _prediction(part, ("doppler",), {r.name for r in part.problem.residuals})
    rise = sum(p.cost for p in whole.parts) - sum(p.cost for p in part.parts)
    assert predicted.product(predicted.miss, predicted.miss) == pytest.approx(rise, rel=1e-9)
    assert predicted.product(predicted.miss, predicted.miss) < predicted.miss @ predicted.miss


def test_rows_of_rejected_samples_are_silent() -> None:
    draw = np.random.default_rng(14)
    time = irregular(draw)
    measured = draw.standard_normal((len(time), 2))
    used = np.arange(len(time)) % 4 != 0
    problem = problem_of(time, measured, 1.0, curved=True, accepted=used)
    prepared, rows, _, values = fitted(problem)
    whole = prepared.residuals[0]
    assert isinstance(whole, KernelResidual)
    small = replace(prepared, residuals=(replace(whole.subset(used), accepted=None),))
    fewer = stack(small, small.linearize(values))
    assert float(rows.residual @ rows.residual) == pytest.approx(float(fewer.residual @ fewer.residual))
    declared = ordinary(1, scale=0.5)
    one = scored(rows, signature(rows, prepared, prepared.linearize(values), declared, np.zeros(1)))
    two = scored(fewer, signature(fewer, small, small.linearize(values), declared, np.zeros(1)))
    assert one.score == pytest.approx(two.score, rel=1e-9)
    assert one.size[0] == pytest.approx(two.size[0], rel=1e-9)
