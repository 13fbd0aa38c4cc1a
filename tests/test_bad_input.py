"""Bad input: each defect gets its own typed error (what, where, value, limit); harmless oddities are accepted.

Defects are put into a generated campaign, written to a file and read back, as a user would meet them.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import typer
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from estimator.models.errors import (
    ArcError,
    FileFormatError,
    GeometryError,
    InputError,
    MissingDataError,
    NotFiniteError,
    QuaternionError,
    ShapeError,
    TimeOrderError,
    TooFewDataError,
    UnitError,
)
from problems import console
from problems.alignment.campaign import Arc, Campaign, Covariate, TorqueCommands
from problems.alignment.checks import InertiaError, attitude_known, checked
from problems.alignment.simulator import preset, simulate
from problems.readers.campaign_file import read_campaign, write_campaign

change = dataclasses.replace
Change = Callable[[Campaign], Campaign]


@pytest.fixture(scope="module")
def good() -> Campaign:
    """Sessions, free rotation about several axes, and pulses about three axes."""
    return checked(simulate(preset("compact"), seed=11)[0])


def gnss(**parts: Any) -> Change:
    return lambda c: change(c, gnss=change(c.gnss, **{k: f(getattr(c.gnss, k)) for k, f in parts.items()}))


def tracker(**parts: Any) -> Change:
    return lambda c: change(
        c, star_tracker=change(c.star_tracker, **{k: f(getattr(c.star_tracker, k)) for k, f in parts.items()})
    )


def doppler(**parts: Any) -> Change:
    return lambda c: change(c, doppler=change(c.doppler, **{k: f(getattr(c.doppler, k)) for k, f in parts.items()}))


def nominal(**parts: Any) -> Change:
    return lambda c: change(c, nominal=change(c.nominal, **{k: f(getattr(c.nominal, k)) for k, f in parts.items()}))


def torque(**parts: Any) -> Change:
    return lambda c: change(c, torque=change(c.torque, **{k: f(getattr(c.torque, k)) for k, f in parts.items()}))


def root(**parts: Any) -> Change:
    return lambda c: change(c, **{k: f(getattr(c, k)) for k, f in parts.items()})


def rows(series: str, select: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Take rows (an index or a mask made from the times) of one series."""

    def apply(c: Campaign) -> Campaign:
        part = getattr(c, series)
        index = select(part.time)
        fields = {f.name: getattr(part, f.name) for f in dataclasses.fields(part)}
        return change(
            c,
            **{
                series: change(
                    part,
                    **{
                        name: v[index]
                        for name, v in fields.items()
                        if isinstance(v, np.ndarray) and not (name == "beam_direction" and v.ndim == 2)
                    },
                )
            },
        )

    return apply


def arcs(replace: Callable[[tuple[Arc, ...]], tuple[Arc, ...]]) -> Change:
    return lambda c: change(c, arcs=replace(c.arcs))


def one_arc(of: str, /, **parts: Callable[[Arc], Any]) -> Change:
    """Change the first arc of a kind."""

    def replace(all_arcs: tuple[Arc, ...]) -> tuple[Arc, ...]:
        first = next(a for a in all_arcs if a.kind == of)
        new = change(first, **{k: f(first) for k, f in parts.items()})
        return tuple(new if a is first else a for a in all_arcs)

    return arcs(replace)


def put(index: Any, value: float) -> Callable[[np.ndarray], np.ndarray]:
    def apply(values: np.ndarray) -> np.ndarray:
        values = np.array(values)
        values[index] = value
        return values

    return apply


