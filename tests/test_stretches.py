"""Positions in several stretches: where they fall apart, and that one block of all equals a fit of each."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from estimator.linear_block import choose_degree, compress
from estimator.models.errors import RequestError, TooFewDataError
from estimator.models.fourier_trajectory import FourierFrame
from estimator.stretched_block import (
    StretchedFrame,
    choose_degrees,
    compress_stretches,
    stretched_frame,
    stretches_of,
)
from problems.alignment.campaign import Campaign
from problems.alignment.problem import alignment_model
from problems.alignment.simulator import preset, simulate
from problems.alignment.solution import solve_campaign

ORBIT = 5900.0  # [s]


# ---------------------------------------------------------------------------------------------------------------- #
# where samples fall apart


def test_samples_without_gaps_are_one_stretch() -> None:
    assert stretches_of(np.arange(0.0, 21600.0), ORBIT) == (slice(0, 21600),)
    assert stretches_of(np.array([5.0]), ORBIT) == (slice(0, 1),)


@settings(max_examples=60)
@given(seed=st.integers(0, 10**6), chunks=st.integers(1, 20), step=st.sampled_from([0.2, 1.0, 10.0]))
def test_an_arc_with_a_third_missing_in_chunks_is_one_stretch(seed: int, chunks: int, step: float) -> None:
    """Chunks of equal length, 30 % in all, at random places (they may touch) of three orbits."""
    random = np.random.default_rng(seed)
    count = int(3 * ORBIT / step)
    missing = int(0.3 * count / chunks)
    keep = np.ones(count, dtype=bool)
    for start in random.integers(1, count - missing - 1, chunks):
        keep[start : start + missing] = False
    time = np.arange(count)[keep] * step
    assert len(stretches_of(time, ORBIT)) == 1


@settings(max_examples=60)
@given(pauses=st.lists(st.floats(1500.0, 1e9), min_size=1, max_size=12), size=st.integers(4, 17))
def test_short_lists_far_apart_are_a_stretch_each(pauses: list[float], size: int) -> None:
    """Lists of vectors ten seconds apart, with pauses from a quarter of an orbit to thirty years."""
    starts = np.cumsum([0.0, *(p + 10.0 * size for p in pauses)])
    time = np.concatenate([s + 10.0 * np.arange(size) for s in starts])
    found = stretches_of(time, ORBIT)
    assert found == tuple(slice(k * size, (k + 1) * size) for k in range(len(starts)))


def test_a_long_pause_between_well_filled_days_is_not_bridged() -> None:
    days = np.concatenate([np.arange(0.0, 2 * 86400.0, 10.0), np.arange(3 * 86400.0, 5 * 86400.0, 10.0)])
    assert stretches_of(days, ORBIT) == (slice(0, 17280), slice(17280, 34560))


def test_times_out_of_order_are_refused() -> None:
    with pytest.raises(RequestError, match="decrease"):
        stretches_of(np.array([0.0, 2.0, 1.0]), ORBIT)
    with pytest.raises(RequestError, match="overlap"):
        StretchedFrame((FourierFrame(0, 10, 2),) * 2, (0.0, 5.0), (10.0, 15.0))


# ---------------------------------------------------------------------------------------------------------------- #
# one block of all stretches


def motion(time: np.ndarray) -> np.ndarray:
    """Something like an orbit: three axes, m."""
    w = 2 * np.pi / ORBIT
    return 7e6 * np.column_stack([np.cos(w * time), np.sin(w * time) * 0.7, np.sin(w * time + 0.4) * 0.6])


@lru_cache(maxsize=1)
def stretched() -> tuple[np.ndarray, np.ndarray, np.ndarray, StretchedFrame]:
    """Times, noisy samples, weights (unequal, some zero) of three stretches, and a frame of each."""
    random = np.random.default_rng(4)
    time = np.concatenate([np.arange(0.0, 160, 10), 5e4 + np.arange(0.0, 3000, 7), 3e8 + np.arange(0.0, 170, 10)])
    values = motion(time) + random.normal(0, 0.1, (time.size, 3))
    weights = random.uniform(50, 200, (time.size, 3))
    weights[:, 1] = weights[:, 0] * 2  # two axes share their weights up to a factor
    weights[random.integers(0, time.size, 20)] = 0.0
    parts = stretches_of(time, ORBIT)
    assert len(parts) == 3
    deviation = np.where(weights > 0, 1 / np.sqrt(np.maximum(weights, 1e-9)), np.inf)
    frame, _ = choose_degrees(time, values, deviation, parts)
    return time, values, weights, frame


def test_the_block_of_all_stretches_is_the_fit_of_each() -> None:
    time, values, weights, frame = stretched()
    block = compress_stretches(frame, time, values, weights)
    separate = [compress(f, time[s] - start, values[s], weights[s])
                for f, start, s in zip(frame.frames, frame.starts, stretches_of(time, ORBIT), strict=True)]
    assert np.array_equal(block.coefficients, np.concatenate([b.coefficients for b in separate]))
    assert np.allclose(block.sum_of_squares, sum(b.sum_of_squares for b in separate), rtol=1e-14)
    assert np.array_equal(block.ranks, sum(b.ranks for b in separate))
    assert np.array_equal(block.degrees_of_freedom, np.count_nonzero(weights, axis=0) - block.ranks)
    asked = np.concatenate([[3.0, 100.0], 5e4 + np.array([11.0, 2000.0]), 3e8 + np.array([77.0])])
    order = np.array([3, 0, 4, 2, 1])  # asked out of order
    for derivative in (0, 1):
        expected = np.concatenate([b.values(asked[p] - start, derivative) for b, p, start in
                                   zip(separate, ([0, 1], [2, 3], [4]), frame.starts, strict=True)])
        assert np.array_equal(block.values(asked[order], derivative), expected[order])
        for axis in range(3):
            rows = block.sensitivity(asked[order], derivative, axis)
            deviation = block.standard_deviation(asked[order], derivative, axis)
            assert rows.shape == (5, block.ranks[axis])
            assert np.allclose(np.linalg.norm(rows, axis=1), deviation, rtol=1e-10)
            for k, b, places in zip(range(3), separate, ([0, 1], [2, 3], [4]), strict=True):
                mine = np.isin(order, places)
                assert np.array_equal(rows[mine][:, block.columns(axis)[k]],
                                      b.sensitivity(asked[order][mine] - frame.starts[k], derivative, axis))
                assert not rows[~mine][:, block.columns(axis)[k]].any()


def test_samples_in_any_order_give_the_same_block() -> None:
    time, values, weights, frame = stretched()
    order = np.random.default_rng(1).permutation(time.size)
    one = compress_stretches(frame, time, values, weights)
    other = compress_stretches(frame, time[order], values[order], weights[order])
    assert np.allclose(one.coefficients, other.coefficients, rtol=0, atol=1e-4)
    assert np.allclose(one.residuals()[order], other.residuals(), atol=1e-6)
    extra = np.random.default_rng(2).normal(size=(time.size, 2))
    assert np.allclose(np.sum(one.project(extra, 0) ** 2, axis=0), np.sum(other.project(extra[order], 0) ** 2, axis=0))


def test_the_cost_is_a_constant_plus_the_square_of_the_coordinates() -> None:
    """What the whole problem rests on, by the definition of the cost; and the projection takes up what it says."""
    time, values, weights, frame = stretched()
    block = compress_stretches(frame, time, values, weights)
    random = np.random.default_rng(7)
    for axis in range(3):
        zeta = random.normal(0, 3, block.ranks[axis])
        sensitivity = block.sensitivity(time, 0, axis)
        shifted = block.residuals()[:, axis] - sensitivity @ zeta
        cost = float(weights[:, axis] @ shifted**2)
        assert cost == pytest.approx(block.sum_of_squares[axis] + zeta @ zeta, rel=1e-7)
        moved = coefficient_values(frame, block.coefficients[:, axis] + block.transform(axis) @ zeta, time)
        assert np.allclose(moved, block.values(time)[:, axis] + sensitivity @ zeta, atol=1e-5)
        extra = random.normal(size=(time.size, 2))
        direct = (sensitivity * weights[:, [axis]]).T @ extra
        assert np.allclose(block.project(extra, axis), direct, atol=1e-6 * np.abs(direct).max())


def coefficient_values(frame: StretchedFrame, coefficients: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Values (n,) of the series of each stretch, from the stacked coefficients of one axis."""
    result, first = np.empty(time.size), 0
    for k, f in enumerate(frame.frames):
        mine = frame.stretch(time) == k
        result[mine] = f.basis(time[mine] - frame.starts[k]) @ coefficients[first : first + f.size]
        first += f.size
    return result


