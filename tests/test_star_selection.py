"""The best stars of the sky: exact against enumeration, bounds that hold, quotas, cones, plans, and the command."""

from __future__ import annotations

import json
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import typer
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from estimator.models.errors import QuaternionError, RequestError, ShapeError, TimeOrderError
from problems.readers.star_catalogue import StarCatalogue, read_star_catalogue
from problems.star_configuration import catalogue_selection as selection
from problems.star_configuration import figures, sighting_plan
from problems.star_configuration.catalogue_selection import Camera, Candidates, Sky, select
from problems.star_configuration.commands import stars as stars_command
from problems.star_configuration.criteria import criteria_of
from problems.star_configuration.optimal_directions import KeepOut, Request, optimal_directions

YALE = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "stars" / "bsc5-short.json"


def generated_sky(count: int = 1630, seed: int = 0) -> Sky:
    """Stars evenly at random, magnitudes growing in number by 10^0.5 per magnitude as in the real sky."""
    generator = np.random.default_rng(seed)
    magnitude = 5 + np.log10(np.maximum(generator.uniform(size=count), 1e-4)) / 0.5
    return Sky(
        StarCatalogue(
            np.arange(count).astype(str),
            np.full(count, ""),
            generator.uniform(0, 2 * np.pi, count),
            np.arcsin(generator.uniform(-1, 1, count)),
            magnitude,
            np.zeros((count, 2)),
        )
    )


def brute_force(candidates: Candidates, count: int, criterion: str, axis: np.ndarray) -> float:
    """The least criterion over all allowed subsets, each by a matrix inverse."""
    b = candidates.directions
    each = (2 / candidates.sigma**2)[:, None, None] * (np.eye(3) - b[:, :, None] * b[:, None, :])
    best = np.inf
    for rows in combinations(range(len(candidates)), count):
        used = np.bincount(candidates.camera[list(rows)], minlength=len(candidates.quotas))
        if np.any(used > candidates.quotas):
            continue
        p = np.linalg.inv(each[list(rows)].sum(axis=0))
        best = min(best, np.trace(p) - (axis @ p @ axis if criterion == "K1" else 0.0))
    return float(best)


