"""Sentinel-1 annotations: the geometry Doppler is reproduced, and the campaign made of them carries it without loss.

A generated annotation stands in where the measured ones are absent. Its numbers come by another way than the
importer's: a ray is cut with the ellipsoid by the quadratic formula for chosen elevations, and the celestial frame is
astropy's.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
import typer
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import Polynomial
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from estimator.models.earth_orientation import (
    earth_fixed_from_celestial,
    earth_rotation_angle,
    tai_from_utc,
    utc_text,
)
from estimator.models.errors import (
    FileFormatError,
    GeometryError,
    InputError,
    MissingDataError,
    NotFiniteError,
    QuaternionError,
    RequestError,
    TooFewDataError,
)
from problems.alignment import commands_import
from problems.alignment.campaign import Campaign
from problems.alignment.determined_rotation import undetermined_axes
from problems.alignment.sentinel1_import import (
    beam_directions,
    campaign_of,
    compare_geometry,
    import_sentinel1,
    polynomial_value,
    slant_interval,
)
from problems.alignment.solution import solve_campaign
from problems.cli import main
from problems.readers.campaign_file import read_campaign, write_campaign
from problems.readers.sentinel1_annotation import Annotation, read_annotation
from problems.readers.sentinel1_orbit_file import read_orbit_file

DATA = Path(__file__).resolve().parents[1].parent / "shared" / "data"
FILES = sorted((DATA / "sentinel1").glob("*.xml"))
needs_data = pytest.mark.skipif(not FILES, reason=f"no measured annotations at {DATA / 'sentinel1'}")

LIGHT = 299792458.0  # [m/s]
CARRIER = 5.405000454334350e9  # [Hz]
START = np.datetime64("2021-06-04T08:22:13.000000", "us")  # UTC


# ---------------------------------------------------------------------------------------------------------------- #
# a generated annotation


def utc(seconds: float) -> str:
    return str(START + np.timedelta64(round(seconds * 1e6), "us"))


@lru_cache
def celestial_from_earth_fixed(seconds: tuple[float, ...]) -> np.ndarray:
    """Rotation matrices by astropy's own chain of frames."""
    import astropy.units as u
    from astropy.coordinates import GCRS, ITRS, CartesianRepresentation
    from astropy.time import Time
    from astropy.utils import iers

    with iers.conf.set_temp("auto_download", False), iers.conf.set_temp("auto_max_age", None):
        time = Time([utc(s) for s in seconds], scale="utc")
        columns = []
        for axis in np.eye(3):
            point = CartesianRepresentation(*[np.full(len(seconds), a) * u.km for a in axis])
            columns.append(ITRS(point, obstime=time).transform_to(GCRS(obstime=time)).cartesian.xyz.to_value(u.km))
    return np.moveaxis(np.array(columns), [0, 1, 2], [2, 1, 0])


