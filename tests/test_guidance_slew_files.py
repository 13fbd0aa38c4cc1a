"""Request files, the slew command and the exported files, read again by readers that share nothing with the writers."""

from __future__ import annotations

import json
import math
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from estimator.models.errors import (
    FileFormatError,
    InputError,
    MissingDataError,
    NotFiniteError,
    QuaternionError,
    RequestError,
    ShapeError,
    TimeOrderError,
    UnitError,
)
from guidance import kinematics as kin
from guidance.export.aem import write_aem
from guidance.export.by_suffix import write_attitude
from guidance.export.oem import write_oem
from guidance.export.series import AttitudeSeries, OrbitSeries, sampling_times, series_of
from guidance.jerk_profile import JerkProfile
from guidance.slew_request import read_slew_request, slew_request_from
from problems.area_survey.commands_slew import slew as command

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "slew.toml"


def example() -> dict[str, Any]:
    return tomllib.loads(EXAMPLE.read_text())


def wavy_series(**names: str) -> tuple[JerkProfile, AttitudeSeries]:
    """Two minutes of a motion through more than half a turn, so that the quaternion passes through zero scalar."""
    random = np.random.default_rng(21)
    profile = JerkProfile(kin.exponential(np.array([1.0, -2.0, 1.5])), np.array([0.03, -0.02, 0.025]), np.zeros(3),
                          np.full(12, 10.0), 2e-5 * random.normal(size=(12, 3)))
    times = sampling_times(profile.duration, 0.5)
    return profile, series_of(times, profile.motion(times), **names)


# ----------------------------------------------------------------------------------------------- requests


def test_example_is_read() -> None:
    request = read_slew_request(EXAMPLE)
    assert request.limits.rate == pytest.approx(2.5 * math.pi / 180)
    assert request.stop.jerk is None
    assert np.allclose(request.stop.rate, [0.002, 0, -0.008])
    assert request.export.object_name == "IMAGER"


BAD: list[tuple[str, Any, type[InputError], str]] = [
    ("start.quaternion", [1.0, 0.1, 0, 0], QuaternionError, "unit length"),
    ("start.quaternion", [1.0, 0, 0], QuaternionError, "four"),
    ("start.quaternion", "north", RequestError, "start.quaternion"),
    ("stop.quaternion", [float("nan"), 0, 0, 0], NotFiniteError, "stop.quaternion"),
    ("limits.rate", 0.0, RequestError, "limits.rate"),
    ("limits.jerk", -1.0, RequestError, "positive"),
    ("limits.rate", 2.5, UnitError, "degrees"),
    ("limits.rate", True, RequestError, "number"),
    ("start.rate", [0.05, 0, 0], RequestError, "above the limit"),
    ("start.rate", [0.6, 0, 0], RequestError, "degrees"),
    ("stop.acceleration", [0.01, 0, 0], RequestError, "above the limit"),
    ("stop.jerk", [0.01, 0, 0], RequestError, "above the limit"),
    ("stop.rate", [0.0, 0.0], ShapeError, "3 numbers"),
    ("stop.rate", [0.0, 0.0, float("inf")], NotFiniteError, "finite"),
    ("limits.rate_deg_s", 2.5, RequestError, "unknown key"),
    ("start.jerk", [0.0, 0.0, 0.0], RequestError, "unknown key"),
    ("objective", {"kind": "fuel"}, RequestError, "objective"),
    ("objective", {"kind": "smoothness"}, MissingDataError, "duration"),
    ("solver", {"name": "snopt"}, RequestError, "ipopt"),
    ("export", {"epoch": "yesterday"}, RequestError, "epoch"),
    ("keep_out", [{"axis": [0, 0, 0], "direction": [1, 0, 0], "angle": 0.3}], RequestError, "length zero"),
    ("keep_out", [{"axis": [1, 0, 0], "direction": [1, 0, 0], "angle": 30.0}], RequestError, "radians"),
    ("keep_out", [{"axis": [1, 0, 0], "angle": 0.3}], MissingDataError, "direction"),
    ("actuators", {"torque": 3.0}, MissingDataError, "inertia"),
    ("actuators", {"inertia": [1.0, 1.0, 5.0], "torque": 3.0}, RequestError, "no body"),
]


