"""``boresight design``: which manoeuvres, free rotations and pulses make the alignment best known per minute."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from problems import console

if TYPE_CHECKING:
    from problems.alignment.campaign_design import Criterion
    from problems.alignment.campaign_design_rotation import RotationDesign
    from problems.alignment.campaign_design_session import SessionDesign, SessionRequest, SlewLimits
    from problems.alignment.simulation.scenario import Scenario

ARCSECONDS = 206264.80624709636  # in a radian
Triple = tuple[float, float, float]


def design(
    file: Annotated[Path | None, typer.Argument(
        help="Campaign file whose next session is asked for: its sensors, orbit and beams, and what it determines "
             "already. Without one, the campaign of --preset.")] = None,
    preset: Annotated[str, typer.Option(help="Named campaign of `boresight simulate`.")] = "base",
    part: Annotated[str, typer.Option(help="session (Doppler), rotation (free arcs and pulses) or both.")] = "session",
    criterion: Annotated[str, typer.Option(help="A: trace of the covariance, D: its determinant, E: its worst "
                                                "direction.")] = "A",
    minutes: Annotated[float | None, typer.Option(help="Length of the session [min].")] = None,
    angle_limit: Annotated[Triple | None, typer.Option(
        help="Largest angles about antenna x, y, z from the look direction [deg].", metavar="X Y Z")] = None,
    rate_limit: Annotated[Triple | None, typer.Option(help="Largest rates of these angles [deg/s].",
                                                      metavar="X Y Z")] = None,
    acceleration_limit: Annotated[Triple | None, typer.Option(help="Largest accelerations [deg/s2].",
                                                              metavar="X Y Z")] = None,
    period: Annotated[float, typer.Option(
        help="Rates and accelerations no larger than those of sines of this period [s].")] = 600.0,
    look_angle: Annotated[float | None, typer.Option(help="Roll of antenna +z from nadir [deg].")] = None,
    latitude: Annotated[float, typer.Option(help="Argument of latitude at the start, for --preset [deg].")] = 0.0,
    starts: Annotated[int, typer.Option(help="Starts of the optimiser.")] = 6,
    out: Annotated[Path | None, typer.Option(help="Write the design as JSON, with the profile every second.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Machine-readable answer on standard output.")] = False,
) -> None:
    """Design a Doppler session, free rotations and torque pulses on the joint problem's information matrix."""

    def work() -> tuple[dict[str, Any], Callable[[], object]]:
        return _design(file, preset, part, criterion, minutes, (angle_limit, rate_limit, acceleration_limit), period,
                       look_angle, latitude, starts, out)

    console.run(work, as_json=as_json)


def _design(file: Path | None, preset_name: str, part: str, criterion_name: str, minutes: float | None,
            limits: tuple[Triple | None, Triple | None, Triple | None], period: float, look_angle: float | None,
            latitude: float, starts: int, out: Path | None) -> tuple[dict[str, Any], Callable[[], object]]:
    from estimator.models.errors import RequestError
    from estimator.models.files import written_atomically
    from problems.alignment.campaign_design import checked_criterion
    from problems.alignment.simulator import preset

    began = time.perf_counter()
    if part not in ("session", "rotation", "both"):
        raise RequestError(f"no part of a campaign is named {part!r}", where="--part",
                           limit="session, rotation or both")
    if minutes is not None and not minutes > 0:
        raise RequestError("a session has some length", where="--minutes", value=minutes, limit="more than 0")
    if not period > 0:
        raise RequestError("a period is more than 0", where="--period", value=period, limit="more than 0 s")
    criterion = checked_criterion(criterion_name)
    scenario = preset(preset_name)
    result: dict[str, Any] = {"status": "ok", "why": "", "criterion": criterion}
    sentences, lines = [], []
    if part in ("session", "both"):
        answer, told, table = _session(file, scenario, criterion, minutes, _limits(scenario, limits, period),
                                       look_angle, latitude, starts)
        result["session"] = answer
        sentences.append(told)
        lines += table
    if part in ("rotation", "both"):
        if file is not None:
            raise RequestError("rotation arcs are designed for a named campaign", where="--part", value=part,
                               remedy="leave the file out and give --preset")
        answer, told, table = _rotation(scenario, criterion)
        result["rotation"] = answer
        sentences.append(told)
        lines += table
    result["why"] = "; ".join(sentences)
    result["seconds"] = time.perf_counter() - began
    if out is not None:
        with written_atomically(out) as temporary:
            temporary.write_text(json.dumps(console.jsonable(result), indent=1) + "\n", encoding="utf-8")
    return result, lambda: "\n".join([result["why"], "", *lines, "", f"{result['seconds']:.1f} s"])


