"""Designed campaigns, measured: bounds against reference sessions, and errors of simulated and solved campaigns.

    python -m benchmarks.campaign_design [--quick] [--campaigns N] [--studies bounds,session,duration,rotation]
        [--results FILE.json]

Studies: ``bounds`` (the designed ten-minute session, criteria A, D and E, against 200 drawn reference sessions of the
published experiment at equal duration and slew limits, and against the bound of any session), ``session`` (the same
session and the reference flown in simulated campaigns of equal seeds, each solved by the joint estimate), ``duration``
(what a minute brings), ``rotation`` (free arcs and torque pulses: designed against drawn, by bound and by simulation).
Each study replaces its own part of the results file.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from estimator.models.files import written_atomically
from estimator.unknowns import UnitQuaternion
from problems.alignment.campaign_design import criterion_value
from problems.alignment.campaign_design_rotation import design_rotation, rotation_request_of
from problems.alignment.campaign_design_session import (
    SessionDesign,
    SessionRequest,
    SlewLimits,
    design_session,
    request_of,
    session_information,
)
from problems.alignment.simulation.scenario import Scenario
from problems.alignment.simulator import preset, simulate
from problems.alignment.solution import solve_campaign

ARCSECONDS = float(np.degrees(3600.0))  # in a radian
RESULTS = Path(__file__).resolve().parent / "results" / "campaign_design.json"
NAMES = ("base", "good", "bad-short", "small-slews")


def reference_angles(scenario: Scenario, request: SessionRequest, draw: np.random.Generator) -> np.ndarray:
    """Profile (n, 3) rad of one drawn reference session: a sine on each axis, period and phase drawn."""
    period, phase = draw.uniform(*scenario.slew_period, 3), draw.uniform(0.0, 2.0 * np.pi, 3)
    return np.asarray(scenario.slew_amplitude) * np.sin(2 * np.pi * request.epochs[:, None] / period + phase)


def _total(information: np.ndarray) -> float:
    return float(np.sqrt(criterion_value("A", information))) * ARCSECONDS


def _described(design: SessionDesign) -> dict[str, Any]:
    root = design.criterion != "D"
    return {
        "criterion": design.criterion, "total_arcsec": design.sigma * ARCSECONDS,
        "axes_arcsec": (np.sqrt(np.diag(design.covariance)) * ARCSECONDS).tolist(),
        "value": float(np.sqrt(design.value)) * ARCSECONDS if root else design.value,
        "no_session_below": float(np.sqrt(design.bound)) * ARCSECONDS if root else design.bound,
        "starts": [float(np.sqrt(v)) * ARCSECONDS if root else v for v in design.starts],
        "excess_over_limits": design.largest_excess, "seconds": design.seconds,
        "coefficients_deg": np.degrees(design.coefficients).tolist(),
    }


def bounds(quick: bool) -> list[dict[str, Any]]:
    """Designed sessions against 200 drawn reference sessions, for the published settings."""
    rows = []
    for name in NAMES[:1] if quick else NAMES:
        scenario = preset(name)
        draw = np.random.default_rng(0)
        request = request_of(scenario)
        drawn = [session_information(request, reference_angles(scenario, request, draw)) for _ in range(200)]
        totals = np.array([_total(i) for i in drawn])
        for label, period in (("slowest reference", scenario.slew_period[1]),
                              ("fastest reference", scenario.slew_period[0])):
            limited = replace(request, limits=SlewLimits.of_sines(scenario.slew_amplitude, period))
            for criterion in ("A", "D", "E") if name == "base" and not quick else ("A",):
                design = design_session(limited, criterion)  # type: ignore[arg-type]
                reference = [criterion_value(criterion, i) for i in drawn]  # type: ignore[arg-type]
                rows.append({"preset": name, "limits_of": label, **_described(design),
                             "reference_rms_arcsec": float(np.sqrt(np.mean(totals**2))),
                             "reference_best_arcsec": float(totals.min()),
                             "reference_worst_arcsec": float(totals.max()),
                             "reference_sessions_worse": int(np.sum(np.array(reference) > design.value)),
                             "reference_sessions": len(totals)})
                print({k: v for k, v in rows[-1].items() if k != "coefficients_deg"}, flush=True)
    return rows


def session(quick: bool, campaigns: int) -> list[dict[str, Any]]:
    """Reference and designed session in simulated campaigns of the same seeds, solved by the joint estimate."""
    rows = []
    for name in ("base",):
        plain = preset(name, free_arcs=0, pulse_axes=(), duration=5400.0)
        # The limits of the slowest reference session: no drawn one turns more gently on any axis.
        design = design_session(request_of(plain))
        profile = _rows(design.coefficients)
        flown = {"reference": plain, "designed": replace(plain, slew_profile=profile)}
        errors: dict[str, list[np.ndarray]] = {k: [] for k in flown}
        covariances: dict[str, list[np.ndarray]] = {k: [] for k in flown}
        began = time.perf_counter()
        for seed in range(campaigns):
            for label, scenario in flown.items():
                campaign, truth = simulate(scenario, seed)
                solution = solve_campaign(campaign)
                assert solution.antenna_from_tracker is not None
                errors[label].append(UnitQuaternion().local(truth.antenna_from_tracker, solution.antenna_from_tracker))
                covariances[label].append(solution.estimate.covariance_of("antenna_from_tracker"))
        row: dict[str, Any] = {"preset": name, "campaigns": campaigns, "predicted_arcsec": design.sigma * ARCSECONDS,
                               "seconds": time.perf_counter() - began}
        squares = {}
        for label in flown:
            error, covariance = np.array(errors[label]) * ARCSECONDS, np.array(covariances[label]) * ARCSECONDS**2
            squares[label] = np.sum(error**2, axis=1)
            row[label] = {
                "rmse_arcsec": float(np.sqrt(squares[label].mean())),
                "rmse_axes_arcsec": np.sqrt((error**2).mean(axis=0)).tolist(),
                "bound_arcsec": float(np.sqrt(np.trace(covariance.mean(axis=0)))),
                "bound_axes_arcsec": np.sqrt(np.diag(covariance.mean(axis=0))).tolist(),
                "normalized_error_squared": float(np.mean(np.einsum(
                    "ni,nij,nj->n", error, np.linalg.inv(covariance), error)) / 3),
            }
        own = {k: np.array([np.trace(c) for c in v]) for k, v in covariances.items()}
        row["bound_smaller_in"] = int(np.sum(own["designed"] < own["reference"]))
        # Bootstrap over seeds, both sessions of a seed together.
        pick = np.random.default_rng(1).integers(0, campaigns, (4000, campaigns))
        ratio = np.sqrt(squares["designed"][pick].mean(axis=1) / squares["reference"][pick].mean(axis=1))
        row["rmse_ratio"] = row["designed"]["rmse_arcsec"] / row["reference"]["rmse_arcsec"]
        row["rmse_ratio_95_percent"] = np.quantile(ratio, [0.025, 0.975]).tolist()
        row["bound_ratio"] = row["designed"]["bound_arcsec"] / row["reference"]["bound_arcsec"]
        rows.append(row)
        print(row, flush=True)
    return rows


def duration(quick: bool) -> list[dict[str, Any]]:
    """Bound of the antenna against the length of the session, same slew limits."""
    rows = []
    scenario = preset("base")
    for minutes in (5.0, 10.0) if quick else (3.0, 5.0, 7.5, 10.0, 15.0, 20.0, 30.0):
        request = request_of(scenario, duration=60.0 * minutes)
        draw = np.random.default_rng(0)
        drawn = [criterion_value("A", session_information(request, reference_angles(scenario, request, draw)))
                 for _ in range(100)]
        design = design_session(request)
        rows.append({"minutes": minutes, "designed_arcsec": design.sigma * ARCSECONDS,
                     "designed_arcsec_root_minute": design.sigma * ARCSECONDS * np.sqrt(minutes),
                     "no_session_below_arcsec": float(np.sqrt(design.bound)) * ARCSECONDS,
                     "reference_rms_arcsec": float(np.sqrt(np.mean(drawn))) * ARCSECONDS})
        print(rows[-1], flush=True)
    return rows


def principal_turn(true: np.ndarray, found: np.ndarray) -> np.ndarray:
    """Small rotation (3, rad) from the true to the found principal axes, about the true axes, by rising moment."""
    (_, axes), (_, others) = np.linalg.eigh(true), np.linalg.eigh(found)
    coupling = axes.T @ (others * np.sign(np.sum(axes * others, axis=0)))
    skew = 0.5 * (coupling - coupling.T)
    return np.array([skew[2, 1], skew[0, 2], skew[1, 0]])


def rotation(quick: bool, campaigns: int) -> list[dict[str, Any]]:
    """Drawn free arcs and single-axis pulses against designed ones: bound, and simulated campaigns that are solved."""
    rows = []
    for name in ("base",) if quick else ("base", "reference"):
        scenario = preset(name, doppler_sessions=0, gnss_step=10.0)
        arcs = scenario.free_arcs * (scenario.free_duration + scenario.free_spacing) + \
            len(scenario.pulse_axes) * (scenario.pulse_duration + scenario.pulse_spacing)
        scenario = replace(scenario, duration=arcs + 1200.0)
        request = rotation_request_of(scenario)
        design = design_rotation(request)
        flown = {"reference": scenario, "designed": replace(
            scenario, free_initial_rates=_rows(design.free_rates), pulse_segments=design.pulse_shape,
            pulse_directions=_rows(design.pulse_torques))}
        row: dict[str, Any] = {
            "preset": name, "campaigns": campaigns, "minutes": design.minutes, "design_seconds": design.seconds,
            "predicted_axes_arcsec": design.axes_sigma * ARCSECONDS,
            "predicted_actuator_arcsec": design.actuator_sigma * ARCSECONDS,
            "no_choice_below_arcsec": float(np.sqrt(design.bound)) * ARCSECONDS,
            "total_arcsec": float(np.sqrt(design.value)) * ARCSECONDS,
            "free_rates_deg_s": np.degrees(design.free_rates).tolist(), "pulse_shape": design.pulse_shape,
            "pulse_torques_n_m": design.pulse_torques.tolist(), "criterion_without": design.arc_values}
        for label, flight in flown.items():
            axes, actuator, bound = [], [], []
            for seed in range(campaigns):
                campaign, truth = simulate(flight, seed)
                solution = solve_campaign(campaign)
                assert solution.actuator_from_tracker is not None and solution.normalized_inertia is not None
                axes.append(principal_turn(truth.normalized_inertia, solution.normalized_inertia))
                actuator.append(UnitQuaternion().local(truth.actuator_from_tracker, solution.actuator_from_tracker))
                bound.append(np.trace(solution.estimate.covariance_of("actuator_from_tracker")))
            row[label] = {"rmse_axes_arcsec": float(np.sqrt(3 * np.mean(np.square(axes)))) * ARCSECONDS,
                          "rmse_actuator_arcsec": float(np.sqrt(3 * np.mean(np.square(actuator)))) * ARCSECONDS,
                          "bound_actuator_arcsec": float(np.sqrt(np.mean(bound))) * ARCSECONDS}
        rows.append(row)
        print(row, flush=True)
    return rows


def _rows(values: np.ndarray) -> tuple[tuple[float, float, float], ...]:
    return tuple((float(a), float(b), float(c)) for a, b, c in values)


def main() -> None:
    """Run the studies and write their results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--campaigns", type=int, default=100)
    parser.add_argument("--studies", default="bounds,duration,rotation,session")
    parser.add_argument("--results", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    studies = {"bounds": lambda: bounds(arguments.quick), "duration": lambda: duration(arguments.quick),
               "session": lambda: session(arguments.quick, 4 if arguments.quick else arguments.campaigns),
               "rotation": lambda: rotation(arguments.quick, 4 if arguments.quick else arguments.campaigns)}
    results = json.loads(arguments.results.read_text()) if arguments.results.exists() else {}
    for name in arguments.studies.split(","):
        results[name] = studies[name]()
        with written_atomically(arguments.results) as temporary:
            temporary.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