@pytest.mark.parametrize("where, value, error, words", BAD)
def test_bad_request_has_its_own_error(where: str, value: Any, error: type[InputError], words: str) -> None:
    document = example()
    table, _, key = where.partition(".")
    if key:
        document[table][key] = value
    else:
        document[table] = value
    with pytest.raises(error, match=words):
        slew_request_from(document)


@pytest.mark.parametrize("table, key", [("limits", ""), ("start", ""), ("stop", ""), ("limits", "jerk"),
                                        ("stop", "quaternion")])
def test_missing_table_or_key_is_named(table: str, key: str) -> None:
    document = example()
    if key:
        del document[table][key]
    else:
        del document[table]
    with pytest.raises(MissingDataError, match=table):
        slew_request_from(document)


def test_file_that_is_not_there_or_not_toml(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="no such file"):
        read_slew_request(tmp_path / "none.toml")
    (tmp_path / "broken.toml").write_text("[limits\nrate = ")
    with pytest.raises(FileFormatError, match="TOML"):
        read_slew_request(tmp_path / "broken.toml")


# ------------------------------------------------------------------------------------------- strict readers


def parsed_message(path: Path) -> tuple[dict[str, str], list[str]]:
    """Header and metadata as a dictionary, and the data lines; every line must be one of the message's own."""
    fields: dict[str, str] = {}
    data: list[str] = []
    state = "header"
    for line in path.read_text(encoding="ascii").splitlines():
        if not line.strip():
            continue
        if line in ("META_START", "META_STOP", "DATA_START", "DATA_STOP"):
            expected = {"META_START": "header", "META_STOP": "meta", "DATA_START": "after", "DATA_STOP": "data"}
            assert state == expected[line]
            state = {"META_START": "meta", "META_STOP": "after", "DATA_START": "data", "DATA_STOP": "end"}[line]
        elif state in ("header", "meta"):
            if line.startswith("COMMENT "):
                assert state == "meta"
                assert not any(k.startswith(("OBJECT", "REF")) for k in fields)
                continue
            key, equals, value = line.partition(" = ")
            assert equals
            assert value.strip()
            assert key not in fields
            fields[key] = value
        else:
            data.append(line)
    if "CCSDS_AEM_VERS" in fields:
        assert state == "end"
    return fields, data


def seconds_after(first: str, instants: list[str]) -> np.ndarray:
    """Seconds between calendar instants of one scale without leap seconds, exact to the nanosecond."""
    stamps = np.array(instants, dtype="datetime64[ns]")
    return (stamps - np.datetime64(first, "ns")).astype(np.int64) * 1e-9


def test_aem_version_2_holds_the_attitude_to_a_nanoradian(tmp_path: Path) -> None:
    profile, series = wavy_series(epoch="2025-06-21T08:30:00.25", object_name="IMAGER", object_id="2025-001A")
    write_aem(tmp_path / "a.aem", series, comment="one line")
    fields, data = parsed_message(tmp_path / "a.aem")
    assert fields["CCSDS_AEM_VERS"] == "2.0"
    assert (fields["REF_FRAME_A"], fields["REF_FRAME_B"]) == ("EME2000", "SC_BODY_1")
    assert fields["ATTITUDE_TYPE"] == "QUATERNION/ANGVEL"
    assert fields["ANGVEL_FRAME"] == "SC_BODY_1"
    assert "QUATERNION_TYPE" not in fields
    assert "ATTITUDE_DIR" not in fields
    rows = [line.split() for line in data]
    assert all(len(r) == 8 for r in rows)
    assert fields["START_TIME"] == rows[0][0]
    assert fields["STOP_TIME"] == rows[-1][0]
    assert len(rows) > int(fields["INTERPOLATION_DEGREE"])
    t = seconds_after("2025-06-21T08:30:00.25", [r[0] for r in rows])
    assert np.allclose(t, series.times, atol=1e-12)
    values = np.array([[float(v) for v in r[1:]] for r in rows])
    q = np.concatenate([values[:, 3:4], values[:, :3]], axis=1)
    truth = profile.motion(t)
    assert np.max(kin.angle_between(q, truth.quaternion)) < 1e-9
    assert np.allclose(np.radians(values[:, 4:]), truth.rate, atol=1e-14)
    assert np.all(np.sum(q[1:] * q[:-1], axis=1) > 0.99)
    assert np.any(q[:, 0] < 0)  # it does pass through zero