@pytest.mark.parametrize("criterion", ["K0", "K1"])
@pytest.mark.parametrize("quotas", [(None, None), (3, None), (2, 3), (4, 1)])
def test_branch_and_bound_is_exact(
    criterion: str, quotas: tuple[int | None, int | None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """12 fields with 10 to 15 candidates in two cameras of unequal accuracy; enumeration inside is switched off."""
    monkeypatch.setattr(selection, "_ENUMERATED", 1)
    sky = generated_sky(900)
    axis = np.array([0.0, 0.6, 0.8])
    tried = 0
    for rotation in Rotation.random(60, rng=np.random.default_rng(1)):
        cameras = (
            Camera((0, 0, 1), np.radians(10), stars=quotas[0]),
            Camera((0, 1, 0.3), np.radians(8), stars=quotas[1], sigma=0.6),
        )
        candidates = sky.candidates(rotation, cameras)
        if not 10 <= len(candidates) <= 15:
            continue
        tried += 1
        chosen = select(candidates, 5, criterion=criterion, axis=axis)
        size = len(chosen.chosen)
        expected = brute_force(candidates, size, criterion, axis)
        assert chosen.proven and chosen.gap == 0
        assert chosen.value == pytest.approx(expected, rel=1e-10)
        assert np.all(np.bincount(candidates.camera[chosen.chosen], minlength=2) <= candidates.quotas)
        if tried == 12:
            break
    assert tried >= 6


def test_branch_and_bound_is_exact_on_odd_geometries(monkeypatch: pytest.MonkeyPatch) -> None:
    """60 problems: whole sphere, narrow bundles and near-parallel clusters, one to three cameras, any quotas."""
    monkeypatch.setattr(selection, "_ENUMERATED", 1)
    generator = np.random.default_rng(5)
    for trial in range(60):
        count, cameras = int(generator.integers(3, 11)), int(generator.integers(1, 4))
        b = generator.standard_normal((count, 3))
        if trial % 3 == 1:
            b = np.array([0, 0, 1]) + 0.1 * b
        elif trial % 3 == 2:
            b = np.round(b) + 1e-3 * generator.standard_normal((count, 3))
        b /= np.linalg.norm(b, axis=1)[:, None]
        sigma = generator.uniform(0.3, 3, count) if trial % 2 else np.ones(count)
        information = selection._sighting_information(b, sigma, Camera((0, 0, 1), 1.0))
        camera = generator.integers(0, cameras, count)
        quotas = tuple(int(q) for q in generator.integers(1, 6, cameras))
        candidates = Candidates(b, information, camera, np.arange(count), sigma, quotas)
        size = min(
            int(generator.integers(2, count + 1)), sum(min(np.sum(camera == i), q) for i, q in enumerate(quotas))
        )
        criterion = ("K0", "K1")[trial % 2]
        chosen = select(candidates, size, criterion=criterion, axis=b[0])
        if size < 2:
            assert chosen.status == "unobservable"
            continue
        assert chosen.status == "ok" and chosen.proven and len(chosen.chosen) == size
        assert chosen.value == pytest.approx(brute_force(candidates, size, criterion, b[0]), rel=1e-8)


def test_bounds_hold_without_branching_and_are_tight() -> None:
    """40 fields of 20 degrees half-angle, about 50 candidates: the first bound against the proven optimum."""
    sky = generated_sky()
    gaps = []
    for rotation in Rotation.random(40, rng=np.random.default_rng(2)):
        candidates = sky.candidates(rotation, (Camera((0, 0, 1), np.radians(20)),))
        quick, exact = select(candidates, 8, exact=False), select(candidates, 8)
        assert exact.proven
        assert quick.lower_bound <= exact.value * (1 + 1e-12) <= quick.value * (1 + 2e-12)
        gaps.append(quick.value / exact.value - 1)
    assert np.median(gaps) < 1e-9 and max(gaps) < 0.01  # greedy and exchange nearly always find the optimum


def test_giving_up_the_proof_states_a_gap_that_holds() -> None:
    sky = generated_sky(6000)
    cameras = (Camera((0, 0, 1), np.radians(30), stars=10), Camera((1, 0, 0), np.radians(30), stars=10))
    candidates = sky.candidates([1, 0, 0, 0], cameras)
    cut, full = select(candidates, 16, node_limit=1), select(candidates, 16, node_limit=400)
    assert cut.lower_bound <= full.value * (1 + 1e-12)
    assert full.value <= cut.value * (1 + 1e-12)
    assert cut.value <= cut.lower_bound * (1 + cut.gap) * (1 + 1e-9)


def test_array_kernels_agree_with_the_criteria() -> None:
    generator = np.random.default_rng(3)
    b = generator.standard_normal((6, 3))
    b /= np.linalg.norm(b, axis=1)[:, None]
    sigma = generator.uniform(0.5, 2, 6)
    information = selection._sighting_information(b, sigma, Camera((0, 0, 1), 1.0)).sum(axis=0)
    axis = np.array([0.6, 0.0, 0.8])
    expected = criteria_of(b, axis, sigma)
    assert selection.criterion_values(information, selection._entries(np.eye(3))) == pytest.approx(
        expected.K0, rel=1e-12
    )
    assert selection.criterion_values(
        information, selection._entries(np.eye(3) - np.outer(axis, axis))
    ) == pytest.approx(expected.K1, rel=1e-12)
    import casadi as ca

    from problems.star_configuration.criteria import two_axis_information

    camera = Camera((0, 0, 1), 1.0, ratio=3.0, first_axis=(1, 0, 0))
    found = selection._sighting_information(b[:1], sigma[:1], camera)[0]
    first = np.array([1.0, 0, 0]) - b[0, 0] * b[0]
    first /= np.linalg.norm(first)
    small = sigma[0] / np.sqrt(10)
    two = np.array(two_axis_information(ca.DM(b[0]), ca.DM(first), 3 * small, small))
    np.testing.assert_allclose(found, selection._entries(two), rtol=1e-12)


def test_the_curvature_of_the_relaxation_by_differences() -> None:
    generator = np.random.default_rng(5)
    root = generator.standard_normal((3, 3))
    f, a = root @ root.T + np.eye(3), np.eye(3) - np.outer([0, 0.6, 0.8], [0, 0.6, 0.8])
    weight, entries = selection._entries(a), selection._entries(f)

    def gradient(e: np.ndarray) -> np.ndarray:
        inverse = np.linalg.inv(selection._matrix(e))
        return -selection._entries(inverse @ a @ inverse) * selection._DOUBLED

    step = 1e-6
    for k in range(6):
        unit = step * np.eye(6)[k]
        slope = (
            selection.criterion_values(entries + unit, weight) - selection.criterion_values(entries - unit, weight)
        ) / (2 * step)
        assert gradient(entries)[k] == pytest.approx(slope, rel=1e-6)
        row = (gradient(entries + unit) - gradient(entries - unit)) / (2 * step)
        inverse = np.linalg.inv(f)
        np.testing.assert_allclose(selection._curvature(inverse, inverse @ a @ inverse)[k], row, rtol=1e-5, atol=1e-8)


def test_what_is_seen_obeys_attitude_field_sensitivity_and_cones() -> None:
    sky = generated_sky()
    attitude = Rotation.random(rng=np.random.default_rng(7))
    camera = Camera((0.2, -0.3, 0.9), np.radians(25), magnitude_limit=4.5)
    cone = KeepOut(tuple(attitude.apply([0.2, -0.3, 0.9])), np.radians(12), "Moon")
    candidates = sky.candidates(attitude.as_quat(scalar_first=True), (camera,), (cone,))
    stars = sky.catalogue
    body = attitude.inv().apply(stars.directions())
    angle = np.degrees(np.arccos(np.clip(body @ np.array(camera.boresight), -1, 1)))
    expected = np.flatnonzero((angle <= 25) & (angle >= 12) & (stars.magnitude <= 4.5))
    assert sorted(candidates.star) == expected.tolist()
    np.testing.assert_allclose(candidates.directions, body[candidates.star], atol=1e-14)


def test_photon_noise_makes_faint_stars_worth_less() -> None:
    camera = Camera((0, 0, 1), 0.2, sigma=1.0, photon_sigma=0.5, photon_magnitude=3.0)
    assert camera.accuracy(np.array([3.0]))[0] == pytest.approx(np.sqrt(1.25))
    assert camera.accuracy(np.array([8.0]))[0] == pytest.approx(
        np.sqrt(1 + 25)
    )  # five magnitudes: 100 times fewer photons


def test_too_few_stars_is_no_attitude() -> None:
    sky = generated_sky(50)
    candidates = sky.candidates([1, 0, 0, 0], (Camera((0, 0, 1), np.radians(0.5)),))
    chosen = select(candidates, 8)
    assert chosen.status == "unobservable" and chosen.value == np.inf and "two stars" in chosen.why
    same = StarCatalogue(
        np.array(["a", "b"]), np.array(["", ""]), np.zeros(2), np.zeros(2), np.array([1.0, 2.0]), np.zeros((2, 2))
    )
    double = select(Sky(same).candidates([1, 0, 0, 0], (Camera((1, 0, 0), 0.1),)), 2)
    assert double.status == "unobservable"


def test_bad_requests_are_refused() -> None:
    sky = generated_sky(50)
    with pytest.raises(QuaternionError, match="unit length"):
        sky.candidates([1, 1, 0, 0], (Camera((0, 0, 1), 0.2),))
    with pytest.raises(RequestError, match="camera"):
        sky.candidates([1, 0, 0, 0], ())
    with pytest.raises(RequestError):
        Camera((0, 0, 1), 10.0, name="wide")
    with pytest.raises(RequestError):
        select(sky.candidates([1, 0, 0, 0], (Camera((0, 0, 1), 3.0),)), 0)


def test_real_sky_attitude_error_is_the_predicted_covariance() -> None:
    """Yale stars to magnitude 5, three attitudes, 8 stars, 20,000 Wahba solutions each."""
    if not YALE.exists():
        pytest.skip(
            f"the Yale catalogue is not at {YALE}; tests/test_star_criteria.py does the same on generated directions"
        )
    sky = Sky(read_star_catalogue(YALE))
    generator = np.random.default_rng(9)
    sigma = np.radians(10 / 3600)  # rad, total
    for rotation in Rotation.random(3, rng=generator):
        candidates = sky.candidates(rotation, (Camera((0, 0, 1), np.radians(12), sigma=sigma),))
        chosen = select(candidates, 8)
        b = candidates.directions[chosen.chosen]
        noise = generator.standard_normal((20_000, len(b), 3)) * sigma / np.sqrt(2)
        measured = b + noise - np.sum(noise * b, axis=2, keepdims=True) * b
        u, _, vt = np.linalg.svd(np.einsum("sni,nj->sij", measured, b))
        u[:, :, 2] *= (np.linalg.det(u) * np.linalg.det(vt))[:, None]
        errors = Rotation.from_matrix(u @ vt).as_rotvec()
        expected = chosen.criteria.covariance
        standard_error = np.sqrt((expected**2 + np.outer(np.diag(expected), np.diag(expected))) / len(errors))
        assert np.max(np.abs(errors.T @ errors / len(errors) - expected) / standard_error) < 5


# ---- the plan ----


def test_nadir_attitude_and_orbit() -> None:
    seconds = np.linspace(0, 6000, 25)
    r, v = sighting_plan.circular_orbit(seconds, altitude=693e3, inclination=np.radians(98), node=1.0, argument=0.3)
    np.testing.assert_allclose(np.linalg.norm(r, axis=1), sighting_plan.EARTH_RADIUS + 693e3, rtol=1e-14)
    h = np.cross(r, v)
    np.testing.assert_allclose(h, np.broadcast_to(h[0], h.shape), rtol=1e-9, atol=1e-3 * np.linalg.norm(h[0]) * 1e-9)
    step = 1e-3
    ahead, _ = sighting_plan.circular_orbit(
        seconds + step, altitude=693e3, inclination=np.radians(98), node=1.0, argument=0.3
    )
    np.testing.assert_allclose((ahead - r) / step, v, atol=0.1)
    assert np.degrees(np.arccos(h[0, 2] / np.linalg.norm(h[0]))) == pytest.approx(98)
    body = sighting_plan.nadir_attitude(r, v)
    np.testing.assert_allclose(body.apply([0, 0, 1]), -r / np.linalg.norm(r, axis=1)[:, None], atol=1e-12)
    np.testing.assert_allclose(body.apply([1, 0, 0]), v / np.linalg.norm(v, axis=1)[:, None], atol=1e-12)


def test_sun_moon_and_limb_directions() -> None:
    position = np.array([[7.0e6, 0, 0], [0, 7.0e6, 0]])
    cones = sighting_plan.keep_outs_at("2025-03-20T09:01:00", np.array([0.0, 60.0]), position)
    limb, sun, moon = cones[0]
    assert limb.direction == pytest.approx((-1, 0, 0))
    assert np.degrees(limb.half_angle) == pytest.approx(np.degrees(np.arcsin(6378137 / 7e6)) + 10)
    # At the March equinox the Sun stands at the first point of Aries of date, 0.32 degrees from J2000's.
    assert np.degrees(np.arccos(sun.direction[0])) < 0.5
    assert moon.name == "Moon" and np.linalg.norm(moon.direction) == pytest.approx(1)
    with pytest.raises(RequestError, match="epoch"):
        sighting_plan.keep_outs_at("yesterday", np.array([0.0]), position[:1])


def plan_of(tolerance: float, dwell: float = 0.0) -> tuple[sighting_plan.SightingPlan, Sky]:
    sky = generated_sky(3000, 4)
    seconds = np.arange(0.0, 1500.0, 60.0)
    r, v = sighting_plan.circular_orbit(seconds, altitude=693e3, inclination=1.7)
    cones = sighting_plan.keep_outs_at("2025-06-01T00:00:00", seconds, r)
    cameras = (
        Camera((0, -0.9, -0.5), np.radians(10), stars=4, name="left"),
        Camera((0.2, 0.9, -0.5), np.radians(10), stars=4, name="right"),
    )
    return sighting_plan.plan_sightings(
        sky, seconds, sighting_plan.nadir_attitude(r, v), cameras, 8, keep_outs=cones, tolerance=tolerance, dwell=dwell
    ), sky


def test_a_plan_keeps_its_tolerance_and_changes_fewer_stars() -> None:
    exact, _ = plan_of(0.0)
    np.testing.assert_allclose(exact.K0, exact.best, rtol=1e-9)
    lazy, sky = plan_of(0.15, 120.0)
    assert lazy.status == "ok"
    assert np.all(1.15 * lazy.best * (1 + 1e-9) >= lazy.K0) and np.all(lazy.lower_bound * (1 - 1e-9) <= lazy.K0)
    assert lazy.acquisitions < 0.8 * exact.acquisitions
    assert len(lazy.arcs) == lazy.acquisitions + len(lazy.followed[0])
    for step in lazy.followed:
        assert len(step) == len(set(step)) <= 8
        assert np.all(np.bincount([c for c, _ in step], minlength=2) <= 4)
    assert all(a.end >= a.start and a.identifier in sky.catalogue.identifier for a in lazy.arcs)


def test_times_without_an_attitude_are_named() -> None:
    sky = generated_sky(300)
    times = np.array([0.0, 10.0, 20.0])
    covered = (KeepOut((0, 0, 1), np.radians(170), "hood"),)
    plan = sighting_plan.plan_sightings(
        sky, times, [[1, 0, 0, 0]] * 3, (Camera((0, 0, 1), 0.5),), 4, keep_outs=[(), covered, ()]
    )
    assert (
        plan.status == "unobservable"
        and plan.dark == ((10.0, 10.0),)
        and np.isinf(plan.K0[1])
        and np.isfinite(plan.K0[2])
    )


def test_bad_plans_are_refused() -> None:
    sky, camera = generated_sky(100), (Camera((0, 0, 1), 0.5),)
    with pytest.raises(TimeOrderError):
        sighting_plan.plan_sightings(sky, [0.0, 0.0], [[1, 0, 0, 0]] * 2, camera, 4)
    with pytest.raises(ShapeError):
        sighting_plan.plan_sightings(sky, [0.0, 1.0], [[1, 0, 0, 0]], camera, 4)
    with pytest.raises(RequestError, match="altitude"):
        sighting_plan.circular_orbit(np.zeros(1), altitude=693.0, inclination=1.0)


# ---- the command and the figures ----

RUNNER = CliRunner()
APPLICATION = typer.Typer()
APPLICATION.command()(stars_command)


def call(*words: str, code: int = 0) -> dict:
    result = RUNNER.invoke(APPLICATION, [*words, "--json"])
    assert result.exit_code == code, result.output
    return json.loads(result.stdout)


@pytest.mark.parametrize("count", [2, 3, 10, 50])
def test_command_gives_an_optimal_configuration(count: int) -> None:
    answer = call(str(count))
    b = np.array(answer["directions"])
    assert answer["status"] == "ok" and b.shape == (count, 3)
    np.testing.assert_allclose(np.linalg.norm(b, axis=1), 1, atol=4e-16)
    p = 0.5 * np.linalg.inv(count * np.eye(3) - b.T @ b)
    v = np.array(answer["axis"])
    assert np.trace(p) == pytest.approx(answer["K0"], rel=1e-13)
    assert v @ (np.trace(p) * np.eye(3) - p) @ v == pytest.approx(answer["K1"], rel=1e-13)
    assert answer["K0"] - (1.25 if count == 2 else 9 / (4 * count)) < 1e-12


def test_command_for_one_axis_and_for_one_star() -> None:
    answer = call("2", "--criterion", "K1", "--axis", "1", "2", "2", "--angle-limit", "60")
    assert answer["K1"] == pytest.approx(0.5 * (0.5 + 1 / 1.5), rel=1e-9)
    np.testing.assert_allclose(answer["axis"], np.array([1, 2, 2]) / 3, atol=1e-15)
    alone = call("1", code=1)
    assert (
        alone["status"] == "unobservable" and alone["K0"] is None and "rotation about the line of sight" in alone["why"]
    )
    assert call("0", code=2)["status"] == "bad_input"
    assert call("4", "--criterion", "K7", code=2)["status"] == "bad_input"
    assert call("9", "--angle-limit", "75", "--starts", "2", code=1)["status"] == "infeasible"
    assert call("4", "--attitude", "1", "0", "0", "0", code=2)["status"] == "bad_input"


def test_command_with_cones_fixed_sensors_and_family(tmp_path: Path) -> None:
    page, picture = tmp_path / "sphere.html", tmp_path / "sphere.png"
    answer = call(
        "3",
        "--fixed",
        "0 0 1",
        "--keep-out",
        "0,0,-1,60 Earth limb",
        "--family",
        "--page",
        str(page),
        "--picture",
        str(picture),
    )
    assert answer["K0"] == pytest.approx(9 / 16, rel=1e-9)
    assert answer["family"]["dimension"] == 0 and len(answer["family"]["members"]) == 1
    assert page.read_text(encoding="utf-8").count("plotly") > 3 and 'src="http' not in page.read_text(encoding="utf-8")
    assert picture.read_bytes()[:4] == b"\x89PNG"


def small_catalogue(path: Path) -> Path:
    stars = generated_sky(2500, 8).catalogue
    rows = [
        f"{i},{np.degrees(ra):.9f},{np.degrees(dec):.9f},{m:.4f}"
        for i, ra, dec, m in zip(
            stars.identifier, stars.right_ascension, stars.declination, stars.magnitude, strict=True
        )
    ]
    path.write_text("\n".join(["id,ra,dec,mag", *rows]), encoding="utf-8")
    return path


def test_command_for_the_sky(tmp_path: Path) -> None:
    file = small_catalogue(tmp_path / "sky.csv")
    page, picture = tmp_path / "sky.html", tmp_path / "sky.png"
    answer = call(
        "6",
        "--catalogue",
        str(file),
        "--attitude",
        "0.5",
        "0.5",
        "-0.5",
        "0.5",
        "--camera",
        "0 0 1 4 up",
        "--camera",
        "1 0 0",
        "--page",
        str(page),
        "--picture",
        str(picture),
    )
    assert answer["status"] == "ok" and answer["proven_optimal"] and len(answer["stars"]) == 6
    b = np.array(answer["directions"])
    assert pytest.approx(answer["K0"], rel=1e-12) == criteria_of(b).K0
    for star, row in zip(answer["stars"], b, strict=True):
        ra, dec = np.radians([star["right_ascension_deg"], star["declination_deg"]])
        inertial = [np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)]
        np.testing.assert_allclose(
            Rotation.from_quat([0.5, 0.5, -0.5, 0.5], scalar_first=True).apply(row), inertial, atol=1e-12
        )
        assert max(row[2], row[0]) >= np.cos(np.radians(10)) and star["magnitude"] <= 5
    assert sum(s["camera"] == "up" for s in answer["stars"]) <= 4
    assert page.exists() and picture.read_bytes()[:4] == b"\x89PNG"
    sun = call(
        "6",
        "--catalogue",
        str(file),
        "--attitude",
        "1",
        "0",
        "0",
        "0",
        "--epoch",
        "2025-06-21T00:00:00",
        "--position",
        "7e6",
        "0",
        "0",
    )
    assert [k["name"] for k in sun["keep_outs"]] == ["Earth limb", "Sun", "Moon"]
    assert call("6", "--catalogue", str(file), code=2)["status"] == "bad_input"
    assert (
        call("6", "--catalogue", str(tmp_path / "none"), "--attitude", "1", "0", "0", "0", code=2)["status"]
        == "bad_input"
    )
    assert call("6", "--catalogue", str(file), "--attitude", "2", "0", "0", "0", code=2)["status"] == "bad_input"
    dark = call("6", "--catalogue", str(file), "--attitude", "1", "0", "0", "0", "--field-of-view", "0.2", code=1)
    assert dark["status"] == "unobservable"


def test_command_for_an_orbit(tmp_path: Path) -> None:
    request = tmp_path / "plan.toml"
    request.write_text(
        'epoch = "2025-03-20T09:00:00"\naltitude_km = 693\ninclination_deg = 98\nnode_deg = 90\n'
        "duration_s = 600\nstep_s = 60\n"
        '[[camera]]\nname = "up"\nboresight = [0.0, 0.2, -1.0]\nfield_of_view_deg = 24\n',
        encoding="utf-8",
    )
    picture = tmp_path / "plan.png"
    file = small_catalogue(tmp_path / "sky.csv")
    answer = call("6", "--catalogue", str(file), "--orbit", str(request), "--picture", str(picture))
    assert answer["status"] == "ok" and len(answer["times_s"]) == 11 == len(answer["K0"]) and picture.exists()
    assert np.all(np.array(answer["K0"]) <= 1.1 * np.array(answer["best"]) * (1 + 1e-9))
    request.write_text("altitude = 3\n", encoding="utf-8")
    assert call("6", "--catalogue", str(file), "--orbit", str(request), code=2)["status"] == "bad_input"


def test_circle_of_the_figures_lies_on_the_sphere_at_its_angle() -> None:
    ring = figures.circle([0.3, -0.5, 0.2], 0.4)
    centre = np.array([0.3, -0.5, 0.2]) / np.linalg.norm([0.3, -0.5, 0.2])
    np.testing.assert_allclose(np.linalg.norm(ring, axis=1), 1, atol=1e-14)
    np.testing.assert_allclose(ring @ centre, np.cos(0.4), atol=1e-14)


def test_a_configuration_prints_as_a_table() -> None:
    text = str(optimal_directions(Request(3)))
    assert text.count("\n") == 5 and "K0 = 0.75" in text
