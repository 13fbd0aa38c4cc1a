"""The book's system: the filters' mathematics, divergence of the linear one, the batch and the smoother at the
bound."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.solvers import recursive_filters as filters
from problems.geo_orbit.book import SIZE, BookCase, BookSystem, cramer_rao, position_errors, simulate
from problems.geo_orbit.book_batch import batch_bound, batch_estimate, batch_problem, stacked


class LinearSystem:
    """A small linear system with process noise, where every filter must agree with the joint Gaussian posterior."""

    size, steps = 3, 12
    measurement_covariance = np.diag([0.04, 0.09])
    _phi = np.array([[1.0, 0.5, 0.1], [0.0, 0.9, 0.5], [0.0, 0.0, 0.8]])
    _h = np.array([[1.0, 0.0, 0.0], [0.3, 1.0, 0.0]])
    _q = np.diag([0.0, 0.0, 0.05])

    def propagate(self, k: int, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return state @ self._phi.T, np.broadcast_to(self._phi, (len(state), 3, 3))

    def process_noise(self, k: int) -> np.ndarray:
        return self._q

    def observe(self, k: int, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return state @ self._h.T, np.broadcast_to(self._h, (len(state), 2, 3))


@pytest.fixture(scope="module")
def linear_case() -> tuple[LinearSystem, np.ndarray, np.ndarray, np.ndarray]:
    system = LinearSystem()
    random = np.random.default_rng(4)
    first, covariance = np.array([1.0, -2.0, 0.5]), np.diag([1.0, 0.5, 2.0])
    x = first + random.standard_normal((5, 3)) * np.sqrt(np.diag(covariance))
    z = np.empty((5, system.steps, 2))
    for k in range(system.steps):
        x = system.propagate(k, x)[0] + random.standard_normal((5, 3)) * np.sqrt(np.diag(system.process_noise(k)))
        z[:, k] = system.observe(k, x)[0] + random.standard_normal((5, 2)) * [0.2, 0.3]
    return system, first, covariance, z


def joint_posterior(
    system: LinearSystem, first: np.ndarray, covariance: np.ndarray, z: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean (runs, steps + 1, 3) and covariance blocks (steps + 1, 3, 3) from the one big Gaussian, no recursion."""
    n = system.steps + 1
    mean, big = np.empty((n, 3)), np.zeros((3 * n, 3 * n))
    mean[0], big[:3, :3] = first, covariance
    for k in range(system.steps):
        a, b = slice(3 * k, 3 * k + 3), slice(3 * k + 3, 3 * k + 6)
        mean[k + 1] = system._phi @ mean[k]
        big[b, : 3 * k + 3] = system._phi @ big[a, : 3 * k + 3]
        big[: 3 * k + 3, b] = big[b, : 3 * k + 3].T
        big[b, b] = system._phi @ big[a, a] @ system._phi.T + system.process_noise(k)
    h = np.zeros((2 * system.steps, 3 * n))
    for k in range(system.steps):
        h[2 * k : 2 * k + 2, 3 * k + 3 : 3 * k + 6] = system._h
    r = np.kron(np.eye(system.steps), system.measurement_covariance)
    gain = big @ h.T @ np.linalg.inv(h @ big @ h.T + r)
    after = big - gain @ h @ big
    innovation = z.reshape(len(z), -1) - h @ mean.ravel()
    posterior = mean.ravel() + innovation @ gain.T
    blocks = np.stack([after[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(n)])
    return posterior.reshape(len(z), n, 3), blocks


def test_every_filter_equals_the_joint_posterior_of_a_linear_system(linear_case) -> None:  # type: ignore[no-untyped-def]
    system, first, covariance, z = linear_case
    mean, blocks = joint_posterior(system, first, covariance, z)
    nominal = [first]
    for _ in range(system.steps):
        nominal.append(system._phi @ nominal[-1])
    runs = [
        filters.linear_filter(system, np.array(nominal), system._phi, first, covariance, z),
        filters.extended_filter(system, first, covariance, z),
        filters.extended_filter(system, first, covariance, z, iterations=3),
        filters.square_root_filter(system, first, covariance, z),
        filters.unscented_filter(system, first, covariance, z),
        filters.schmidt_filter(system, first, covariance, z, []),
    ]
    for run in runs:
        assert run.state[:, -1] == pytest.approx(mean[:, -1], abs=1e-9), run.name
        assert run.covariance[0] == pytest.approx(blocks[-1], abs=1e-9), run.name
    smoothed = filters.smoothed(filters.extended_filter(system, first, covariance, z, keep=True))
    assert smoothed.state == pytest.approx(mean, abs=1e-9)
    assert smoothed.covariance[0] == pytest.approx(blocks[0], abs=1e-9)
    iterated = filters.iterated_smoother(system, first, covariance, z)
    assert iterated.state == pytest.approx(mean, abs=1e-9)


def test_considered_components_are_not_touched_and_widen_the_rest(linear_case) -> None:  # type: ignore[no-untyped-def]
    system, first, covariance, z = linear_case
    full = filters.extended_filter(system, first, covariance, z)
    run = filters.schmidt_filter(system, first, covariance, z, [2])
    untouched = first[2] * 0.8 ** np.arange(system.steps + 1)
    assert run.state[:, :, 2] == pytest.approx(np.broadcast_to(untouched, run.state.shape[:2]))
    assert (run.sigma[:, -1, :2] > full.sigma[:, -1, :2]).all()


def test_divergence_is_said_where_the_noise_is_underrated(linear_case) -> None:  # type: ignore[no-untyped-def]
    system, first, covariance, z = linear_case
    honest = filters.extended_filter(system, first, covariance, z)
    assert not honest.diverged().any() and "agree" in honest.sentence()
    sure = filters.extended_filter(system, first + 5.0, covariance * 1e-6, z)
    assert sure.diverged().all() and "diverged in 5 of 5" in sure.sentence()


@pytest.fixture(scope="module")
def system() -> BookSystem:
    return BookSystem(BookCase(step=300.0, burn=(20000.0, 23600.0)))


def test_jacobians_of_the_book_equal_finite_differences(system: BookSystem) -> None:
    x = system.case.first_state[None] * 1.0
    x[0, 6] = 1e-5
    unit = np.maximum(system.case.prior, 1e-12) * 1e-3
    for k in (0, 70):
        _, phi = system.propagate(k, x)
        _, h = system.observe(k, x)
        for i in range(SIZE):
            step = np.zeros(SIZE)
            step[i] = unit[i]
            for function, exact in ((system.propagate, phi), (system.observe, h)):
                numeric = (function(k, x + step)[0] - function(k, x - step)[0])[0] / (2 * unit[i])
                scale = (
                    np.abs(exact[0]).max(axis=1) * 1e-5
                    + np.abs(numeric) * 1e-4
                    + 1e-10 / unit[i] * np.abs(function(k, x)[0][0])
                )
                assert (np.abs(numeric - exact[0, :, i]) <= scale + 1e-12).all()


def elements(state: np.ndarray) -> tuple[float, ...]:
    """Eccentricity, inclination, node, perigee argument and true anomaly (rad) of a state, by its own vectors."""
    import casadi as ca

    from estimator.models.orbit_spherical import cartesian_from_spherical

    cartesian = np.asarray(ca.DM(cartesian_from_spherical(ca.DM(state[:6])))).ravel()
    r, v = cartesian[:3], cartesian[3:]
    h = np.cross(r, v)
    node = np.cross([0.0, 0.0, 1.0], h)
    e = np.cross(v, h) / 3.986004418e14 - r / np.linalg.norm(r)  # m3/s2 of the Earth

    def angle(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.mod(np.arctan2(np.cross(a, b) @ h / np.linalg.norm(h), a @ b), 2 * np.pi))

    tilt = np.arctan2(np.hypot(h[0], h[1]), h[2])
    return float(np.linalg.norm(e)), float(tilt), float(np.arctan2(node[1], node[0])), angle(node, e), angle(e, r)


RADIANS, DEGREES = (0.03, 1.3, 0.4, 4.3), tuple(np.radians([0.03, 1.3, 0.4, 4.3]))


@pytest.mark.parametrize("perigee", [True, False])
@pytest.mark.parametrize(
    ("reading", "printed"),
    [
        ({}, RADIANS),
        ({"inclination_in_degrees": True}, (DEGREES[0], *RADIANS[1:])),
        ({"angles_in_degrees": True}, DEGREES),
    ],
)
def test_the_printed_orbit_is_read_every_way(
    reading: dict[str, bool], printed: tuple[float, ...], perigee: bool
) -> None:
    case = BookCase(perigee_argument=perigee, **reading)  # type: ignore[arg-type]
    eccentricity, tilt, node, argument, anomaly = elements(case.first_state)
    assert (eccentricity, tilt, node, anomaly) == pytest.approx((0.005, printed[0], printed[1], printed[3]), rel=1e-6)
    # as the argument of latitude 0.4 is perigee and anomaly together
    read = argument if perigee else np.mod(argument + anomaly, 2 * np.pi)
    assert read == pytest.approx(printed[2], abs=1e-7)


def test_the_filters_follow_every_reading_of_the_printed_orbit() -> None:
    for reading in (
        {"perigee_argument": False},
        {"inclination_in_degrees": True},
        {"angles_in_degrees": True, "perigee_argument": False},
    ):
        system = BookSystem(BookCase(step=240.0, **reading))  # type: ignore[arg-type]
        case, simulated = system.case, simulate(system, 3, 4)
        run = filters.extended_filter(
            system, case.first_state, np.diag(case.prior**2), simulated.measurements, iterations=4
        )
        error = position_errors(case, simulated.truth, run.state)[:, -1]
        sigma = np.linalg.norm(run.sigma[:, -1, :3] * [1.0, case.radius, case.radius], axis=1)
        assert not run.diverged().any() and (error < 5 * sigma).all()


def test_prior_sigma_of_the_period_is_the_printed_850_seconds() -> None:
    case = BookCase()
    random = np.random.default_rng(5)
    x = case.first_state + random.standard_normal((20000, SIZE)) * case.prior
    r, speed2 = x[:, 0], x[:, 3] ** 2 + (x[:, 0] * x[:, 4]) ** 2 * np.cos(x[:, 2]) ** 2 + (x[:, 0] * x[:, 5]) ** 2
    axis = 1 / (2 / r - speed2 / 3.986004418e14)
    period = 2 * np.pi * np.sqrt(axis**3 / 3.986004418e14)
    assert period.std() == pytest.approx(850, rel=0.1)


def test_linear_filter_diverges_and_iterated_extended_filter_does_not() -> None:
    case = BookCase(step=240.0)
    system = BookSystem(case)
    simulated = simulate(system, 4, 2, kind="exact")
    first, covariance = case.first_state, np.diag(case.prior**2)
    nominal, matrices = system.stationary_motion()
    scale = np.array([1.0, case.radius, case.radius])

    def over_sigma(run: filters.FilterRun) -> float:
        error = position_errors(case, simulated.truth, run.state)[:, -1]
        return float(np.median(error / np.linalg.norm(run.sigma[:, -1, :3] * scale, axis=1)))

    linear = filters.linear_filter(system, nominal, matrices, first, covariance, simulated.measurements)
    assert over_sigma(linear) > 100 and linear.diverged().all()
    iterated = filters.extended_filter(system, first, covariance, simulated.measurements, iterations=4)
    assert over_sigma(iterated) < 2.5 and not iterated.diverged().any()
    root = filters.square_root_filter(system, first, covariance, simulated.measurements, iterations=4)
    assert root.state[:, -1] == pytest.approx(iterated.state[:, -1], rel=1e-6, abs=1e-6)


def test_joint_batch_reaches_the_bound_and_equals_the_smoother(system: BookSystem) -> None:
    runs = 24
    simulated = simulate(system, runs, 11)
    ratios, normalized = [], []
    case = system.case
    estimates = []
    for r in range(runs):
        estimate = batch_estimate(system, simulated.measurements[r])
        error = stacked(estimate) - simulated.truth[r, 0]
        estimates.append(stacked(estimate))
        ratios.append(error**2 / np.diag(batch_bound(system, simulated.truth[r, 0])))
        unit = case.prior
        normalized.append(error / unit @ np.linalg.solve(estimate.covariance / np.outer(unit, unit), error / unit))
    assert float(np.sqrt(np.mean(ratios))) == pytest.approx(1.0, abs=0.16)  # 336 squares, 4 sigma
    assert float(np.mean(normalized)) / SIZE == pytest.approx(1.0, abs=4 * np.sqrt(2 / (SIZE * runs)))
    smoother = filters.iterated_smoother(
        system, case.first_state, np.diag(case.prior**2), simulated.measurements[:3], passes=12, tolerance=1e-5
    )
    gap = np.abs(smoother.state[:, 0] - np.array(estimates[:3])) / smoother.sigma[:, 0]
    assert gap.max() < 0.02


def test_bound_of_the_engine_equals_the_bound_by_recursion(system: BookSystem) -> None:
    simulated = simulate(system, 1, 3)
    one, two = cramer_rao(system, simulated.truth[0]), batch_bound(system, simulated.truth[0, 0])
    assert np.sqrt(np.diag(one)) == pytest.approx(np.sqrt(np.diag(two)), rel=1e-4)


def test_without_a_burn_the_thrust_error_is_held_and_without_prior_the_rest_is_named() -> None:
    quiet = BookSystem(BookCase(step=600.0))
    simulated = simulate(quiet, 1, 3)
    problem = batch_problem(quiet, simulated.measurements[0], with_prior=False)
    assert "thrust_error" in problem.held
    from estimator.solvers import solve

    estimate = solve(problem.starting_at({"orbit": simulated.truth[0, 0, :6]}))
    named = " ".join(w.sentence for w in estimate.weak)
    assert "station" in named and "systematic_errors" in named and str(estimate.status) == "unobservable"