def test_aem_version_1_states_direction_and_order(tmp_path: Path) -> None:
    _, series = wavy_series()
    write_aem(tmp_path / "a.aem", series, version=1)
    fields, data = parsed_message(tmp_path / "a.aem")
    assert fields["CCSDS_AEM_VERS"] == "1.0"
    assert fields["ATTITUDE_DIR"] == "A2B"
    assert fields["QUATERNION_TYPE"] == "LAST"
    assert fields["ATTITUDE_TYPE"] == "QUATERNION"
    last = np.array([float(v) for v in data[-1].split()[1:]])
    assert np.allclose(last[[3, 0, 1, 2]], series.quaternion[-1], atol=1e-15)
    with pytest.raises(RequestError):
        write_aem(tmp_path / "b.aem", series, version=3)


def test_leap_second_is_in_the_calendar(tmp_path: Path) -> None:
    times = np.array([0.0, 1.0, 2.0])
    series = AttitudeSeries(times, np.tile([1.0, 0, 0, 0], (3, 1)), np.zeros((3, 3)), epoch="2016-12-31T23:59:59")
    write_aem(tmp_path / "a.aem", series)
    _, data = parsed_message(tmp_path / "a.aem")
    assert [r.split()[0] for r in data] == ["2016-12-31T23:59:59.000000000", "2016-12-31T23:59:60.000000000",
                                            "2017-01-01T00:00:00.000000000"]


