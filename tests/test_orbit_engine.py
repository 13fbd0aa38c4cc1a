"""One engine behind many burns, and one calibration behind many arcs: against what follows by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimator.problem import Problem
from estimator.unknowns import Unknown, Vector
from problems.geo_orbit.common_calibration import fitted_together, told
from problems.geo_orbit.engine import Engine, engine_of
from problems.geo_orbit.manoeuvres import Fit, Prior, turned

THRUST = 4e-5  # m/s2


def test_burns_of_one_engine_tell_its_acceleration() -> None:
    rng = np.random.default_rng(1)
    size = rng.uniform(0.05, 0.3, 40)  # m/s
    sigma = np.full(40, 200.0)
    length = size / THRUST + sigma * rng.standard_normal(40)
    axis = np.array([-0.54, 0.0, 0.84])
    engine = engine_of([s * axis / np.linalg.norm(axis) for s in size], list(length), list(sigma))
    assert engine is not None
    assert abs(engine.acceleration - THRUST) < 4 * engine.sigma
    assert engine.sigma < 0.02 * THRUST
    assert abs(engine.duration(np.array([0.0, 0.0, 0.2])) - 5000.0) < 200.0


def test_a_burn_with_a_step_beside_it_does_not_spoil_the_engine() -> None:
    size = np.array([0.1, 0.15, 0.2, 0.12, 0.18, 0.2])
    length = size / THRUST
    length[5] *= 3.0
    engine = engine_of([np.array([0.0, 0.0, s]) for s in size], list(length), [60.0] * 6)
    assert engine is not None and abs(engine.acceleration / THRUST - 1.0) < 0.01


def test_burns_that_have_nothing_in_common_are_no_engine() -> None:
    velocity = [np.array([0.0, 0.0, 0.2])] * 6
    assert engine_of(velocity, [300.0, 900.0, 2700.0, 5000.0, 9000.0, 15000.0], [10.0] * 6) is None
    assert engine_of(velocity[:3], [5000.0] * 3, [10.0] * 3) is None
    assert engine_of(velocity, [5000.0] * 6, [2000.0] * 6) is None


def test_the_row_of_an_engine_is_its_misfit_to_first_order() -> None:
    engine = Engine(THRUST, 1e-7, 0.03, 10)
    velocity = np.array([-0.1, 0.001, 0.16])
    row = engine.row(velocity)
    for factor in (1.0, 1.05):
        duration = factor * engine.duration(velocity)
        distance = row @ np.array([*velocity, duration])
        assert abs(distance**2 - engine.misfit(velocity[None], np.array([duration]))[0]) < 1e-4
    # Larger burns of the engine are longer, and as likely.
    assert abs(row @ np.array([*(1.1 * velocity), engine.duration(1.1 * velocity)])) < 1e-9


def test_a_nozzle_points_where_it_is_mounted() -> None:
    """The direction of north and south burns, and a burn with a step along the orbit in it."""
    size = np.array([0.1, 0.15, 0.2, 0.12, 0.18, 0.2, 0.11, 0.17])
    north, south = np.array([-0.54, 0.0, 0.84]), np.array([-0.55, 0.0, -0.83])
    burns = [s * (north if k % 2 else south) for k, s in enumerate(size)]
    engine = engine_of(burns, list(size / THRUST), [60.0] * 8)
    assert engine is not None and engine.north is not None and engine.south is not None
    assert engine.north @ north > 0.999 * np.linalg.norm(north)
    assert engine.south @ south > 0.999 * np.linalg.norm(south)
    assert not engine.leaves(0.2 * north + np.array([0.0, -0.005, 0.0]))
    assert engine.leaves(0.2 * north + np.array([0.0, -0.03, 0.0]))


def test_a_step_along_the_longitude_turns_the_orbit() -> None:
    """A turn of 0.2 degrees keeps radius and speed, where the straight step loses hundreds of metres."""
    r, v = np.array([42164e3, 0.0, 1e4]), np.array([0.0, 3074.0, 1.0])
    angle = np.radians(0.2)
    by, faster = angle * np.array([0.0, r[0], 0.0]), angle * np.array([-v[1], 0.0, 0.0])
    position, velocity = turned(r, v, by, faster)
    assert abs(np.linalg.norm(position) - np.linalg.norm(r)) < 1e-3
    assert abs(np.linalg.norm(velocity) - np.linalg.norm(v)) < 1e-6
    assert np.linalg.norm(r + by) - np.linalg.norm(r) > 200.0
    small = turned(r, v, 1e-3 * np.ones(3), 1e-6 * np.ones(3))
    assert np.allclose(small[0] - r, 1e-3, atol=1e-8) and np.allclose(small[1] - v, 1e-6, atol=1e-9)


def test_arcs_fitted_in_turn_end_where_one_fit_of_all_ends() -> None:
    """Linear arcs: the common numbers and their covariance are those of the joint least-squares problem."""
    rng = np.random.default_rng(2)
    common = Unknown("common", Vector(2, ("a", "b")), "m", (1.0, 10.0))
    designs = [rng.standard_normal((30, 5)), rng.standard_normal((20, 5)), rng.standard_normal((9, 5))]
    measured = [rng.standard_normal(len(d)) for d in designs]
    assumed = Prior.of("common", np.zeros(2), np.array([5.0, 5.0]))

    def fit_of(number: int, values: dict[str, np.ndarray], priors: list[Prior]) -> Fit:
        own = Unknown(f"own-{number}", Vector(3, ("x", "y", "z")), "m", (1.0, 2.0, 3.0))
        unknowns = (own, common)
        scales = np.array([1.0, 2.0, 3.0, 1.0, 10.0])
        root = np.vstack([np.column_stack([np.zeros((len(p.root), 3)), p.root]) for p in priors])
        target = np.concatenate([p.root @ p.mean for p in priors])
        design = designs[number]
        stacked = np.vstack([design, root])
        flat = np.linalg.lstsq(stacked, np.concatenate([measured[number], target]), rcond=None)[0]
        return Fit(Problem(unknowns, (), dict(values)), {own.name: flat[:3], "common": flat[3:]}, (), unknowns,
                   design @ flat - measured[number], design * scales, root * scales, root @ flat - target,
                   np.arange(len(design), dtype=float))

    starts = [fit_of(k, {f"own-{k}": np.zeros(3), "common": np.zeros(2)}, [assumed]) for k in range(3)]
    fits, others = fitted_together(
        starts, ["common"], lambda k, fit, known: fit_of(k, fit.values, [assumed, *known]))
    stacked = np.zeros((30 + 20 + 9 + 2, 11))
    for k, (design, at) in enumerate(zip(designs, (0, 30, 50), strict=True)):
        stacked[at : at + len(design), 3 * k : 3 * k + 3] = design[:, :3]
        stacked[at : at + len(design), 9:] = design[:, 3:]
    stacked[59:, 9:] = assumed.root
    joint = np.linalg.lstsq(stacked, np.concatenate([*measured, np.zeros(2)]), rcond=None)[0]
    expected = np.linalg.inv(stacked.T @ stacked)[9:, 9:]
    for k, fit in enumerate(fits):
        assert np.allclose(fit.values["common"], joint[9:], atol=1e-9)
        assert np.allclose(fit.values[f"own-{k}"], joint[3 * k : 3 * k + 3], atol=1e-9)
        assert np.allclose(fit.covariance()[3:, 3:], expected, rtol=1e-8)
        assert len(others[k]) == 2
    # What one arc tells does not depend on what it was told.
    alone = told(replace(fits[0], prior=fits[0].prior[:0], off=fits[0].off[:0]), ["common"])
    assert np.allclose(np.abs(alone.root), np.abs(told(fits[0], ["common"]).root), atol=1e-9)
