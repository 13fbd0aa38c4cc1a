"""The joint W3B solution by brahe's batch estimator, called by ``benchmarks.orbit_w3b --brahe``.

brahe's own measurement models take azimuth, elevation and range at one instant, without light time, air or biases to
estimate, so the task needs measurement models written by the user: here our own measurement functions with their
derivatives, called back from brahe sample by sample, and a callback that adds the polynomial acceleration. Unknowns:
position, velocity, constant and linear acceleration, range and angle biases of five stations (27). The drag
coefficient cannot be among them (brahe takes it from its parameters, which it does not estimate); the published
solution has nearly none, so drag is left out. brahe has no outlier filter; these data need none.
"""

from __future__ import annotations

import time
from typing import Any

import casadi as ca
import numpy as np

from estimator.models.light_time import Earth
from estimator.models.orbit_environment import eme2000_from_gcrs
from estimator.models.ranging import Antenna, Corrections, Signalling, predicted
from estimator.models.station import east_north_up, station_position
from problems.geo_orbit.problem import OrbitModel, orbit_model
from problems.geo_orbit.settings import OrbitSettings
from problems.geo_orbit.tracking import Tracking

CONSTANT, LINEAR = 1e-6, 1e-10  # m/s2, m/s3: one unit of the acceleration's unknowns
TURN = 1e-3  # rad, one unit of an angle's bias
SIZES = {"range": 1, "azimuth_elevation": 2}


def _functions() -> dict[str, ca.Function]:
    x, turn, pole = ca.SX.sym("x", 6), ca.SX.sym("i", 3, 3), ca.SX.sym("p", 3, 3)
    angle, place, axes, height = ca.SX.sym("a"), ca.SX.sym("s", 3), ca.SX.sym("e", 3, 3), ca.SX.sym("h")
    how = Signalling("reception", "half", troposphere=True, bending=True)
    antenna, earth = Antenna(place, axes, height), Earth(turn, angle, pole)
    found = {}
    for kind in SIZES:
        z = predicted(kind, x, earth, antenna, antenna, how, Corrections(), same=True)  # type: ignore[arg-type]
        found[kind] = ca.Function(kind, [x, turn, angle, pole, place, axes, height], [z, ca.jacobian(z, x)])
    return found