def _limits(scenario: Scenario, given: tuple[Triple | None, Triple | None, Triple | None],
            period: float) -> SlewLimits:
    import numpy as np

    from problems.alignment.campaign_design_session import SlewLimits

    angle = scenario.slew_amplitude if given[0] is None else tuple(np.radians(given[0]))
    sines = SlewLimits.of_sines(angle, period)
    rate, acceleration = (tuple(float(x) for x in np.radians(g)) if g is not None else s
                          for g, s in zip(given[1:], (sines.rate, sines.acceleration), strict=True))
    return SlewLimits(sines.angle, rate, acceleration)  # type: ignore[arg-type]


def _session(file: Path | None, scenario: Scenario, criterion: Criterion, minutes: float | None, limits: SlewLimits,
             look_angle: float | None, latitude: float,
             starts: int) -> tuple[dict[str, Any], str, list[str]]:
    from dataclasses import replace

    import numpy as np

    from problems.alignment.campaign_design_session import design_session, request_of, request_of_campaign

    length = None if minutes is None else 60.0 * minutes
    look = None if look_angle is None else np.array([np.radians(look_angle), 0.0, 0.0])
    request: SessionRequest
    if file is not None:
        from problems.alignment.solution import solve_campaign
        from problems.readers.campaign_file import read_campaign

        campaign = read_campaign(file)
        solution = solve_campaign(campaign)
        known, prior = solution.antenna_from_tracker, None
        if known is not None:
            covariance = solution.estimate.covariance_of("antenna_from_tracker")
            # Directions that the campaign left open have infinite variance: no information from them.
            prior = np.linalg.inv(covariance) if np.all(np.isfinite(covariance)) else None
        request = request_of_campaign(campaign, limits, length or 600.0, look_angles=look,
                                      antenna_from_tracker=known, prior=prior)
    else:
        request = request_of(scenario, limits, duration=length, argument_of_latitude=float(np.radians(latitude)))
        if look is not None:
            request = replace(request, look_angles=look)
    found = design_session(request, criterion, starts=starts)
    answer = _session_answer(found)
    compared = ""
    if file is None:
        answer["reference_rms_rad"] = reference = _reference(scenario, request)
        compared = (f", against {reference * ARCSECONDS:.3f} arcsec of this campaign's own sessions (rms of 100 drawn)"
                    if np.isfinite(reference) else ", which this campaign's own sessions do not determine")
    told = (f"in {request.duration / 60:.3g} min the antenna quaternion becomes known to "
            f"{found.sigma * ARCSECONDS:.3f} arcsec in all{compared}")
    time_of = np.linspace(0.0, request.duration, 13)
    angles, rates, _ = found.profile(time_of)
    table = ["  time s   about x, y, z deg           rates deg/s"]
    table += [f"{t:8.1f}  {a[0]:8.3f} {a[1]:8.3f} {a[2]:8.3f}  {r[0]:8.4f} {r[1]:8.4f} {r[2]:8.4f}"
              for t, a, r in zip(time_of, np.degrees(angles), np.degrees(rates), strict=True)]
    sigma = np.sqrt(np.diag(found.covariance)) * ARCSECONDS
    table.append("sigma about antenna x, y, z: " + ", ".join(f"{s:.3f}" for s in sigma) + " arcsec")
    return answer, told, table


