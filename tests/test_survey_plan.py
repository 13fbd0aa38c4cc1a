"""A whole plan: continuity, limits, cone, coverage and overlap by other means than the planner's own; bad requests."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from estimator.models.errors import GeometryError, InfeasibleError
from guidance.coverage import covered_fraction, least_overlap
from guidance.ground_geometry import (
    earth_fixed_from_geodetic,
    ellipsoid_normal,
    geodetic_from_earth_fixed,
)
from guidance.kinematics import Motion, exponential
from guidance.slew_joining import Joiner, estimated_duration
from guidance.slew_request import Limits
from guidance.survey_plan import plan_survey
from guidance.survey_planner import counts
from guidance.survey_request import survey_request

EPOCH = "2025-03-02T03:04:05Z"
SOUTHERN = {
    "orbit": {"epoch": EPOCH, "overhead": [-35.0, 179.9], "pass": "descending", "offset_km": 120},
    "area": [{"name": "shelf", "center": [-35.0, 179.9], "length_km": 60, "width_km": 105}],
    "route": [{"name": "cape", "start": [-31.5, -179.2], "length_km": 30, "image_motion": "equalised"},
              {"name": "isle", "start": [-37.2, 179.4], "length_km": 40, "when": "after",
               "image_motion": "along_track"}],
}


@pytest.fixture(scope="module")
def plan():
    return plan_survey(survey_request(SOUTHERN))


def sight(plan, times):
    """Position of the satellite, line of sight and detector axis in Earth-fixed axes, from attitude and orbit alone."""
    (one,) = plan.passes
    states = plan.orbit.states(times)
    turn = plan.orbit.earth.fixed_from_inertial(times)
    body = Rotation.from_quat(one.motion(times).quaternion, scalar_first=True)
    axes = [np.einsum("nij,nj->ni", turn, body.apply(v)) for v in ([0, -1.0, 0], [0, 0, 1.0], [1.0, 0, 0])]
    return np.einsum("nij,nj->ni", turn, states[:, :3]), *axes


def test_the_pieces_join_with_continuous_attitude_rate_and_acceleration(plan):
    (one,) = plan.passes
    assert len(one.pieces) == 2 * len(one.scans) - 1 + 2 * len(plan.answer()["waits"])
    for before, after in zip(one.pieces[:-1], one.pieces[1:], strict=True):
        assert before.stop == pytest.approx(after.start, abs=1e-9)
        a, b = before.motion(np.array([before.stop])), after.motion(np.array([after.start]))
        assert 1 - abs(float(a.quaternion[0] @ b.quaternion[0])) < 1e-14
        assert np.allclose(a.rate, b.rate, rtol=0, atol=1e-8)
        assert np.allclose(a.acceleration, b.acceleration, rtol=0, atol=1e-8)


def test_limits_hold_and_the_rates_are_those_of_the_attitude(plan):
    (one,) = plan.passes
    times = np.arange(one.start, one.stop, 0.01)
    motion = one.motion(times)
    limits = plan.request.limits
    for values, limit in ((motion.rate, limits.rate), (motion.acceleration, limits.acceleration),
                          (motion.jerk, limits.jerk)):
        assert np.linalg.norm(values, axis=1).max() <= limit * (1 + 1e-6)
    turned = (Rotation.from_quat(motion.quaternion[:-1], scalar_first=True).inv()
              * Rotation.from_quat(motion.quaternion[1:], scalar_first=True)).as_rotvec() / np.diff(times)[:, None]
    assert np.allclose(turned, 0.5 * (motion.rate[1:] + motion.rate[:-1]), rtol=0, atol=1e-7)
    change = np.diff(motion.rate, axis=0) / np.diff(times)[:, None]
    assert np.linalg.norm(change, axis=1).max() <= limits.acceleration * (1 + 1e-6)
    assert (np.sum(motion.quaternion[1:] * motion.quaternion[:-1], axis=1) > 0).all()


def test_the_line_of_sight_stays_in_the_cone(plan):
    times = np.linspace(plan.start, plan.stop, 3000)
    position, direction, *_ = sight(plan, times)
    latitude, longitude, _ = geodetic_from_earth_fixed(position)
    cosine = -np.sum(direction * ellipsoid_normal(latitude, longitude), axis=1)
    largest = math.degrees(math.acos(cosine.min()))
    assert largest <= 40.0
    assert largest == pytest.approx(plan.answer()["largest_off_nadir_deg"], abs=1e-3)


def test_coverage_and_overlap_by_projecting_points_into_the_camera(plan):
    (area,) = plan.areas
    a, b = area.request.length, area.request.width
    generator = np.random.default_rng(5)
    along, across = (generator.uniform(-0.5, 0.5, 500) * a, generator.uniform(-0.5, 0.5, 500) * b)
    points = earth_fixed_from_geodetic(*area.plane.to_ellipsoid(along, across))
    seen = []
    for planned in plan.scans:
        if planned.kind != "area":
            continue
        times = np.linspace(planned.scan.start, planned.scan.stop, 500)
        position, direction, detector, forward = sight(plan, times)
        ray = points[:, None, :] - position
        depth = np.sum(ray * direction, -1)
        tangents = np.sum(ray * forward, -1) / depth, np.sum(ray * detector, -1) / depth
        crossing = np.diff(np.sign(tangents[0]), axis=1) != 0
        inside = np.abs(tangents[1][:, 1:]) <= math.tan(math.radians(3.55 / 2))
        seen.append((crossing & inside).any(axis=1))
    count = np.sum(seen, axis=0)
    assert (count >= 1).mean() >= 0.99
    assert plan.answer()["covered_fraction"] >= 0.99
    assert plan.answer()["least_overlap_percent"] >= 5.0
    assert (count >= 2).mean() > 0.02  # the overlaps are there
    assert (count <= 2).all()  # and neighbours alone overlap


def test_answer_has_the_agreed_shape(plan):
    answer = json.loads(json.dumps(plan.answer()))
    assert answer["status"] == "ok"
    scan = answer["scans"][0]
    assert set(scan) >= {"index", "kind", "name", "direction", "image_motion", "start_s", "stop_s", "length_km",
                         "width_km", "center", "corners"}
    assert [s["name"] for s in answer["scans"]][::len(answer["scans"]) - 1] == ["cape", "isle"]
    assert [s["index"] for s in answer["scans"]] == list(range(1, len(answer["scans"]) + 1))
    assert answer["scans"][0]["length_km"] == pytest.approx(30, abs=1e-9)
    assert answer["scans"][-1]["image_motion"] == "along_track"
    assert all(len(s["corners"]) == 4 and -180 <= c[1] < 180 for s in answer["scans"] for c in s["corners"])
    times = [t for s in answer["scans"] for t in (s["start_s"], s["stop_s"])]
    assert times == sorted(times)
    assert answer["duration_s"] == pytest.approx(times[-1] - times[0])
    for slew, before, after in zip(answer["slews"], answer["scans"][:-1], answer["scans"][1:], strict=False):
        if not answer["waits"]:
            assert slew["start_s"] == pytest.approx(before["stop_s"])
            assert slew["start_s"] + slew["duration_s"] == pytest.approx(after["start_s"], abs=1e-6)


def test_coverage_of_known_shapes():
    from guidance.coverage import Outline

    def box(low, high, near=-60.0, far=60.0):
        x = np.linspace(near, far, 5)
        y = np.linspace(low, high, 3)
        return Outline(np.stack([x, np.full(5, low)], -1), np.stack([x, np.full(5, high)], -1),
                       np.stack([np.full(3, near), y], -1), np.stack([np.full(3, far), y], -1))

    assert covered_fraction([box(-50, 0), box(-5, 60)], 100, 100) == pytest.approx(1)
    assert covered_fraction([box(-50, 0), box(10, 50)], 100, 100) == pytest.approx(0.9)
    assert covered_fraction([box(-50, 50, 0, 60)], 100, 100) == pytest.approx(0.5, abs=2e-3)
    assert covered_fraction([box(-50, 50), box(-20, 20)], 100, 100) == pytest.approx(1)
    assert least_overlap([box(-5, 60), box(-50, 0)], 100) == pytest.approx(5 / 65)
    assert least_overlap([box(-50, 0), box(-5, 60, -40)], 100) == -1
    assert least_overlap([box(-5, 60)], 100) is None


def test_estimates_of_the_number_of_scans():
    # 203 km, swaths of 41.7 and 50 km: the printed formula falls with the overlap, the corrected one rises.
    for overlap, printed, corrected in ((0.05, 3.98, 4.66), (0.10, 3.54, 4.92)):
        found = counts(203e3, 41.7e3, 50e3, overlap)
        assert found.printed == pytest.approx(printed, abs=0.01)
        assert found.corrected == pytest.approx(corrected, abs=0.01)


def test_estimate_of_a_slew_is_close_to_the_slew():
    limits = Limits(math.radians(2.5), math.radians(0.2), math.radians(0.1))
    zero = np.zeros(3)
    start = Motion(np.array([1.0, 0, 0, 0]), np.radians([0, 0, 0.06]), zero, zero)
    stop = Motion(exponential(np.radians([3.6, 0, -6.0])), np.radians([0, 0, -1.0]), zero, zero)
    join = Joiner(limits).join(start, stop, 10.0)
    assert join.law == "optimal"
    assert join.duration == pytest.approx(estimated_duration(start, stop, limits), rel=0.03)
    # Rest to rest over 6 degrees the analytic S-curve: 1 + sqrt(31) s for each half.
    still = Motion(start.quaternion, zero, zero, zero), Motion(exponential(np.radians([6.0, 0, 0])), zero, zero, zero)
    analytic = 2 * (1 + math.sqrt(31.0))
    assert estimated_duration(*still, limits) == pytest.approx(analytic, rel=1e-6)
    assert Joiner(limits).join(*still, 0.0).duration == pytest.approx(analytic, rel=1e-3)


def one_area(orbit=None, limits=None, **area):
    return survey_request({"orbit": {"epoch": EPOCH, "overhead": [20.0, 10.0], **(orbit or {})}, "limits": limits or {},
                           "area": [{"center": [20.0, 10.0], "length_km": 40, "width_km": 40, **area}]})


def test_a_target_beyond_the_ground_track_is_never_visible():
    with pytest.raises(GeometryError, match=r"never visible.*limit"):
        plan_survey(survey_request({
            "orbit": {"epoch": EPOCH, "raan_deg": 0, "argument_of_latitude_deg": 0, "inclination_deg": 30},
            "area": [{"center": [60, 10], "length_km": 40, "width_km": 40}]}))


def test_an_azimuth_far_from_the_track_is_infeasible_by_so_much():
    with pytest.raises(InfeasibleError, match="limit 20 deg, exceeded by") as caught:
        plan_survey(one_area(azimuth_deg=70.0))
    assert caught.value.limit == "azimuth"
    assert caught.value.excess > math.radians(30)


def test_too_few_scans_leave_a_named_width_uncovered():
    with pytest.raises(InfeasibleError, match=r"km of width uncovered; ask for more scans"):
        plan_survey(one_area(width_km=80, scans=1))


def test_a_rate_limit_below_the_scans_own_rate_is_named():
    with pytest.raises(InfeasibleError, match="rate reaches"):
        plan_survey(one_area(limits={"rate_deg_s": 0.01}))


def test_a_route_that_cannot_be_reached_is_named():
    with pytest.raises(InfeasibleError, match="route far"):
        plan_survey(survey_request({
            "orbit": {"epoch": EPOCH, "overhead": [20.0, 10.0]},
            "area": [{"center": [20.0, 10.0], "length_km": 40, "width_km": 40}],
            "route": [{"name": "far", "start": [22.0, 40.0], "length_km": 20, "when": "after"}]}))


def test_an_area_larger_than_any_plan(monkeypatch):
    monkeypatch.setattr("guidance.survey_plan.HORIZON", 30000.0)  # s, to be quick
    with pytest.raises(InfeasibleError, match=r"larger than any plan.*km of width"):
        plan_survey(one_area(length_km=100, width_km=4000))


def test_what_one_pass_cannot_do_is_split():
    # A cone of 15 degrees leaves no room for all the scans in one pass.
    plan = plan_survey(survey_request({
        "orbit": {"epoch": EPOCH, "overhead": [60.0, 10.0], "inclination_deg": 98.27},
        "limits": {"off_nadir_deg": 15},
        "area": [{"center": [60.0, 10.0], "length_km": 70, "width_km": 150}]}))
    answer = plan.answer()
    assert len(plan.passes) > 1
    assert answer["covered_fraction"] >= 0.99
    assert answer["least_overlap_percent"] >= 5.0
    assert answer["largest_off_nadir_deg"] <= 15.0
    for first, second in zip(plan.passes[:-1], plan.passes[1:], strict=True):
        assert second.start > first.stop


def test_command_answers_in_json(tmp_path):
    import typer

    from problems.area_survey.commands_survey import survey

    app = typer.Typer()
    app.command()(survey)
    request = tmp_path / "request.toml"
    request.write_text(f'[orbit]\nepoch = "{EPOCH}"\noverhead = [20.0, 10.0]\n[[area]]\ncenter = [20.0, 10.0]\n'
                       "length_km = 40\nwidth_km = 40\n")
    result = CliRunner().invoke(app, [str(request), "--json", "--plots", str(tmp_path / "plots"),
                                      "--report", str(tmp_path / "report.html"), "--export", str(tmp_path / "a.aem")])
    assert result.exit_code == 0, result.output
    answer = json.loads(result.stdout)
    assert answer["status"] == "ok"
    assert answer["scans"][0]["direction"] == "forward"
    page = (tmp_path / "report.html").read_text()
    assert "http-equiv" not in page
    assert 'src="http' not in page
    assert (tmp_path / "plots" / "figure-2-map.png").stat().st_size > 10000
    assert (tmp_path / "a.aem").exists()
    request.write_text("[orbit]\nepoch = 5\n")
    result = CliRunner().invoke(app, [str(request), "--json"])
    assert result.exit_code == 2
    assert json.loads(result.stdout)["status"] == "bad_input"