def _models(brahe: Any, model: OrbitModel, epoch: Any, size: int) -> tuple[list[Any], dict[tuple[str, str], int]]:
    """One measurement model of brahe for every station and kind, and its place in the list."""
    functions = _functions()
    s = model.settings

    class Seen(brahe.MeasurementModel):  # type: ignore[misc]
        def __init__(self, kind: str, number: int, station: Any) -> None:
            super().__init__()
            self.kind, self.number, self.station = kind, number, station
            self.fixed = (
                station_position(station.latitude, station.longitude, station.altitude),
                east_north_up(station.latitude, station.longitude),
                station.altitude,
            )
            self.orientation: dict[float, tuple[Any, ...]] = {}

        def both(self, moment: Any, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            t = round((moment - epoch) * 1e6) / 1e6
            if t not in self.orientation:
                self.orientation[t] = tuple(p[0] for p in model.environment.orientation_parts(np.array([t])))
            z, h = functions[self.kind](state[:6], *self.orientation[t], *self.fixed)
            value, slope = np.asarray(z).ravel(), np.zeros((SIZES[self.kind], size))
            slope[:, :6] = np.asarray(h)
            first = 12 + 3 * self.number
            if self.kind == "range":
                slope[0, first] = 1.0
                return value + state[first] + s.onboard_range_bias, slope
            slope[[0, 1], [first + 1, first + 2]] = TURN
            return value + TURN * state[first + 1 : first + 3], slope

        def predict(self, moment: Any, state: Any, params: Any = None) -> np.ndarray:
            return self.both(moment, np.asarray(state))[0]

        def jacobian(self, moment: Any, state: Any, params: Any = None) -> np.ndarray:
            return self.both(moment, np.asarray(state))[1]

        def noise_covariance(self) -> np.ndarray:
            sigma = {**s.sigma, **self.station.sigma}
            names = ("range",) if self.kind == "range" else ("azimuth", "elevation")
            return np.diag([sigma[n] ** 2 for n in names])

        def measurement_dim(self) -> int:
            return SIZES[self.kind]

        def name(self) -> str:
            return f"{self.kind} {self.station.name}"

        def residual(self, measured: Any, expected: Any) -> np.ndarray:
            gap = np.asarray(measured) - np.asarray(expected)
            if self.kind != "range":
                gap[0] = np.mod(gap[0] + np.pi, 2 * np.pi) - np.pi
            return gap

    models, places = [], {}
    for number, station in enumerate(s.stations.values()):
        for kind in SIZES:
            places[kind, station.name] = len(models)
            models.append(Seen(kind, number, station))
    return models, places


def solved(tracking: Tracking, settings: OrbitSettings) -> dict[str, Any]:
    """One solution: state in EME2000, constant acceleration, residuals, iterations and times.

    The time is that of brahe's solution alone, from prepared observations.
    """
    import brahe

    brahe.initialize_eop()
    model = orbit_model(tracking, settings)
    stations = list(settings.stations.values())
    size = 12 + 3 * len(stations)
    epoch = brahe.Epoch(*_calendar(settings), time_system=brahe.TimeSystem.UTC)
    models, places = _models(brahe, model, epoch, size)
    rows = sorted(
        (float(t), places[o.kind, o.receiver], v)
        for o in tracking.observations
        for t, v in zip(model.seconds(o.time), o.value.tolist(), strict=True)
    )
    observations = [brahe.Observation(epoch + t, np.array(v), model_index=i) for t, i, v in rows]
    start = np.zeros(size)
    start[:6] = [*model.position, *model.velocity]
    for i, s in enumerate(stations):
        angles = [s.bias.get(k, 0.0) / TURN for k in ("azimuth", "elevation")]
        start[12 + 3 * i : 15 + 3 * i] = [s.bias.get("range", 0.0), *angles]
    spread = np.array([1e5] * 3 + [1e2] * 9 + [1e4, 1e1, 1e1] * len(stations))  # wide: no prior knowledge

    def extra(t: float, state: Any, params: Any) -> np.ndarray:
        slope = np.zeros(size)
        slope[3:6] = CONSTANT * state[6:9] + LINEAR * t * state[9:12]
        return slope

    assert settings.reflection
    value = brahe.ParameterSource.value
    sources = (brahe.ThirdBody.SUN, brahe.ThirdBody.MOON)
    force = brahe.ForceModelConfig(
        gravity=brahe.GravityConfiguration.spherical_harmonic(settings.degree, settings.order),
        srp=brahe.SolarRadiationPressureConfiguration(
            area=value(settings.area), cr=value(settings.reflection[0]), eclipse_model=brahe.EclipseModel.CONICAL
        ),
        third_body=[brahe.ThirdBodyConfiguration(b, brahe.EphemerisSource.LowPrecision) for b in sources],
        mass=value(settings.mass),
    )
    estimator = brahe.BatchLeastSquares(
        epoch,
        start,
        np.diag(spread**2),
        propagation_config=brahe.NumericalPropagationConfig.default(),
        force_config=force,
        measurement_models=models,
        config=brahe.BLSConfig(max_iterations=10, state_correction_threshold=1e-3, cost_convergence_threshold=1e-3),
        additional_dynamics=extra,
    )
    began, cpu = time.perf_counter(), time.process_time()
    estimator.solve(observations)
    seconds, cpu_seconds = time.perf_counter() - began, time.process_time() - cpu
    state = np.asarray(estimator.current_state())
    turn = eme2000_from_gcrs()
    gaps: dict[str, list[np.ndarray]] = {kind: [] for kind in SIZES}
    last = estimator.observation_residuals()[-1]
    for residual in last:
        gap = np.asarray(residual.postfit_residual)
        gaps["range" if len(gap) == 1 else "azimuth_elevation"].append(gap)
    return {
        "state": np.concatenate([turn @ state[:3], turn @ state[3:6]]),
        "constant_acceleration": CONSTANT * state[6:9],
        "residuals": {kind: np.array(v) for kind, v in gaps.items()},
        "unknowns": size,
        "iterations": estimator.iterations_completed(),
        "converged": bool(estimator.converged()),
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
    }


def _calendar(settings: OrbitSettings) -> tuple[int, int, int, int, int, float]:
    """Year, month, day, hour, minute and second of the settings' epoch, UTC."""
    assert settings.epoch is not None
    date, clock = settings.epoch.rstrip("Z").split("T")
    year, month, day = (int(p) for p in date.split("-"))
    hour, minute, second = clock.split(":")
    return year, month, day, int(hour), int(minute), float(second)