def test_years_after_the_epoch_cost_no_precision() -> None:
    """The same samples near the epoch and eleven years later (times that are exact numbers): the same velocity."""
    local = np.concatenate([np.arange(0.0, 160.0, 10.0), 65536.0 + np.arange(0.0, 160.0, 10.0)])
    values = motion(local)
    sigma = np.full(values.shape, 0.1)
    asked = np.array([33.25, 65536.0 + 120.5])
    velocities = []
    for origin in (0.0, 2.0**28, 2.0**30):
        time = origin + local
        frame, _ = choose_degrees(time, values, sigma, stretches_of(time, ORBIT))
        velocities.append(compress_stretches(frame, time, values, 1 / sigma**2).values(origin + asked, 1))
    assert np.array_equal(velocities[0], velocities[1])
    assert np.array_equal(velocities[0], velocities[2])
    w = 2 * np.pi / ORBIT
    truth = 7e6 * w * np.column_stack([-np.sin(w * asked), np.cos(w * asked) * 0.7, np.cos(w * asked + 0.4) * 0.6])
    assert np.abs(velocities[0] - truth).max() < 0.02  # m/s, of 7500; samples are declared good to 0.1 m in 160 s


def test_bounds_are_those_of_the_data_and_not_of_the_frame() -> None:
    time, _, _, frame = stretched()
    assert max(f.span for f in frame.frames) > 300.0  # a frame of few oscillations is longer than its data
    asked = np.array([-1.0, 0.0, 150.0, 150.5, 4.9e4, 5e4, 3e8, 3e8 + 160.0, 3e8 + 161.0])
    assert frame.inside(asked).tolist() == [False, True, True, False, False, True, True, True, False]
    assert frame.inside(asked, 1.0)[[0, 3, 8]].all()
    assert frame.nearest(asked)[[0, 3, 4, 8]].tolist() == [0.0, 150.0, 5e4, 3e8 + 160.0]
    assert frame.degree == max(frame.degrees)
    with pytest.raises(RequestError, match="in no stretch"):
        compress_stretches(frame, np.append(time, 2e4), np.zeros((time.size + 1, 3)), np.ones((time.size + 1, 3)))
    with pytest.raises(TooFewDataError, match="no sample"):
        compress_stretches(frame, time[:10], np.zeros((10, 3)), np.ones((10, 3)))
    plain = stretched_frame(time, stretches_of(time, ORBIT), 5)
    assert plain.degrees == (5, 5, 5)