def orbit(seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Earth-fixed position and velocity on a circular orbit above an Earth that turns evenly."""
    radius, inclination, earth = 7.07e6, np.deg2rad(98.2), 7.2921151467e-5
    rate = np.sqrt(3.986004418e14 / radius**3)
    u, node = 1.0 + rate * seconds, 0.4 - earth * seconds
    along = np.stack([np.cos(u), np.sin(u) * np.cos(inclination), np.sin(u) * np.sin(inclination)])
    forward = np.stack([-np.sin(u), np.cos(u) * np.cos(inclination), np.cos(u) * np.sin(inclination)])

    def turned(v: np.ndarray) -> np.ndarray:
        return np.stack([np.cos(node) * v[0] - np.sin(node) * v[1], np.sin(node) * v[0] + np.cos(node) * v[1], v[2]])

    position = radius * turned(along)
    velocity = radius * rate * turned(forward) - earth * np.stack([-position[1], position[0], 0 * position[0]])
    return position.T, velocity.T


def earth_fixed_from_body(seconds: np.ndarray) -> Rotation:
    """Body y against the velocity, -z 30 degrees from nadir to the right of the track, and a small constant error."""
    position, velocity = orbit(seconds)
    y = -velocity / np.linalg.norm(velocity, axis=1)[:, None]
    down = -position - np.sum(-position * y, axis=1)[:, None] * y
    down /= np.linalg.norm(down, axis=1)[:, None]
    right = np.cross(y, down)
    tilt = np.deg2rad(30.0)
    z = -(np.cos(tilt) * down + np.sin(tilt) * right)
    x = np.cross(y, z)
    error = Rotation.from_rotvec([4e-5, 0.0, -7e-5])
    return Rotation.from_matrix(np.stack([x, y, z], axis=2)) * error


def ray_range(position: np.ndarray, direction: np.ndarray, height: float) -> float:
    """Distance along a ray to the ellipsoid, by the quadratic formula."""
    axes = np.array([6378137.0, 6378137.0, 6356752.314245]) + height
    p, d = position / axes, direction / axes
    a, b, c = d @ d, 2 * p @ d, p @ p - 1
    return (-b - np.sqrt(b * b - 4 * a * c)) / (2 * a)


def generated(
    swath: str = "IW2",
    *,
    misalignment: tuple[float, float, float] = (0.0, 0.0, 0.0),
    offset: float = 0.0,
    noise: float = 0.0,
    height: float = 250.0,
    count: int = 9,
) -> str:
    """Annotation of one sub-swath whose antenna is turned against the body by a rotation vector (rad)."""
    first = {"IW1": 3.0, "IW2": 0.0, "IW3": -4.5}[swath]  # elevation of the near edge about -z, degrees
    elevation = -np.deg2rad(np.linspace(-first, -first + 4.5, 20))
    antenna_from_body = Rotation.from_rotvec(misalignment)
    random = np.random.default_rng(abs(hash(swath)) % 100 if noise else 0)
    beams = np.stack([np.sin(elevation), 0 * elevation, -np.cos(elevation)], axis=1)
    rows = []
    for k in range(count):
        t = offset + 2.0 + 2.75 * k
        position, velocity = (a[0] for a in orbit(np.array([t])))
        body = earth_fixed_from_body(np.array([t]))[0]
        tau = np.array([2 / LIGHT * ray_range(position, body.apply(b), height) for b in beams])
        geometry = 2 * CARRIER / LIGHT * body.apply(beams) @ velocity
        measured = 2 * CARRIER / LIGHT * beams @ antenna_from_body.apply(body.inv().apply(velocity))
        measured = measured + random.normal(0, noise, 20) if noise else measured
        fit = [
            " ".join(f"{c:.9e}" for c in np.polynomial.polynomial.polyfit(tau - tau[0], f, 2))
            for f in (geometry, measured)
        ]
        fine = "".join(
            f"<fineDce><slantRangeTime>{s:.15e}</slantRangeTime><frequency>{f:.9e}</frequency></fineDce>"
            for s, f in zip(tau, measured, strict=True)
        )
        rows.append(
            f"<dcEstimate><azimuthTime>{utc(t)}</azimuthTime><t0>{tau[0]:.15e}</t0>"
            f'<geometryDcPolynomial count="3">{fit[0]}</geometryDcPolynomial>'
            f'<dataDcPolynomial count="3">{fit[1]}</dataDcPolynomial><dataDcRmsError>5.0</dataDcRmsError>'
            "<dataDcRmsErrorAboveThreshold>false</dataDcRmsErrorAboveThreshold>"
            f'<fineDceList count="20">{fine}</fineDceList></dcEstimate>'
        )
    seconds = offset + np.arange(0.3, 28.0)
    celestial = Rotation.from_matrix(celestial_from_earth_fixed(tuple(seconds)))
    quaternion = (celestial * earth_fixed_from_body(seconds)).as_quat()  # vector part first
    attitude = "".join(
        f"<attitude><time>{utc(s)}</time><frame>GM2000</frame>"
        + "".join(f"<q{i}>{q[i]:.12e}</q{i}>" for i in range(4))
        + "</attitude>"
        for s, q in zip(seconds, quaternion, strict=True)
    )
    times = np.arange(np.floor(offset / 10) * 10 - 70.0, offset + 91.0, 10.0)
    names = ("x", "y", "z")
    vectors = "".join(
        f"<orbit><time>{utc(s)}</time><frame>Earth Fixed</frame><position>"
        + "".join(f"<{n}>{v:.9e}</{n}>" for n, v in zip(names, p, strict=True))
        + "</position><velocity>"
        + "".join(f"<{n}>{v:.12e}</{n}>" for n, v in zip(names, w, strict=True))
        + "</velocity></orbit>"
        for s, p, w in zip(times, *orbit(times), strict=True)
    )
    return (
        f"<?xml version='1.0'?><product><adsHeader><missionId>S1A</missionId><productType>SLC</productType>"
        f"<polarisation>VV</polarisation><mode>IW</mode><swath>{swath}</swath><startTime>{utc(offset + 1)}</startTime>"
        f"<stopTime>{utc(offset + 27)}</stopTime><missionDataTakeId>7</missionDataTakeId></adsHeader>"
        "<generalAnnotation>"
        f"<productInformation><rangeSamplingRate>6.4e7</rangeSamplingRate><radarFrequency>{CARRIER!r}</radarFrequency>"
        f"</productInformation><orbitList>{vectors}</orbitList><attitudeList>{attitude}</attitudeList>"
        f"<terrainHeightList><terrainHeight><azimuthTime>{utc(offset)}</azimuthTime><value>{height}</value></terrainHeight>"
        f"</terrainHeightList></generalAnnotation><imageAnnotation><imageInformation><slantRangeTime>5.6e-3</slantRangeTime>"
        f"<numberOfSamples>20000</numberOfSamples></imageInformation></imageAnnotation><dopplerCentroid><dcEstimateList>"
        f"{''.join(rows)}</dcEstimateList></dopplerCentroid></product>"
    )


@pytest.fixture(scope="module")
def make(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    folder = tmp_path_factory.mktemp("annotations")

    def write(name: str, text: str | None = None, **options: object) -> Path:
        path = folder / f"{name}.xml"
        path.write_text(generated(**options) if text is None else text)  # type: ignore[arg-type]
        return path

    return write


def predicted(campaign: Campaign, mounting: Rotation | None = None) -> np.ndarray:
    """The campaign file's own measurement model: velocity from the positions alone, plain rotation of the Earth."""
    doppler = campaign.doppler
    assert doppler is not None
    index = np.searchsorted(campaign.star_tracker.time, doppler.time - 1e-6)
    assert np.abs(campaign.star_tracker.time[index] - doppler.time).max() < 1e-6  # attitude known at each epoch
    velocity = np.empty((doppler.time.size, 3))
    for k, t in enumerate(doppler.time):
        near = np.argsort(np.abs(campaign.gnss.time - t))[:8]
        for axis in range(3):
            fit = Polynomial.fit(campaign.gnss.time[near] - t, campaign.gnss.position[near, axis], 7)
            velocity[k, axis] = fit.deriv()(0.0)
    angle = campaign.earth_rotation_angle_at_epoch + campaign.earth_rotation_rate * doppler.time
    inertial = Rotation.from_rotvec(np.outer(angle, [0, 0, 1])).apply(velocity)
    antenna = Rotation.from_quat(campaign.star_tracker.quaternion[index], scalar_first=True).apply(inertial)
    antenna = antenna if mounting is None else mounting.apply(antenna)
    return 2 * doppler.carrier_frequency / LIGHT * np.einsum("nkj,nj->nk", doppler.beam_direction, antenna)


def squint(campaign: Campaign) -> np.ndarray:
    """Rotation about body x and z (rad) that explains measured minus predicted, by linear least squares."""
    doppler = campaign.doppler
    assert doppler is not None
    nominal = predicted(campaign)
    columns = [(predicted(campaign, Rotation.from_rotvec(1e-5 * axis)) - nominal).ravel() / 1e-5 for axis in np.eye(3)]
    matrix = np.stack(columns, axis=1)
    assert np.linalg.norm(matrix[:, 1]) < 1e-3 * np.linalg.norm(matrix[:, 0])  # about the velocity: nothing is seen
    return np.linalg.lstsq(matrix[:, [0, 2]], (doppler.frequency_shift - nominal).ravel(), rcond=None)[0]


# ---------------------------------------------------------------------------------------------------------------- #
# on generated annotations


def test_geometry_doppler_of_a_generated_annotation(make: Callable[..., Path]) -> None:
    for swath in ("IW1", "IW2", "IW3"):
        comparison = compare_geometry(read_annotation(make(f"geometry-{swath}", swath=swath)))
        assert np.abs(comparison.annotated).max() > 1.0  # the attitude error of the generator is seen
        assert np.abs(comparison.ours - comparison.annotated).max() < 0.05  # Hz


def test_campaign_model_reproduces_the_geometry_and_the_misalignment(make: Callable[..., Path]) -> None:
    truth = (1.5e-4, 0.0, -9.0e-5)
    paths = [
        make(f"squint-{swath}", swath=swath, misalignment=truth, offset=offset)
        for swath, offset in (("IW1", 0.0), ("IW2", 0.9), ("IW3", 1.8))
    ]
    campaign = import_sentinel1(paths)
    assert len(campaign.arcs) == 1
    assert campaign.doppler.frequency_shift.shape == (27, 3)
    assert campaign.doppler.beam_direction.shape == (27, 3, 3)
    assert np.abs(campaign.doppler.beam_direction[..., 1]).max() == 0
    residual = campaign.doppler.frequency_shift - predicted(campaign, Rotation.from_rotvec(truth))
    assert np.abs(residual).max() < 0.05
    assert np.abs(squint(campaign) - [truth[0], truth[2]]).max() < 1e-6
    aligned = import_sentinel1([make("aligned")])
    assert np.abs(aligned.doppler.frequency_shift - predicted(aligned)).max() < 0.05


def test_noise_averages_out_as_the_declared_accuracy_says(make: Callable[..., Path]) -> None:
    truth = (1.0e-4, 0.0, 0.0)
    campaign = import_sentinel1(
        [make(f"noisy-{s}", swath=s, misalignment=truth, noise=5.0) for s in ("IW1", "IW2", "IW3")]
    )
    assert (campaign.doppler.standard_deviation == 5.0).all()
    residual = campaign.doppler.frequency_shift - predicted(campaign, Rotation.from_rotvec(truth))
    # white noise of 5 Hz in 20 fine estimates: 1.9 Hz at the nodes of the fit (times correlation in real data)
    assert 1.2 < np.sqrt(np.mean(residual**2)) < 2.8


def test_what_repeats_counts_once(make: Callable[..., Path]) -> None:
    path = make("once")
    other = make("once-vh", path.read_text().replace("<polarisation>VV", "<polarisation>VH"))
    one, two = import_sentinel1([path]), import_sentinel1([path, other, path])
    assert np.array_equal(one.doppler.frequency_shift, two.doppler.frequency_shift)
    assert np.array_equal(one.star_tracker.quaternion, two.star_tracker.quaternion)
    assert np.array_equal(one.gnss.position, two.gnss.position)


def test_acquisitions_far_apart_become_arcs(make: Callable[..., Path]) -> None:
    campaign = import_sentinel1([make("early"), make("late", offset=400.0)])
    assert [arc.kind for arc in campaign.arcs] == ["doppler", "doppler"]
    assert campaign.arcs[1].start - campaign.arcs[0].start == pytest.approx(400.0, abs=1e-3)
    assert np.abs(campaign.doppler.frequency_shift - predicted(campaign)).max() < 0.05


def test_solve_gives_the_squint_and_names_the_turn_that_one_acquisition_leaves_open(
    make: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A turn that is there in truth about the undetermined axis too: the estimate stays at the design value there."""
    truth = np.array([1.5e-4, 2e-3, -9.0e-5])
    paths = [
        make(f"solve-{swath}", swath=swath, misalignment=tuple(truth), offset=offset, noise=3.0)
        for swath, offset in (("IW1", 0.0), ("IW2", 0.9), ("IW3", 1.8))
    ]
    file = tmp_path / "scene.nc"
    write_campaign(import_sentinel1(paths), file)
    with pytest.raises(SystemExit) as stopped:
        main(["solve", str(file), "--json"])
    assert stopped.value.code == 1  # answered, and something asked for is not determined
    answer = json.loads(capsys.readouterr().out)
    assert answer["status"] == "unobservable"
    found = answer["antenna_from_tracker"]
    turn = Rotation.from_quat(found["quaternion"], scalar_first=True).as_rotvec()
    assert abs(turn[1]) < 1e-6  # rad, at the design value
    assert found["sigma_rad"][1] is None and found["sigma_rad"][0] > 0 and found["sigma_rad"][2] > 0
    assert sum("rotation of antenna_from_tracker about the antenna axis" in u for u in answer["unobservable"]) == 1
    assert "rotation of antenna_from_tracker about the antenna axis" in answer["why"]
    assert len(found["determined"]) == 2
    for each in found["determined"]:
        axis = np.array(each["axis"])
        assert abs(axis[1]) < 1e-2 and np.linalg.norm(axis) == pytest.approx(1.0)
        assert abs(each["angle_rad"] - axis @ truth) < 4 * each["sigma_rad"]
        assert 0.01 < each["sigma_scatter_rad"] / each["sigma_rad"] < 3
    best, squint_found = found["determined"][0], found["squint"]
    assert best["sigma_rad"] < found["determined"][1]["sigma_rad"]
    assert squint_found["angle_rad"] == pytest.approx(best["angle_rad"], abs=3e-6)
    assert squint_found["sigma_rad"] == pytest.approx(best["sigma_rad"], rel=0.1)
    assert 3e-6 < squint_found["sigma_rad"] < 2e-5  # 5 Hz a value over 81 values, and 4 Hz of attitude an epoch
    assert "the squint of the beams is determined" in answer["why"]


def test_acquisitions_years_apart_are_solved_together(make: Callable[..., Path]) -> None:
    """Two and a half years apart, and a few minutes: three stretches, the mounting of all, and every row used."""
    truth = (1.5e-4, 0.0, -9.0e-5)
    starts = (-86400.0 * 900, -86400.0 * 900 + 1900.0, 0.0)
    campaign = import_sentinel1(
        [
            make(f"years-{k}-{swath}", swath=swath, misalignment=truth, offset=start)
            for k, start in enumerate(starts)
            for swath in ("IW1", "IW3")
        ]
    )
    solution = solve_campaign(campaign)
    assert len(solution.model.stretches) == 3
    assert len(solution.model.doppler_epochs) == len(campaign.doppler.time) == 54
    assert not solution.model.left_out
    residual = solution.as_dict()["residuals"]["doppler"]
    assert residual["rms"] < 0.1  # Hz: nothing but the orbit's 10 s list and the fit of polynomials
    turn = Rotation.from_quat(solution.antenna_from_tracker, scalar_first=True).as_rotvec()
    assert np.abs(turn[[0, 2]] - [truth[0], truth[2]]).max() < 2e-6


def test_the_start_keeps_the_design_value_where_the_data_are_silent(make: Callable[..., Path]) -> None:
    """Also where the design is turned itself, and where the data contradict each other by many sigmas."""
    paths = [
        make("silent-early", misalignment=(3e-4, 0.0, 0.0)),
        make("silent-late", misalignment=(-3e-4, 0.0, 2e-4), offset=3000.0),
    ]
    campaign = import_sentinel1(paths)
    design = Rotation.from_rotvec([0.01, -0.02, 0.005])
    turned = replace(
        campaign,
        nominal=replace(campaign.nominal, antenna_from_tracker=design.as_quat(scalar_first=True)),
        doppler=replace(campaign.doppler, beam_direction=design.apply(
            campaign.doppler.beam_direction.reshape(-1, 3)).reshape(campaign.doppler.beam_direction.shape)),
    )
    for case, nominal in ((campaign, Rotation.identity()), (turned, design)):
        solution = solve_campaign(case)
        assert solution.status == "model_gap"
        axes = undetermined_axes(solution.estimate, "antenna_from_tracker")
        assert axes.shape == (1, 3)
        away = (Rotation.from_quat(solution.antenna_from_tracker, scalar_first=True) * nominal.inv()).as_rotvec()
        assert abs(away @ axes[0]) < 1e-5
        assert np.linalg.norm(away) < 2e-3


def test_estimates_that_cannot_be_used_are_left_out(make: Callable[..., Path]) -> None:
    text = make("base").read_text()
    flagged = text.replace("AboveThreshold>false", "AboveThreshold>true", 2)
    assert import_sentinel1([make("flagged", flagged)]).doppler.time.size == 7
    early = read_annotation(make("base2"))
    late = [a for a in early.attitude.time if a > early.estimates[4].time]
    cut = text
    for t in early.attitude.time:
        if t >= late[0]:
            stamp = utc((t - tai_from_utc([utc(0)])[0]) / np.timedelta64(1, "s"))
            begin = cut.index(f"<attitude><time>{stamp}")
            cut = cut[:begin] + cut[cut.index("</attitude>", begin) + len("</attitude>") :]
    assert import_sentinel1([make("cut", cut)]).doppler.time.size == 6  # five seconds beyond the attitude at most
    nothing = text.replace("AboveThreshold>false", "AboveThreshold>true")
    with pytest.raises(TooFewDataError, match="no Doppler estimate can be used"):
        import_sentinel1([make("nothing", nothing)])


def orbit_file_text(first: float, last: float, mission: str = "Sentinel-1A", quality: str = "NOMINAL") -> str:
    times = np.arange(first, last, 10.0)
    vectors = "".join(
        f"<OSV><TAI>TAI={utc(s + 37)}</TAI><UTC>UTC={utc(s)}</UTC><UT1>UT1={utc(s)}</UT1>"
        + "".join(
            f'<{n} unit="m">{v:.6f}</{n}>' for n, v in zip(("X", "Y", "Z", "VX", "VY", "VZ"), [*p, *w], strict=True)
        )
        + f"<Quality>{quality}</Quality></OSV>"
        for s, p, w in zip(times, *orbit(times), strict=True)
    )
    return (
        f"<Earth_Explorer_File><Earth_Explorer_Header><Fixed_Header><Mission>{mission}</Mission>"
        "<File_Type>AUX_RESORB</File_Type></Fixed_Header><Variable_Header><Ref_Frame>EARTH_FIXED</Ref_Frame>"
        "<Time_Reference>UTC</Time_Reference></Variable_Header></Earth_Explorer_Header><Data_Block><List_of_OSVs>"
        f"{vectors}</List_of_OSVs></Data_Block></Earth_Explorer_File>"
    )


def test_an_orbit_file_takes_the_place_of_the_annotated_orbit(make: Callable[..., Path], tmp_path: Path) -> None:
    eof = tmp_path / "a.EOF"
    eof.write_text(orbit_file_text(-703.0, 800.0))
    found = read_orbit_file(eof)
    assert (found.mission, found.kind, found.orbit.time.size) == ("S1A", "AUX_RESORB", 151)
    campaign = import_sentinel1([make("with-orbit")], [eof])
    assert np.abs(campaign.doppler.frequency_shift - predicted(campaign)).max() < 0.05
    assert 20 <= campaign.gnss.time.size <= 24  # 100 s on both sides, and no more
    for name, text in (
        ("elsewhere", orbit_file_text(-9000.0, -7000.0)),
        ("other", orbit_file_text(-703.0, 800.0, "Sentinel-1B")),
    ):
        (tmp_path / f"{name}.EOF").write_text(text)
        with pytest.raises(RequestError, match="covers none of the acquisitions"):
            import_sentinel1([make("with-orbit")], [tmp_path / f"{name}.EOF"])


def test_command_line_writes_a_campaign_that_reads_back(make: Callable[..., Path], tmp_path: Path) -> None:
    app = typer.Typer()
    app.command("sentinel1")(commands_import.import_sentinel1)
    app.command("other")(lambda: None)
    eof, out = tmp_path / "a.EOF", tmp_path / "out.nc"
    eof.write_text(orbit_file_text(-703.0, 800.0))
    answer = CliRunner().invoke(app, ["sentinel1", str(make("cli")), str(eof), str(out), "--json"])
    assert answer.exit_code == 0
    result = json.loads(answer.stdout)
    assert result["status"] == "ok"
    assert result["doppler_estimates"] == read_campaign(out).doppler.time.size == 9
    before = out.read_bytes()
    broken = make("broken", "<product><adsHeader>")
    answer = CliRunner().invoke(app, ["sentinel1", str(broken), str(out), "--json"])
    assert answer.exit_code == 2
    assert json.loads(answer.stdout)["status"] == "bad_input"
    assert out.read_bytes() == before
    answer = CliRunner().invoke(app, ["sentinel1", str(make("cli")), "--json"])
    assert answer.exit_code == 2
    assert "OUT.nc" in json.loads(answer.stdout)["why"]


BOMB = (
    '<?xml version="1.0"?><!DOCTYPE product [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">'
    '<!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;&b;&b;">]><product><adsHeader>&c;</adsHeader></product>'
)
OUTSIDE = (
    '<?xml version="1.0"?><!DOCTYPE product [<!ENTITY a SYSTEM "file:///etc/hostname">]>'
    "<product><adsHeader>&a;</adsHeader></product>"
)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("bomb", BOMB, "entities"),
        ("outside", OUTSIDE, "entities"),
        ("doctype", "<!DOCTYPE product><product/>", "document type"),
        ("cut", "<product><adsHeader>", "well-formed"),
        ("empty", "", "well-formed"),
        ("binary", "\x00\x01\x02", "well-formed"),
        ("foreign", "<html><body/></html>", "no Sentinel-1 product annotation"),
        ("calibration", "<calibration><adsHeader/></calibration>", "no Sentinel-1 product annotation"),
    ],
)
def test_xml_that_is_refused(name: str, text: str, words: str, make: Callable[..., Path]) -> None:
    path = make(f"refused-{name}", text)
    with pytest.raises(FileFormatError, match=words):
        read_annotation(path)
    with pytest.raises(FileFormatError):
        read_orbit_file(path)


@pytest.mark.parametrize(
    ("old", "new", "error", "words"),
    [
        ("<frame>GM2000", "<frame>ITRF", FileFormatError, "another frame.*ITRF"),
        ("<frame>Earth Fixed", "<frame>TEME", FileFormatError, "another frame.*TEME"),
        ("attitudeList", "otherList", MissingDataError, "attitudeList"),
        ("dcEstimateList", "otherList", MissingDataError, "dcEstimateList"),
        ("radarFrequency", "otherFrequency", MissingDataError, "radarFrequency"),
        ("<dataDcRmsError>5.0", "<dataDcRmsError>nan", NotFiniteError, "dataDcRmsError"),
        ("<dataDcRmsError>5.0", "<dataDcRmsError>five", FileFormatError, "dataDcRmsError.*five"),
        ("<q3>", "<q3>1", QuaternionError, "unit length"),
        ("T08:22:1", "T28:22:1", FileFormatError, "no UTC date"),
    ],
)
def test_annotations_that_are_wrong(
    old: str, new: str, error: type[InputError], words: str, make: Callable[..., Path]
) -> None:
    text = make("right").read_text()
    assert old in text
    with pytest.raises(error, match=words):
        read_annotation(make("wrong", text.replace(old, new)))


def test_requests_that_have_no_meaning(make: Callable[..., Path], tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="no annotation"):
        import_sentinel1([])
    path = make("a-satellite")
    other = make("another-satellite", path.read_text().replace("<missionId>S1A", "<missionId>S1B"))
    with pytest.raises(RequestError, match=r"several satellites.*S1A, S1B"):
        import_sentinel1([path, other])
    with pytest.raises(FileFormatError, match="cannot be read"):
        import_sentinel1([tmp_path / "nowhere.xml"])
    degraded = tmp_path / "a.EOF"
    degraded.write_text(orbit_file_text(0.0, 50.0, quality="DEGRADED"))
    with pytest.raises(MissingDataError, match="no state vectors"):
        read_orbit_file(degraded)
    position, _ = orbit(np.zeros(1))
    with pytest.raises(GeometryError, match="slant range"):
        beam_directions(np.array([[1e-3]]), position, earth_fixed_from_body(np.zeros(1)), np.zeros(1))


# ---------------------------------------------------------------------------------------------------------------- #
# time and the Earth


def test_time_scales_across_a_leap_second() -> None:
    before, inside, after = tai_from_utc(["2016-12-31T23:59:59", "2016-12-31T23:59:60.5", "UTC=2017-01-01T00:00:00Z"])
    assert after - before == np.timedelta64(2, "s")
    assert inside - before == np.timedelta64(1500, "ms")
    assert before == np.datetime64("2017-01-01T00:00:35")  # TAI is 36 s ahead
    assert utc_text(inside) == "2016-12-31T23:59:60.500000Z"
    for text in ("", "now", "2021-13-01T00:00:00", "2021-06-04"):
        with pytest.raises(FileFormatError):
            tai_from_utc([text])


@settings(max_examples=50, deadline=None)
@given(st.datetimes(min_value=datetime(1993, 1, 1), max_value=datetime(2026, 1, 1)))
def test_text_and_instant_are_inverse(instant: datetime) -> None:
    text = instant.isoformat()
    found = utc_text(tai_from_utc([text])[0])
    assert tai_from_utc([found])[0] == tai_from_utc([text])[0]
    assert found[:19] == text[:19]


def test_earth_orientation_against_another_chain_of_frames() -> None:
    seconds = (0.0, 3600.0, 86400.0 * 100, -86400.0 * 2000)
    ours = earth_fixed_from_celestial(tai_from_utc([utc(s) for s in seconds]))
    other = celestial_from_earth_fixed(seconds)
    assert np.abs(ours @ other - np.eye(3)).max() < 2e-8  # rad; the other chain has its own bulletin interpolation
    # Earth rotation angle at J2000.0 (UT1): 0.7790572732640 turns; UT1 - UTC was 0.355 s then
    angle = earth_rotation_angle(tai_from_utc(["2000-01-01T12:00:00"])[0])
    assert angle == pytest.approx(2 * np.pi * 0.7790572732640 + 7.2921151467e-5 * 0.355, abs=1e-7)
    with pytest.raises(InputError, match="orientation is not known"):
        earth_fixed_from_celestial(tai_from_utc(["1960-01-01T00:00:00"]) + np.timedelta64(365 * 300, "D"))


# ---------------------------------------------------------------------------------------------------------------- #
# on measured annotations


@pytest.fixture(scope="module")
def annotations() -> list[Annotation]:
    return [read_annotation(path) for path in FILES]


@needs_data
def test_geometry_doppler_of_every_measured_annotation(annotations: list[Annotation]) -> None:
    assert len(annotations) >= 37
    difference = {a.path.name: (lambda c: c.ours - c.annotated)(compare_geometry(a)) for a in annotations}
    everything = np.concatenate([d.ravel() for d in difference.values()])
    assert np.sqrt(np.mean(everything**2)) < 1.0  # Hz over all files
    for name, d in difference.items():
        assert np.abs(d).max() < 2.5, name  # Hz in the worst


@needs_data
def test_the_processor_leaves_out_polar_motion_and_ut1(annotations: list[Annotation]) -> None:
    """With the simplifications of the processor nothing constant is left in any file."""
    compared = [compare_geometry(a) for a in annotations]
    processed = [c.as_processed - c.annotated for c in compared]
    full = [c.ours - c.annotated for c in compared]
    assert np.sqrt(np.mean(np.concatenate([d.ravel() for d in processed]) ** 2)) < 0.4
    assert max(abs(np.mean(d)) for d in processed) < 0.2
    assert max(abs(np.mean(d)) for d in full) > 1.5


@needs_data
def test_campaigns_of_measured_scenes_reproduce_the_geometry(annotations: list[Annotation]) -> None:
    takes: dict[tuple[str, str], list[Annotation]] = {}
    for annotation in annotations:
        takes.setdefault((annotation.mission, annotation.data_take), []).append(annotation)
    assert len(takes) >= 11
    squares, count = 0.0, 0
    for group in takes.values():
        campaign = campaign_of(group)
        model = predicted(campaign)
        epoch = tai_from_utc([campaign.epoch])[0]
        for annotation in group:
            for estimate in annotation.estimates:
                seconds = (estimate.time - epoch) / np.timedelta64(1, "us") * 1e-6
                row = np.flatnonzero(np.abs(campaign.doppler.time - seconds) < 1e-5)
                if row.size != 1:
                    continue  # not trusted, or the same estimate in another slice
                first, last = slant_interval(annotation, estimate)
                slant = (first + last) / 2 + (last - first) / 2 * np.polynomial.legendre.leggauss(3)[0]
                difference = model[row[0]] - polynomial_value(estimate.geometry, slant, estimate.reference)
                assert np.abs(difference).max() < 2.5
                squares, count = squares + float(difference @ difference), count + 3
    assert count > 900
    assert np.sqrt(squares / count) < 1.0


@needs_data
def test_measured_squints_are_what_the_annotations_say(annotations: list[Annotation]) -> None:
    """Measured minus predicted Doppler, divided by the Doppler rate of squint, within the scatter of the scene."""
    group = [a for a in annotations if a.mission == "S1B"]
    campaign = campaign_of(group)
    difference = np.mean([np.mean(c.measured - c.ours) for c in map(compare_geometry, group)])  # Hz
    about_x, about_z = squint(campaign)
    middle = np.median(np.arctan2(campaign.doppler.beam_direction[..., 0], -campaign.doppler.beam_direction[..., 2]))
    speed = 7590.0  # [m/s]
    along = about_x * np.cos(middle) + about_z * np.sin(middle)
    assert along * 2 * CARRIER / LIGHT * speed == pytest.approx(difference, abs=1.0)
    assert 15 < abs(difference) < 30  # Hz


@needs_data
def test_every_measured_scene_together_is_solved(annotations: list[Annotation]) -> None:
    """Eleven years in one campaign: a stretch an acquisition, the plain mounting does not explain them."""
    campaign = campaign_of([a for a in annotations if a.mission == "S1A"])
    solution = solve_campaign(campaign)
    assert len(solution.model.doppler_epochs) == len(campaign.doppler.time) > 300
    assert len(solution.model.stretches) >= 10
    answer = solution.as_dict()
    assert answer["status"] == "model_gap"
    assert answer["residuals"]["gnss"]["rms"] < 0.1  # m
    assert 10 < answer["residuals"]["doppler"]["rms"] < 15  # Hz
    squint_found = answer["antenna_from_tracker"]["squint"]
    assert abs(np.rad2deg(squint_found["angle_rad"])) < 2e-3
    assert squint_found["sigma_scatter_rad"] > 5 * squint_found["sigma_rad"]  # scenes differ by more than their noise
    turn = Rotation.from_quat(answer["antenna_from_tracker"]["quaternion"], scalar_first=True).as_rotvec()
    assert abs(turn[1]) < 1e-6


@needs_data
@pytest.mark.skipif(not (DATA / "orbits").is_dir(), reason=f"no measured orbit files at {DATA / 'orbits'}")
def test_measured_orbit_file_agrees_with_the_annotation(annotations: list[Annotation]) -> None:
    eof = next((DATA / "orbits").glob("*V20220918*"))
    scene = next(a.path for a in annotations if "20220918" in a.path.name)
    found = read_orbit_file(eof)
    assert (found.mission, found.orbit.time.size) == ("S1A", 1186)
    with_file, without = import_sentinel1([scene], [eof]), import_sentinel1([scene])
    assert np.abs(predicted(with_file) - predicted(without)).max() < 0.5  # Hz