def scaled(factor: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda values: np.asarray(values) * factor


def scalar_last(values: np.ndarray) -> np.ndarray:
    return np.roll(values, -1, axis=-1)


def shuffled(values: np.ndarray) -> np.ndarray:
    return np.random.default_rng(3).permutation(values)


def both(*changes: Change) -> Change:
    def apply(c: Campaign) -> Campaign:
        for one in changes:
            c = one(c)
        return c

    return apply


COPLANAR = np.array([[0.0, 0.309, 0.951], [0.0, -0.309, 0.951], [0.0, 0.0, 1.0]])
COPLANAR /= np.linalg.norm(COPLANAR, axis=1)[:, None]

REFUSED: dict[str, tuple[Change, type[InputError], str]] = {
    # not finite
    "NaN position": (gnss(position=put((17, 1), np.nan)), NotFiniteError, r"gnss/position\[17, 1\].*NaN"),
    "infinite position": (gnss(position=put((0, 0), np.inf)), NotFiniteError, r"gnss/position\[0, 0\]"),
    "NaN GNSS time": (gnss(time=put(4, np.nan)), NotFiniteError, r"gnss/time\[4\]"),
    "NaN quaternion": (tracker(quaternion=put(3, np.nan)), NotFiniteError, r"star_tracker/quaternion"),
    "NaN tracker accuracy": (tracker(standard_deviation=put((0, 2), np.nan)), NotFiniteError, "standard_deviation"),
    "infinite Doppler": (doppler(frequency_shift=put((5, 2), -np.inf)), NotFiniteError, r"frequency_shift\[5, 2\]"),
    "NaN beam": (doppler(beam_direction=put((1, 1), np.nan)), NotFiniteError, "beam_direction"),
    "NaN carrier": (doppler(carrier_frequency=lambda f: np.nan), NotFiniteError, "carrier"),
    "NaN torque": (torque(command=put((0, 0), np.nan)), NotFiniteError, "torque/command"),
    "NaN torque start": (torque(start=put(0, np.nan)), NotFiniteError, "torque/start"),
    "NaN inertia": (nominal(inertia=put((2, 2), np.nan)), NotFiniteError, "nominal/inertia"),
    "NaN nominal": (nominal(antenna_from_tracker=put(0, np.nan)), NotFiniteError, "antenna_from_tracker"),
    "NaN arc": (one_arc("doppler", stop=lambda a: np.nan), NotFiniteError, "arc"),
    "NaN Earth rate": (root(earth_rotation_rate=lambda r: np.nan), NotFiniteError, "earth_rotation_rate"),
    "NaN Earth angle": (root(earth_rotation_angle_at_epoch=lambda r: np.nan), NotFiniteError, "earth_rotation_angle"),
    "NaN housekeeping": (
        root(housekeeping=lambda h: {"x": Covariate(np.arange(3.0), np.array([1, np.nan, 2]), "K")}),
        NotFiniteError,
        "housekeeping/x",
    ),
    # time
    "shuffled GNSS rows": (rows("gnss", lambda t: shuffled(np.arange(t.size))), TimeOrderError, "gnss/time.*backwards"),
    "shuffled GNSS times": (gnss(time=shuffled), TimeOrderError, "gnss/time.*backwards"),
    "shuffled tracker rows": (
        rows("star_tracker", lambda t: shuffled(np.arange(t.size))),
        TimeOrderError,
        "star_tracker/time",
    ),
    "reversed Doppler": (rows("doppler", lambda t: np.arange(t.size)[::-1]), TimeOrderError, "doppler/time"),
    "duplicated GNSS time": (
        gnss(time=lambda t: np.where(np.arange(t.size) == 9, t[8], t)),
        TimeOrderError,
        r"gnss/time\[9\].*duplicated",
    ),
    "duplicated tracker row": (
        rows("star_tracker", lambda t: np.sort(np.append(np.arange(t.size), 5))),
        TimeOrderError,
        "star_tracker/time.*duplicated",
    ),
    "duplicated Doppler row": (
        rows("doppler", lambda t: np.sort(np.append(np.arange(t.size), 5))),
        TimeOrderError,
        "doppler/time.*duplicated",
    ),
    "times in minutes": (gnss(time=scaled(1 / 60)), UnitError, "minutes"),
    "all times in milliseconds": (
        both(gnss(time=scaled(1e3)), tracker(time=scaled(1e3)), doppler(time=scaled(1e3))),
        UnitError,
        "milliseconds",
    ),
    "epoch": (root(epoch=lambda e: "yesterday"), InputError, "epoch.*ISO 8601"),
    # quaternions
    "quaternions of length 1.01": (tracker(quaternion=scaled(1.01)), QuaternionError, "unit length.*1.01"),
    "one quaternion of length 2": (tracker(quaternion=lambda q: put(7, 1.0)(q)), QuaternionError, r"quaternion\[7\]"),
    "zero quaternion": (tracker(quaternion=put(7, 0.0)), QuaternionError, r"quaternion\[7\].*length 0"),
    "nominal quaternion": (
        nominal(actuator_from_tracker=scaled(0.9)),
        QuaternionError,
        "nominal/actuator_from_tracker",
    ),
    "tracker scalar last": (tracker(quaternion=scalar_last), UnitError, "star_tracker/quaternion.*scalar last"),
    "tracker conjugated": (tracker(quaternion=lambda q: q * [1, -1, -1, -1]), UnitError, "conjugated"),
    "antenna scalar last": (
        nominal(antenna_from_tracker=scalar_last),
        UnitError,
        "nominal/antenna_from_tracker.*scalar last",
    ),
    "actuator scalar last": (
        nominal(actuator_from_tracker=scalar_last),
        UnitError,
        "nominal/actuator_from_tracker.*scalar last",
    ),
    "all scalar last": (
        both(
            tracker(quaternion=scalar_last),
            nominal(antenna_from_tracker=scalar_last, actuator_from_tracker=scalar_last),
        ),
        UnitError,
        "scalar last",
    ),
    "scalar last without Doppler": (
        both(
            root(doppler=lambda d: None),
            arcs(lambda a: tuple(x for x in a if x.kind != "doppler")),
            tracker(quaternion=scalar_last),
        ),
        UnitError,
        "momentum.*scalar last",
    ),
    # units
    "kilometres": (
        gnss(position=scaled(1e-3), standard_deviation=scaled(1e-3)),
        UnitError,
        "gnss/position.*kilometres",
    ),
    "millimetres": (gnss(position=scaled(1e3)), UnitError, "gnss/position.*millimetres"),
    "one position at zero": (gnss(position=put(6, 0.0)), UnitError, r"gnss/position\[6\].*below the Earth"),
    "Earth angle in degrees": (root(earth_rotation_angle_at_epoch=lambda a: 222.0), UnitError, "one turn.*degrees"),
    "Earth rate in degrees": (root(earth_rotation_rate=np.rad2deg), UnitError, "degrees per second"),
    "Earth rate in radians per day": (root(earth_rotation_rate=lambda r: r * 86400), UnitError, "radians per day"),
    "tracker accuracy in degrees": (
        tracker(standard_deviation=np.rad2deg),
        UnitError,
        "accuracy of the star tracker.*degrees",
    ),
    "tracker accuracy in arc seconds": (
        tracker(standard_deviation=lambda s: np.rad2deg(s) * 3600),
        UnitError,
        "arc seconds",
    ),
    "Doppler in kilohertz": (doppler(frequency_shift=scaled(1e-3)), UnitError, "doppler/frequency_shift.*kilohertz"),
    "Doppler in millihertz": (doppler(frequency_shift=scaled(1e3)), UnitError, "doppler/frequency_shift"),
    "Doppler of the other sign": (doppler(frequency_shift=scaled(-1)), UnitError, "opposite sign"),
    "carrier in gigahertz": (doppler(carrier_frequency=lambda f: f / 1e9), UnitError, "carrier.*gigahertz"),
    "torque in millinewton metres": (torque(command=scaled(1e3)), UnitError, "torque/command.*millinewton"),
    "inertia in kg cm2": (nominal(inertia=scaled(1e4)), UnitError, "torque.*inertia.*kg cm2"),
    "zero accuracy": (gnss(standard_deviation=scaled(0.0)), UnitError, "standard deviation is not positive"),
    "negative accuracy": (doppler(standard_deviation=put((3, 0), -1.0)), UnitError, r"standard_deviation\[3, 0\]"),
    # inertia
    "not symmetric": (nominal(inertia=put((0, 1), 99.0)), InertiaError, "not symmetric"),
    "not positive definite": (nominal(inertia=lambda i: i - 800 * np.eye(3)), InertiaError, "positive definite"),
    "triangle inequality": (nominal(inertia=lambda i: np.diag([100.0, 100.0, 250.0])), InertiaError, "250.*200"),
    # geometry
    "coplanar beams": (doppler(beam_direction=lambda b: COPLANAR), GeometryError, "coplanar.*singular value.*0.001"),
    "equal beams": (doppler(beam_direction=lambda b: np.repeat(b[:1], 3, axis=0)), GeometryError, "coplanar"),
    "long beams": (doppler(beam_direction=scaled(1.1)), GeometryError, "unit length.*1.1"),
    "rows of another time": (doppler(frequency_shift=shuffled), UnitError, "contradict each other"),
    # too few
    "five positions": (rows("gnss", lambda t: np.arange(5)), TooFewDataError, "gnss/time.*5.*8"),
    "three attitudes": (rows("star_tracker", lambda t: np.arange(3)), TooFewDataError, "star_tracker/time.*3.*4"),
    "no Doppler sample": (rows("doppler", lambda t: np.arange(0)), TooFewDataError, "doppler/time"),
    "free arc with three attitudes": (
        lambda c: rows("star_tracker", lambda t: thinned(t, c.arcs_of_kind("free_rotation")[0], 3))(c),
        TooFewDataError,
        "free.*3",
    ),
    # arcs
    "overlapping arcs": (one_arc("free_rotation", start=lambda a: a.start - 1500), ArcError, "overlap"),
    "repeated arc": (arcs(lambda a: (*a, a[0])), ArcError, "overlap"),
    "reversed arc": (one_arc("free_rotation", start=lambda a: a.stop, stop=lambda a: a.start), ArcError, "reversed"),
    "arc after the data": (
        one_arc("torque_pulse", start=lambda a: 9e6, stop=lambda a: 9e6 + 100),
        ArcError,
        "leaves the data",
    ),
    "arc longer than the data": (
        arcs(lambda a: tuple(change(x, stop=1e6) if x.stop == max(y.stop for y in a) else x for x in a)),
        ArcError,
        "leaves the data",
    ),
    "Doppler arc where there is none": (
        one_arc("doppler", start=lambda a: a.stop + 5, stop=lambda a: a.stop + 25),
        ArcError,
        "doppler.*no samples",
    ),
    "unknown kind": (one_arc("doppler", kind=lambda a: "picnic"), ArcError, "kind.*picnic"),
    "reversed torque": (torque(start=lambda s: s + 500), ArcError, "torque/stop"),
    "overlapping torque": (torque(stop=lambda s: s + 25), ArcError, "overlap"),
    "torque outside the data": (
        torque(start=lambda s: s + 1e6, stop=lambda s: s + 1e6),
        ArcError,
        "outside the star tracker",
    ),
    "torque in free rotation": (lambda c: change(c, torque=shifted_torque(c)), ArcError, "free-rotation arc"),
    "Doppler after navigation": (rows("gnss", lambda t: t < 500), ArcError, "outside the navigation data"),
    "Doppler without attitude": (
        lambda c: rows("star_tracker", lambda t: ~inside(t, c.arcs_of_kind("doppler")[0]))(c),
        ArcError,
        "outside the star tracker",
    ),
    # missing
    "torque arcs without torque": (root(torque=lambda t: None), MissingDataError, "'torque' is missing"),
    "Doppler arcs without Doppler": (root(doppler=lambda d: None), MissingDataError, "'doppler' is missing"),
    # shapes
    "attitudes fewer than times": (tracker(quaternion=lambda q: q[:-1]), ShapeError, "star_tracker/quaternion"),
    "inertia as a vector": (nominal(inertia=np.diag), ShapeError, "nominal/inertia"),
}


def inside(times: np.ndarray, arc: Arc) -> np.ndarray:
    return (times >= arc.start - 5) & (times <= arc.stop + 5)


def thinned(times: np.ndarray, arc: Arc, left: int) -> np.ndarray:
    index = np.flatnonzero(inside(times, arc))
    keep = index[np.linspace(0, index.size - 1, left).astype(int)]
    return np.sort(np.concatenate([np.flatnonzero(~inside(times, arc)), keep]))


def shifted_torque(c: Campaign) -> TorqueCommands:
    """The first segment moved into the first free arc."""
    assert c.torque is not None
    arc = c.arcs_of_kind("free_rotation")[0]
    start, stop = np.array(c.torque.start), np.array(c.torque.stop)
    start[0], stop[0] = arc.start + 10, arc.start + 20
    return change(c.torque, start=start, stop=stop)


def written(campaign: Campaign, path: Path) -> Path:
    """Write what can be written although it is wrong (shapes that disagree are checked in memory instead)."""
    write_campaign(campaign, path)
    return path


@pytest.mark.parametrize("name", list(REFUSED))
def test_each_defect_has_its_error(name: str, good: Campaign, tmp_path: Path) -> None:
    apply, error, words = REFUSED[name]
    bad = apply(good)
    if error is ShapeError:
        with pytest.raises(error, match=words) as caught:
            checked(bad)
    else:
        with pytest.raises(error, match=f"(?s){words}") as caught:
            read_campaign(written(bad, tmp_path / "bad.nc"))
    assert type(caught.value) is error
    assert caught.value.value is not None or "missing" in str(caught.value)  # the value stands in the sentence


ACCEPTED: dict[str, Change] = {
    "as it is": lambda c: c,
    "sign flips": tracker(
        quaternion=lambda q: q * np.where(np.random.default_rng(1).random((len(q), 1)) < 0.5, -1.0, 1.0)
    ),
    "length off by rounding": tracker(quaternion=scaled(1 + 1e-6)),
    "single precision": tracker(quaternion=lambda q: q.astype(np.float32).astype(float)),
    "GNSS gap": rows("gnss", lambda t: (t < 1000) | (t > 1250)),
    "tracker gap": lambda c: rows(
        "star_tracker", lambda t: ~(inside(t, c.arcs_of_kind("free_rotation")[0]) & (t % 100 > 40) & (t % 100 < 60))
    )(c),
    "random losses": both(
        rows("gnss", lambda t: np.random.default_rng(1).random(t.size) < 0.7),
        rows("star_tracker", lambda t: np.random.default_rng(2).random(t.size) < 0.7),
        rows("doppler", lambda t: np.random.default_rng(3).random(t.size) < 0.7),
    ),
    "arcs in any order": arcs(lambda a: a[::-1]),
    "no torque": both(root(torque=lambda t: None), arcs(lambda a: tuple(x for x in a if x.kind != "torque_pulse"))),
    "torque without pulse arcs": arcs(lambda a: tuple(x for x in a if x.kind != "torque_pulse")),
    "no free rotation": arcs(lambda a: tuple(x for x in a if x.kind != "free_rotation")),
    "Doppler alone": both(root(torque=lambda t: None), arcs(lambda a: tuple(x for x in a if x.kind == "doppler"))),
    "no Doppler": both(root(doppler=lambda d: None), arcs(lambda a: tuple(x for x in a if x.kind != "doppler"))),
    "orbit and attitude alone": both(root(doppler=lambda d: None, torque=lambda t: None), arcs(lambda a: ())),
    "two beams": doppler(
        frequency_shift=lambda f: f[:, :2], standard_deviation=lambda s: s[:, :2], beam_direction=lambda b: b[:2]
    ),
    "one beam": doppler(
        frequency_shift=lambda f: f[:, :1], standard_deviation=lambda s: s[:, :1], beam_direction=lambda b: b[:1]
    ),
    "moving beams": lambda c: doppler(beam_direction=lambda b: np.repeat(b[None], c.doppler.time.size, axis=0))(c),
    "gross errors": both(
        gnss(position=lambda p: with_outliers(p, 300.0)), doppler(frequency_shift=lambda f: with_outliers(f, 500.0))
    ),
    "ten times the noise": doppler(frequency_shift=lambda f: f + np.random.default_rng(5).normal(0, 20, f.shape)),
    "mounting 5 degrees from its design": nominal(
        antenna_from_tracker=lambda q: (
            Rotation.from_rotvec([0.05, -0.05, 0.05]) * Rotation.from_quat(q, scalar_first=True)
        ).as_quat(scalar_first=True)
    ),
    "Earth angle below zero": root(earth_rotation_angle_at_epoch=lambda a: a - 2 * np.pi if a > 0 else a),
    "inertia of a thin plate": nominal(inertia=lambda i: np.diag([300.0, 500.0, 800.0])),
    "later epoch": root(epoch=lambda e: "2031-12-31T23:59:60.5Z".replace(":60.5", ":59")),
}


def with_outliers(values: np.ndarray, size: float) -> np.ndarray:
    random = np.random.default_rng(8)
    hit = random.random(values.shape) < 0.05
    return values + hit * random.normal(0.0, size, values.shape)


@pytest.mark.parametrize("name", list(ACCEPTED))
def test_what_is_unusual_and_valid_is_accepted(name: str, good: Campaign, tmp_path: Path) -> None:
    wanted = ACCEPTED[name](good)
    found = read_campaign(written(wanted, tmp_path / "a.nc"))
    assert np.array_equal(found.gnss.time, wanted.gnss.time)
    assert np.array_equal(found.gnss.position, wanted.gnss.position)
    assert found.arcs == wanted.arcs
    one = Rotation.from_quat(found.star_tracker.quaternion, scalar_first=True)
    other = Rotation.from_quat(wanted.star_tracker.quaternion, scalar_first=True)
    assert (one * other.inv()).magnitude().max() < 1e-12
    assert np.abs(np.linalg.norm(found.star_tracker.quaternion, axis=1) - 1).max() < 1e-12
    assert (np.sum(found.star_tracker.quaternion[1:] * found.star_tracker.quaternion[:-1], axis=1) > 0).all()


def test_checking_twice_changes_nothing(good: Campaign) -> None:
    once = checked(ACCEPTED["sign flips"](good))
    assert np.array_equal(checked(once).star_tracker.quaternion, once.star_tracker.quaternion)


def test_an_angle_in_degrees_below_one_turn_is_found_by_the_doppler_shift() -> None:
    campaign = checked(simulate(preset("compact", earth_rotation_angle_at_epoch=0.06), seed=2)[0])
    with pytest.raises(UnitError, match=r"earth_rotation_angle_at_epoch.*looks like degrees"):
        checked(change(campaign, earth_rotation_angle_at_epoch=np.rad2deg(0.06)))


def test_the_accuracy_in_degrees_is_found_for_irregular_campaigns_only_from_the_data() -> None:
    """A poor tracker that is honest about it is accepted; the same numbers without the scatter are refused."""
    honest = simulate(preset("compact", star_tracker_noise=(2e-3, 2e-3, 4e-3)), seed=2)[0]
    checked(honest)
    quiet = simulate(preset("compact", star_tracker_noise=(2e-3 / 57.3, 2e-3 / 57.3, 4e-3 / 57.3)), seed=2)[0]
    checked(quiet)
    with pytest.raises(UnitError, match="degrees"):
        checked(
            change(
                quiet,
                star_tracker=change(quiet.star_tracker, standard_deviation=honest.star_tracker.standard_deviation),
            )
        )


@pytest.mark.parametrize(
    "settings_",
    [
        {"gnss_outlier_fraction": 0.3, "star_tracker_outlier_fraction": 0.3, "doppler_outlier_fraction": 0.3},
        {"gnss_jitter": 0.9, "star_tracker_jitter": 0.9, "doppler_jitter": 0.9},
        {"eccentricity": 0.7, "semi_major_axis": 26.0e6},
        {"gnss_step": 30.0},
        {"beams": 5},
        {"free_rate": 0.0},
        {"inertia_spread": 0.2, "mounting_spread": 0.1},
    ],
)
def test_no_false_alarm_on_generated_campaigns(settings_: dict[str, Any]) -> None:
    for seed in (1, 2):
        checked(simulate(preset("compact", **settings_), seed=seed)[0])


def test_attitude_known_is_bounded_by_samples() -> None:
    campaign = simulate(preset("compact"), seed=1)[0]
    times = campaign.star_tracker.time
    gap = int(np.argmax(np.diff(times)))
    probe = np.array(
        [times[0] - 1, times[0], (times[0] + times[1]) / 2, (times[gap] + times[gap + 1]) / 2, times[-1] + 1]
    )
    assert attitude_known(campaign, probe).tolist() == [False, True, True, False, False]


# ---------------------------------------------------------------------------------------------------------------- #
# files


@pytest.mark.parametrize("group", ["gnss", "star_tracker", "doppler", "torque", "arcs", "nominal"])
def test_a_missing_group_is_named(group: str, good: Campaign, tmp_path: Path) -> None:
    path = written(good, tmp_path / "a.nc")
    with h5py.File(path, "r+") as file:
        del file[group]
    with pytest.raises(MissingDataError, match=f"'{group}' is missing"):
        read_campaign(path)


def test_foreign_and_truncated_files(good: Campaign, tmp_path: Path) -> None:
    whole = written(good, tmp_path / "a.nc").read_bytes()
    contents = {
        "empty": b"",
        "text": b"time,x,y,z\n0,1,2,3\n",
        "netCDF-3": b"CDF\x01" + bytes(100),
        "half": whole[: len(whole) // 2],
        "all but the end": whole[:-100],
        "no beginning": whole[2000:],
        "zip": b"PK\x03\x04" + bytes(500),
    }
    for name, content in contents.items():
        path = tmp_path / f"{name}.nc"
        path.write_bytes(content)
        with pytest.raises(FileFormatError, match=f"{name}.nc.*truncated, damaged or not NetCDF-4"):
            read_campaign(path)
    with pytest.raises(FileFormatError, match="no such file"):
        read_campaign(tmp_path / "nowhere.nc")
    with pytest.raises(FileFormatError, match="no such file"):
        read_campaign(tmp_path)
    with h5py.File(tmp_path / "other.nc", "w") as file:
        file["temperature"] = np.zeros(4)
    with pytest.raises(MissingDataError, match="'gnss' is missing"):
        read_campaign(tmp_path / "other.nc")


@pytest.fixture(scope="module")
def small_file(tmp_path_factory: pytest.TempPathFactory, good: Campaign) -> bytes:
    path = tmp_path_factory.mktemp("small") / "a.nc"
    alone = ACCEPTED["orbit and attitude alone"](good)
    write_campaign(rows("star_tracker", lambda t: t < 305)(rows("gnss", lambda t: t < 305)(alone)), path)
    return path.read_bytes()


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_bytes_never_end_in_another_error(data: st.DataObject, small_file: bytes, tmp_path: Path) -> None:
    """Any damage is either harmless or a typed error; nothing else escapes."""
    content = bytearray(small_file)
    for _ in range(data.draw(st.integers(0, 6))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content)))]
    path = tmp_path / "damaged.nc"
    path.write_bytes(bytes(content))
    try:
        read_campaign(path)
    except InputError as error:
        assert str(error)


def test_the_command_line_answers_bad_input_with_status_2(
    good: Campaign, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(REFUSED["kilometres"][0](good), tmp_path / "a.nc")
    with pytest.raises(typer.Exit) as left:
        console.run(lambda: ({"status": "ok", "title": read_campaign(path).title}, lambda: ""), as_json=True)
    assert left.value.exit_code == 2
    answer = json.loads(capsys.readouterr().out)
    assert answer["status"] == "bad_input"
    assert "kilometres" in answer["why"]