@pytest.fixture(scope="module")
def orekit(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Orekit in a Java machine of its own, with leap seconds and an Earth that has a name and a mass, nothing else."""
    package = pytest.importorskip("orekit_jpype", reason="orekit-jpype is not installed")
    import jpype

    if not jpype.isJVMStarted():
        try:
            package.initVM()
        except (jpype.JVMNotFoundException, OSError, RuntimeError) as error:
            pytest.skip(f"no Java machine: {error}")
    from java.io import File
    from org.orekit.data import DataContext, DataSource, DirectoryCrawler
    from org.orekit.files.ccsds.ndm import ParserBuilder

    folder = tmp_path_factory.mktemp("orekit")
    (folder / "tai-utc.dat").write_text("".join(
        f" {year} {month} =JD {day}  TAI-UTC= {offset:5.1f}       S + (MJD - 41317.) X 0.0      S\n"
        for year, month, day, offset in ((1972, "JAN  1", 2441317.5, 10), (2015, "JUL  1", 2457204.5, 36),
                                         (2017, "JAN  1", 2457754.5, 37))))

    @jpype.JImplements("org.orekit.bodies.CelestialBody", deferred=True)
    class Earth:
        """The centre that the metadata name; its ephemeris is never asked for."""

        @jpype.JOverride
        def getName(self) -> str:
            return "Earth"

        @jpype.JOverride
        def getGM(self) -> float:
            return 3.986004418e14  # m3/s2

        def _none(self, *arguments: Any) -> Any:
            raise NotImplementedError

        getInertiallyOrientedFrame = getBodyOrientedFrame = toFieldPVCoordinatesProvider = jpype.JOverride(_none)
        getPVCoordinates = getPosition = jpype.JOverride(_none)

    @jpype.JImplements("org.orekit.bodies.CelestialBodyLoader", deferred=True)
    class Loader:
        """Gives that Earth."""

        @jpype.JOverride
        def loadCelestialBody(self, name: str) -> Any:
            return Earth()

    context = DataContext.getDefault()
    context.getDataProvidersManager().addProvider(DirectoryCrawler(File(str(folder))))
    context.getCelestialBodies().addCelestialBodyLoader("Earth", Loader())

    def read(path: Path) -> Any:
        builder = ParserBuilder()
        parser = builder.buildAemParser() if path.suffix == ".aem" else builder.buildOemParser()
        return parser.parseMessage(DataSource(File(str(path)))).getSegments()

    return read


def orekit_attitudes(segment: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Seconds from the first instant, ``inertial_from_body`` and body rate, as Orekit applies them to vectors."""
    from org.hipparchus.geometry.euclidean.threed import Vector3D
    from scipy.spatial.transform import Rotation

    times, matrices, rates = [], [], []
    coordinates = segment.getAngularCoordinates()
    first = coordinates.get(0).getDate()
    for c in coordinates:
        times.append(c.getDate().durationFrom(first))
        # columns: body coordinates of the inertial axes
        columns = [c.getRotation().applyTo(axis) for axis in (Vector3D.PLUS_I, Vector3D.PLUS_J, Vector3D.PLUS_K)]
        matrices.append([[v.getX(), v.getY(), v.getZ()] for v in columns])
        w = c.getRotationRate()
        rates.append([w.getX(), w.getY(), w.getZ()])
    q = Rotation.from_matrix(np.array(matrices)).as_quat(scalar_first=True)
    return np.array(times), q, np.array(rates)


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("time_system, frame", [("UTC", "EME2000"), ("UTC", "GCRF"), ("TAI", "EME2000"),
                                                ("TT", "EME2000"), ("GPS", "GCRF")])
def test_aem_is_read_by_orekit(tmp_path: Path, orekit: Any, version: int, time_system: str, frame: str) -> None:
    profile, series = wavy_series(epoch="2016-12-31T23:59:30", time_system=time_system, reference_frame=frame)
    write_aem(tmp_path / "a.aem", series, version=version, comment="across a leap second of UTC")
    segments = orekit(tmp_path / "a.aem")
    assert segments.size() == 1
    metadata = segments.get(0).getMetadata()
    endpoints = metadata.getEndpoints()
    assert endpoints.getFrameA().getName() == frame
    assert endpoints.getFrameB().getName() == "SC_BODY_1"
    assert endpoints.isA2b()
    assert metadata.getTimeSystem().name() == time_system
    times, q, rates = orekit_attitudes(segments.get(0))
    assert np.allclose(times, series.times, atol=2e-9)
    truth = profile.motion(series.times)
    assert np.max(kin.angle_between(q, truth.quaternion)) < 1e-9
    if version == 2:
        assert np.allclose(rates, truth.rate, atol=1e-12)


def test_files_of_the_slew_command_and_an_orbit_are_read_by_orekit(tmp_path: Path, orekit: Any) -> None:
    run, application = runner()
    assert run.invoke(application, [str(EXAMPLE), "--json", "--export", str(tmp_path / "s.aem")]).exit_code == 0
    request = read_slew_request(EXAMPLE)
    _, q, rates = orekit_attitudes(orekit(tmp_path / "s.aem").get(0))
    assert kin.angle_between(q[0], request.start.quaternion) < 1e-9
    assert np.allclose(rates[0], request.start.rate, atol=1e-12)
    assert kin.angle_between(q[-1], request.stop.quaternion) < 1e-8  # the end of the file is on a nanosecond
    assert np.allclose(rates[-1], request.stop.rate, atol=1e-8)
    times = np.arange(10.0)
    position = 7e6 * np.stack([np.cos(times / 900), np.sin(times / 900), 0 * times], axis=1)
    velocity = 7e6 / 900 * np.stack([-np.sin(times / 900), np.cos(times / 900), 0 * times], axis=1)
    write_oem(tmp_path / "a.oem", OrbitSeries(times, position, velocity, epoch="2025-06-21T08:30:00",
                                              reference_frame="GCRF"))
    segment = orekit(tmp_path / "a.oem").get(0)
    assert segment.getMetadata().getReferenceFrame().getName() == "GCRF"
    for k, state in enumerate(segment.getCoordinates()):
        p, v = state.getPosition(), state.getVelocity()
        assert np.allclose([p.getX(), p.getY(), p.getZ()], position[k], atol=1e-6)
        assert np.allclose([v.getX(), v.getY(), v.getZ()], velocity[k], atol=1e-9)


def test_oem_holds_the_orbit_in_kilometres(tmp_path: Path) -> None:
    times = np.arange(10.0)
    position = 7e6 * np.stack([np.cos(times / 900), np.sin(times / 900), 0 * times], axis=1)
    velocity = np.gradient(position, axis=0)
    write_oem(tmp_path / "a.oem", OrbitSeries(times, position, velocity, epoch="2025-06-21T08:30:00"))
    fields, data = parsed_message(tmp_path / "a.oem")
    assert (fields["CENTER_NAME"], fields["REF_FRAME"], fields["TIME_SYSTEM"]) == ("EARTH", "EME2000", "UTC")
    rows = np.array([[float(v) for v in line.split()[1:]] for line in data])
    assert np.allclose(rows[:, :3] * 1e3, position, atol=1e-6)
    assert np.allclose(rows[:, 3:] * 1e3, velocity, atol=1e-9)


@pytest.mark.parametrize("time_system", ["UTC", "TDB", "GPS"])
def test_ck_is_read_by_spice(tmp_path: Path, time_system: str) -> None:
    spice = pytest.importorskip("spiceypy")
    profile, series = wavy_series(epoch="2025-06-21T08:30:00", time_system=time_system, object_name="IMAGER")
    files = write_attitude(tmp_path / "a.bc", series)
    (tmp_path / "leap.tls").write_text(
        "KPL/LSK\n\\begindata\nDELTET/DELTA_T_A = 32.184\nDELTET/K = 1.657D-3\nDELTET/EB = 1.671D-2\n"
        "DELTET/M = ( 6.239996D0 1.99096871D-7 )\nDELTET/DELTA_AT = ( 37, @2017-JAN-1 )\n\\begintext\n")
    try:
        spice.furnsh(str(tmp_path / "leap.tls"))
        for file in files:
            spice.furnsh(str(file))
        text = {"UTC": "2025-06-21T08:30:00", "TDB": "2025 JUN 21 08:30:00 TDB",
                "GPS": "2025-06-21T08:29:42"}[time_system]  # GPS is 18 s ahead of UTC
        # Ephemeris time in double precision has steps of 1.2e-7 s, in which this body turns by 5e-9 rad: the calendar
        # must agree to such steps, and the attitude is compared at the instants of the spacecraft's own clock.
        begin = spice.sct2e(-999, 0.0)
        assert abs(begin - spice.str2et(text)) < 2.5e-7
        for t in (0.0, 10.0, 60.5, 119.75, 120.0):
            matrix = spice.sxform("J2000", "IMAGER_BODY", begin + t)
            body_from_inertial, rate = spice.xf2rav(matrix)
            truth = profile.motion(np.array([t]))
            q = kin.conjugate(spice.m2q(body_from_inertial))
            # between the knots SPICE turns at a constant rate: exact on them, near them elsewhere
            tolerance = 1e-9 if t != 119.75 else 1e-4
            assert kin.angle_between(q, truth.quaternion[0]) < tolerance
            assert np.allclose(body_from_inertial @ rate, truth.rate[0], atol=1e-9 if t != 119.75 else 1e-4)
    finally:
        spice.kclear()


def test_stk_csv_and_netcdf(tmp_path: Path) -> None:
    import xarray as xr

    _, series = wavy_series(epoch="2025-06-21T08:30:00")
    for ending in ("a", "csv", "nc"):
        write_attitude(tmp_path / f"f.{ending}", series)
    lines = (tmp_path / "f.a").read_text().splitlines()
    assert lines[0].startswith("stk.v.")
    assert "ScenarioEpoch 21 Jun 2025 08:30:00.000000000" in lines
    assert f"NumberOfAttitudePoints {len(series.times)}" in lines
    begin = lines.index("AttitudeTimeQuaternions") + 1
    rows = np.array([[float(v) for v in line.split()] for line in lines[begin:lines.index("END Attitude")]])
    assert np.allclose(rows[:, 0], series.times)
    assert np.max(kin.angle_between(rows[:, [4, 1, 2, 3]], series.quaternion)) < 1e-9
    table = np.genfromtxt(tmp_path / "f.csv", delimiter=",", names=True, skip_header=3)
    assert np.array_equal(table["q_w"], series.quaternion[:, 0])
    assert np.array_equal(table["rate_z_rad_s"], series.rate[:, 2])
    with xr.open_dataset(tmp_path / "f.nc", engine="h5netcdf") as data:
        assert np.array_equal(data["quaternion"].values, series.quaternion)
        assert data["rate"].attrs["units"] == "rad s-1"
        assert data.attrs["epoch"] == "2025-06-21T08:30:00"
    with pytest.raises(RequestError, match="ending"):
        write_attitude(tmp_path / "f.txt", series)


def test_series_that_readers_would_take_without_a_word_are_refused() -> None:
    t, q, w = np.array([0.0, 1.0]), np.tile([1.0, 0, 0, 0], (2, 1)), np.zeros((2, 3))
    with pytest.raises(TimeOrderError):
        AttitudeSeries(t[::-1], q, w)
    with pytest.raises(QuaternionError):
        AttitudeSeries(t, 1.1 * q, w)
    with pytest.raises(NotFiniteError):
        AttitudeSeries(t, q, w * np.nan)
    with pytest.raises(ShapeError):
        AttitudeSeries(t[:1], q[:1], w[:1])
    with pytest.raises(RequestError):
        AttitudeSeries(t, q, w, time_system="local")
    with pytest.raises(NotFiniteError):
        OrbitSeries(t, np.full((2, 3), np.inf), w)


# ------------------------------------------------------------------------------------------------ the command


def runner() -> tuple[CliRunner, typer.Typer]:
    application = typer.Typer()
    application.command("slew")(command)
    return CliRunner(), application


def test_command_answers_in_json_and_exports(tmp_path: Path) -> None:
    run, application = runner()
    target = tmp_path / "out.aem"
    result = run.invoke(application, [str(EXAMPLE), "--json", "--export", str(target)])
    assert result.exit_code == 0
    answer = json.loads(result.stdout)
    assert answer["status"] == "ok"
    assert answer["lower_bound_s"] < answer["duration_s"] < answer["closed_form"]["mrp5"]["duration_s"]
    request = read_slew_request(EXAMPLE)
    for name, value in answer["largest"].items():
        assert value <= getattr(request.limits, name) * (1 + 1e-6)
    assert answer["terminal_error_rad"] < 4.8e-8
    _, data = parsed_message(target)
    first, last = (np.array([float(v) for v in data[k].split()[1:]]) for k in (0, -1))
    assert kin.angle_between(first[[3, 0, 1, 2]], request.start.quaternion) < 1e-9
    assert kin.angle_between(last[[3, 0, 1, 2]], request.stop.quaternion) < 1e-8
    assert np.allclose(np.radians(last[4:]), request.stop.rate, atol=1e-8)


def test_command_reports_bad_and_infeasible_requests_by_exit_status(tmp_path: Path) -> None:
    run, application = runner()
    text = EXAMPLE.read_text()
    bad = tmp_path / "bad.toml"
    bad.write_text(text.replace("quaternion = [1.0, 0.0, 0.0, 0.0]", "quaternion = [1.0, 0.0, 0.5, 0.0]"))
    result = run.invoke(application, [str(bad), "--json"])
    assert result.exit_code == 2
    assert json.loads(result.stdout)["status"] == "bad_input"
    short = tmp_path / "short.toml"
    short.write_text(text + '\n[objective]\nkind = "smoothness"\nduration = 20.0\n')
    result = run.invoke(application, [str(short), "--json"])
    assert result.exit_code == 1
    answer = json.loads(result.stdout)
    assert answer["status"] == "infeasible"
    assert answer["limit"] == "duration"
    assert answer["excess"] > 10
