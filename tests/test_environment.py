"""The surroundings along an orbit against independent computations."""

from __future__ import annotations

import logging
import socket

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.effects.declaration import ENVIRONMENT
from estimator.models import environment
from estimator.models.earth import EQUATORIAL_RADIUS, GRAVITATIONAL_PARAMETER, J2, ROTATION_RATE
from estimator.models.environment import environment_table, geomagnetic_field
from estimator.models.errors import NotFiniteError, RequestError, ShapeError

EPOCH = "2024-03-01T00:00:00Z"
ANGLE = 4.2  # rad
SEMI_MAJOR_AXIS, INCLINATION = 7.05e6, 1.71  # m, rad


def circle(time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    rate = np.sqrt(GRAVITATIONAL_PARAMETER / SEMI_MAJOR_AXIS**3)
    tilt = Rotation.from_euler("x", INCLINATION)
    zero = np.zeros(len(time))
    cosine, sine = np.cos(rate * time), np.sin(rate * time)
    return (tilt.apply(SEMI_MAJOR_AXIS * np.stack([cosine, sine, zero], axis=1)),
            tilt.apply(SEMI_MAJOR_AXIS * rate * np.stack([-sine, cosine, zero], axis=1)))


def about_z(angle: np.ndarray) -> Rotation:
    return Rotation.from_rotvec(np.asarray(angle)[:, None] * np.array([0.0, 0.0, 1.0]))


def table(time: np.ndarray, epoch: str = EPOCH) -> dict[str, np.ndarray]:
    return environment_table(epoch, time, *circle(time), ANGLE, ROTATION_RATE)


def test_table_has_the_declared_fields() -> None:
    for time in (np.arange(0.0, 6000.0, 7.0), np.array([100.0]), np.zeros(0)):
        found = table(time)
        assert list(found) == list(ENVIRONMENT)
        for name, size in ENVIRONMENT.items():
            assert found[name].shape == ((len(time),) if size == 1 else (len(time), size))
            assert np.all(np.isfinite(found[name]))


def test_gravity_is_the_gradient_of_its_potential() -> None:
    def potential(r: np.ndarray) -> np.ndarray:
        d = np.linalg.norm(r, axis=-1)
        legendre = 1.5 * (r[..., 2] / d) ** 2 - 0.5
        return GRAVITATIONAL_PARAMETER / d * (1 - J2 * (EQUATORIAL_RADIUS / d) ** 2 * legendre)

    place = np.random.default_rng(0).standard_normal((20, 3))
    place *= 7e6 / np.linalg.norm(place, axis=1, keepdims=True)
    step = 500.0
    gradient = np.stack([(potential(place + step * e) - potential(place - step * e)) / (2 * step) for e in np.eye(3)],
                        axis=1)
    assert environment.gravity(place) == pytest.approx(gradient, abs=2e-7)


def test_velocity_against_the_turning_earth() -> None:
    time = np.array([500.0, 500.0 + 1e-2, 500.0 - 1e-2])
    found = table(time)
    fixed = about_z(-found["earth_angle"]).apply(found["position"])
    derivative = (fixed[1] - fixed[2]) / 2e-2
    turned = Rotation.from_euler("z", -float(found["earth_angle"][0])).apply(found["earth_fixed_velocity"][0])
    assert turned == pytest.approx(derivative, abs=1e-4)
    assert found["earth_angle"] == pytest.approx(ANGLE + ROTATION_RATE * time)


def test_orbit_phase_counts_from_the_ascending_node() -> None:
    rate = np.sqrt(GRAVITATIONAL_PARAMETER / SEMI_MAJOR_AXIS**3)
    time = np.linspace(0, 5800, 50)
    assert np.exp(1j * table(time)["orbit_phase"]) == pytest.approx(np.exp(1j * rate * time), abs=1e-12)
    equator = environment.orbit_phase(np.array([[0.0, 7e6, 0.0]]), np.array([[-7.5e3, 0.0, 0.0]]))
    assert equator == pytest.approx([np.pi / 2])


def test_magnetic_field_against_the_geodetic_form_of_the_model() -> None:
    import datetime

    import ppigrf
    from astropy import units
    from astropy.coordinates import EarthLocation

    time = np.linspace(0, 5800, 12)
    found = table(time)
    fixed = about_z(-found["earth_angle"]).apply(found["position"])
    field = about_z(-found["earth_angle"]).apply(found["magnetic_field"])
    place = EarthLocation.from_geocentric(*fixed.T, unit=units.m)
    longitude, latitude = place.lon.to_value(units.rad), place.lat.to_value(units.rad)
    east, north, up = (c[0] for c in ppigrf.igrf(np.degrees(longitude), np.degrees(latitude),
                                                 place.height.to_value(units.km), datetime.datetime(2024, 3, 1)))
    zero = np.zeros(len(time))
    e = np.stack([-np.sin(longitude), np.cos(longitude), zero], axis=1)
    u = np.stack([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], axis=1)
    expected = 1e-9 * (east[:, None] * e + north[:, None] * np.cross(u, e) + up[:, None] * u)
    assert field == pytest.approx(expected, abs=1e-9)  # T
    size = np.linalg.norm(field, axis=1)
    assert size.min() > 1.5e-5
    assert size.max() < 6e-5


def test_magnetic_field_is_interpolated_to_a_nanotesla() -> None:
    time = np.concatenate([np.arange(300.0, 900.0, 0.25), np.arange(2000.0, 2003.0, 0.25), np.arange(5000, 5600, 0.5)])
    found = table(time)
    fixed = about_z(-found["earth_angle"]).apply(found["position"])
    exact = about_z(found["earth_angle"]).apply(geomagnetic_field(EPOCH, time, fixed))
    assert np.max(np.abs(found["magnetic_field"] - exact)) < 1e-9


def test_places_that_follow_no_orbit_are_evaluated_one_by_one() -> None:
    rng = np.random.default_rng(4)
    time = np.arange(0.0, 200.0, 0.5)
    place = rng.standard_normal((len(time), 3))
    place *= 7e6 / np.linalg.norm(place, axis=1, keepdims=True)
    found = environment_table(EPOCH, time, place, place * 1e-3, ANGLE, ROTATION_RATE)
    fixed = about_z(-found["earth_angle"]).apply(place)
    exact = about_z(found["earth_angle"]).apply(geomagnetic_field(EPOCH, time, fixed))
    assert np.max(np.abs(found["magnetic_field"] - exact)) < 1e-12


def test_order_and_repetition_of_times_do_not_matter() -> None:
    time = np.arange(0.0, 400.0, 0.5)
    shuffled = np.random.default_rng(1).permutation(np.concatenate([time, time[::7]]))
    ordered, mixed = table(np.sort(shuffled)), table(shuffled)
    back = np.argsort(shuffled, kind="stable")
    for name in ENVIRONMENT:
        assert mixed[name][back] == pytest.approx(ordered[name], rel=1e-12, abs=1e-18)


def test_field_beyond_the_coefficients_is_said(caplog: pytest.LogCaptureFixture) -> None:
    time = np.array([0.0, 10.0])
    with caplog.at_level(logging.WARNING):
        late = table(time, "2035-06-01T00:00:00")["magnetic_field"]
    assert "IGRF" in caplog.text
    assert np.all(np.isfinite(late))


def test_sun_and_earth_against_the_sky() -> None:
    from astropy import units
    from astropy.coordinates import get_body_barycentric, get_sun
    from astropy.time import Time

    found = table(np.array([0.0, 3000.0]))
    moment = Time("2024-03-01T00:00:00", scale="utc")
    apparent = get_sun(moment).cartesian.xyz.to_value(units.m)
    apparent /= np.linalg.norm(apparent)
    assert np.arccos(found["sun"][0] @ apparent) < np.radians(40 / 3600)  # aberration 20", parallax 10"
    ahead, behind = (get_body_barycentric("earth", moment + s * units.hour, ephemeris="builtin").xyz.to_value(units.m)
                     for s in (1, -1))
    assert found["earth_velocity"][0] == pytest.approx((ahead - behind) / 7200.0, abs=0.05)
    assert np.linalg.norm(found["earth_velocity"][0]) == pytest.approx(29.9e3, rel=0.02)
    equinox = environment_table("2024-03-20T03:06:00Z", np.zeros(1), *circle(np.zeros(1)), ANGLE, ROTATION_RATE)
    # the Sun stands at the equinox of date, which has moved 0.34 degrees from that of 2000
    assert equinox["sun"][0] == pytest.approx([1, 0, 0], abs=np.radians(0.4))


def test_nothing_reaches_for_the_network(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_args: object, **_kwargs: object) -> None:
        raise AssertionError("a connection was tried")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    table(np.array([0.0, 1.0]), "2029-11-05T12:00:00Z")


def test_shadow_of_the_earth() -> None:
    sun = np.tile([1.0, 0, 0], (5, 1))
    height = 7e6
    place = np.array([[height, 0, 0], [-height, 0, 0], [0, height, 0], [-3e6, 6.32e6, 0], [-3e6, 6.5e6, 0]])
    lit = environment.sunlit(place, sun)
    assert lit[:3] == pytest.approx([1, 0, 1])
    assert lit[3] < 1e-9
    assert lit[4] == 1.0
    across = np.linspace(6.32e6, 6.43e6, 4001)
    line = np.stack([np.full(4001, -3e6), across, np.zeros(4001)], axis=1)
    edge = environment.sunlit(line, np.tile([1.0, 0, 0], (4001, 1)))
    assert np.all(np.diff(edge) >= 0)
    # the whole penumbra is the Sun's diameter, seen from the limb: 0.533 degrees
    width = np.interp([1e-6, 0.5, 1 - 1e-6], edge, across)
    assert (width[2] - width[0]) / 3e6 == pytest.approx(np.radians(0.533), rel=0.03)
    assert width[1] == pytest.approx(EQUATORIAL_RADIUS, rel=1e-5)


def test_shadowed_part_of_an_orbit() -> None:
    found = table(np.arange(0.0, 5900.0, 5.0))
    along = np.sum(found["position"] * found["sun"], axis=1)
    off_axis = np.linalg.norm(found["position"] - along[:, None] * found["sun"], axis=1)
    cylinder = (along < 0) & (off_axis < EQUATORIAL_RADIUS)
    assert 0.2 < np.mean(cylinder) < 0.4
    assert np.mean(np.abs(found["sunlit"] - ~cylinder)) < 0.005  # they differ in the penumbra alone


def test_density_falls_by_e_in_one_scale_height() -> None:
    place = np.array([[EQUATORIAL_RADIUS + 7.0e5, 0, 0], [EQUATORIAL_RADIUS + 7.71e5, 0, 0]])
    density = environment.density(place)
    assert density[0] / density[1] == pytest.approx(np.e, rel=1e-9)
    assert 1e-14 < density[0] < 1e-13
    pole = environment.altitude(np.array([[0, 0, 6.9e6]]))
    assert pole == pytest.approx([6.9e6 - 6356752.3], abs=1.0)


def test_input_that_cannot_be_used() -> None:
    time = np.array([0.0, 1.0])
    place, speed = circle(time)
    with pytest.raises(ShapeError, match="position_inertial"):
        environment_table(EPOCH, time, place[:1], speed, ANGLE, ROTATION_RATE)
    with pytest.raises(ShapeError, match="time"):
        environment_table(EPOCH, time[None], place, speed, ANGLE, ROTATION_RATE)
    broken = speed.copy()
    broken[1, 2] = np.nan
    with pytest.raises(NotFiniteError, match=r"velocity_inertial\[1\]"):
        environment_table(EPOCH, time, place, broken, ANGLE, ROTATION_RATE)
    with pytest.raises(RequestError, match="metres"):
        environment_table(EPOCH, time, place / 1e3, speed, ANGLE, ROTATION_RATE)
    with pytest.raises(RequestError, match="epoch"):
        environment_table("yesterday", time, place, speed, ANGLE, ROTATION_RATE)