def _session_answer(found: SessionDesign) -> dict[str, Any]:
    import numpy as np

    time_of = np.arange(0.0, found.request.duration + 1e-9, 1.0)
    angles, rates, _ = found.profile(time_of)
    limits = found.request.limits
    return {
        "minutes": found.request.duration / 60.0, "sigma_rad": np.sqrt(np.diag(found.covariance)),
        "sigma_total_rad": found.sigma, "sigma_axes": "antenna", "covariance_rad2": found.covariance,
        "value": found.value, "no_session_below": found.bound, "starts": list(found.starts),
        "sigma_total_rad_root_minute": found.sigma * np.sqrt(found.request.duration / 60.0),
        "limits": {"angle_rad": limits.angle, "rate_rad_s": limits.rate, "acceleration_rad_s2": limits.acceleration},
        "largest_excess": found.largest_excess,
        "profile": {"time_s": time_of, "angles_rad": angles, "rates_rad_s": rates},
        "scenario": {"slew_profile": found.coefficients},
    }


def _reference(scenario: Scenario, request: SessionRequest, draws: int = 100) -> float:
    """Root mean square of the bound (rad) over sessions as the scenario draws them, of the request's duration."""
    import numpy as np

    from problems.alignment.campaign_design import criterion_value
    from problems.alignment.campaign_design_session import session_information

    draw, total = np.random.default_rng(0), 0.0
    time_of = request.epochs[:, None]
    for _ in range(draws):
        period, phase = draw.uniform(*scenario.slew_period, 3), draw.uniform(0.0, 2.0 * np.pi, 3)
        angles = np.asarray(scenario.slew_amplitude) * np.sin(2 * np.pi * time_of / period + phase)
        angles = angles + np.asarray(scenario.pointing_spread) * draw.standard_normal(3)
        total += criterion_value("A", session_information(request, angles)) / draws
    return float(np.sqrt(total))


def _rotation(scenario: Scenario, criterion: Criterion) -> tuple[dict[str, Any], str, list[str]]:
    import numpy as np

    from problems.alignment.campaign_design_rotation import design_rotation, rotation_request_of

    found: RotationDesign = design_rotation(rotation_request_of(scenario), criterion)
    answer = {
        "minutes": found.minutes, "principal_axes_sigma_total_rad": found.axes_sigma,
        "actuator_sigma_total_rad": found.actuator_sigma, "covariance_rad2": found.covariance,
        "covariance_of": ["principal axis 1", "principal axis 2", "principal axis 3", "actuator x", "actuator y",
                          "actuator z"],
        "value": found.value, "no_choice_of_candidates_below": found.bound,
        "free_initial_rates_rad_s": found.free_rates, "pulse_segments": found.pulse_shape,
        "pulse_torques_n_m": found.pulse_torques,
        "arcs": [{"name": n, "minutes": m, "criterion_without": v} for n, m, v in found.arc_values],
        "scenario": {"free_initial_rates": found.free_rates, "pulse_segments": found.pulse_shape,
                     "pulse_directions": found.pulse_torques},
    }
    told = (f"in {found.minutes:.3g} min of arcs the principal axes become known to "
            f"{found.axes_sigma * ARCSECONDS:.3f} arcsec and the actuator quaternion to "
            f"{found.actuator_sigma * ARCSECONDS:.3f} arcsec")
    table = [f"free-{k + 1}: initial rate {np.round(np.degrees(r), 4).tolist()} deg/s, tracker axes"
             for k, r in enumerate(found.free_rates)]
    table += [f"torque-{k + 1}: {np.round(t, 4).tolist()} N m, actuator axes"
              for k, t in enumerate(found.pulse_torques)]
    table.append("segments (start s, stop s, share): " + ", ".join(f"({a:g}, {b:g}, {s:g})"
                                                                   for a, b, s in found.pulse_shape))
    return answer, told, table