# ---------------------------------------------------------------------------------------------------------------- #
# in the alignment problem


@lru_cache(maxsize=1)
def whole() -> Campaign:
    return simulate(preset("compact"), seed=3)[0]


def with_positions(campaign: Campaign, keep: np.ndarray) -> Campaign:
    g = campaign.gnss
    sigma = np.broadcast_to(g.standard_deviation, g.position.shape)[keep]
    return replace(campaign, gnss=replace(g, time=g.time[keep], position=g.position[keep], standard_deviation=sigma))


def angle_between(a: np.ndarray, b: np.ndarray) -> float:
    first, second = (Rotation.from_quat(q, scalar_first=True) for q in (a, b))
    return float((first * second.inv()).magnitude())


def test_a_campaign_in_stretches_gives_the_estimate_of_the_whole_one() -> None:
    """Positions around the Doppler sessions alone: what the estimate needs is there, and it says the same."""
    campaign = whole()
    time = campaign.gnss.time
    sessions = campaign.arcs_of_kind("doppler")
    keep = np.zeros(time.size, dtype=bool)
    for arc in (sessions[0], sessions[-1]):
        keep |= (time >= arc.start - 120) & (time <= arc.stop + 120)
    cut = with_positions(campaign, keep)
    full, part = solve_campaign(campaign), solve_campaign(cut)
    assert len(part.model.stretches) == 2
    used = len(part.model.doppler_epochs)
    assert 0 < used < len(full.model.doppler_epochs)
    assert any(f"{len(campaign.doppler.time) - used} of {len(campaign.doppler.time)} Doppler epochs left out" in s
               for s in part.model.left_out)
    assert "Doppler epochs left out" in part.why
    sigma = np.sqrt(np.trace(part.estimate.covariance_of("antenna_from_tracker")))
    assert angle_between(full.antenna_from_tracker, part.antenna_from_tracker) < 3.5 * sigma
    assert not full.model.left_out


def test_gaps_inside_an_arc_keep_one_frame() -> None:
    campaign = whole()
    time = campaign.gnss.time
    position = np.arange(time.size) / time.size
    keep = ~(((position > 0.12) & (position < 0.27)) | ((position > 0.6) & (position < 0.75)))
    model = alignment_model(with_positions(campaign, keep))
    assert len(model.stretches) == 1
    assert isinstance(model.frame, FourierFrame)


def test_a_frame_can_be_used_again() -> None:
    """Held-out fits must not choose a trajectory of their own, whether the frame is longer than its data or not."""
    campaign = whole()
    time = campaign.gnss.time
    short = with_positions(campaign, time < time[0] + 400)
    model = alignment_model(short)
    frame = choose_degree(short.gnss.time, short.gnss.position, short.gnss.standard_deviation).frame
    assert model.frame == frame
    again = alignment_model(short, frame=model.frame, hold_out=0.2)
    assert again.frame == frame
    assert 0 < int(np.sum(~again.used_positions)) < 0.4 * short.gnss.time.size
    inside = short.doppler.time <= short.gnss.time[-1] + 1e-6
    assert not inside.all()
    assert set(model.doppler_epochs) <= set(np.flatnonzero(inside))


def test_positions_too_few_for_a_trajectory_are_left_out_and_said() -> None:
    campaign = whole()
    time = campaign.gnss.time
    lone = np.zeros(time.size, dtype=bool)
    lone[-3:] = True
    model = alignment_model(with_positions(campaign, (time < time[0] + 1200) | lone))
    assert model.dropped_positions == 3
    assert model.campaign.gnss.time[-1] < time[0] + 1200
    assert any(s.startswith("3 positions left out") for s in model.left_out)
    scattered = np.zeros(time.size, dtype=bool)
    scattered[[0, 1, -2, -1]] = True
    with pytest.raises(TooFewDataError, match="no stretch of positions"):
        alignment_model(with_positions(campaign, scattered))
