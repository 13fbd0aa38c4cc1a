"""Orbit and Earth orientation against astropy, conservation laws and the geometry that a pass is asked for by."""

from __future__ import annotations

import math
import warnings
from datetime import datetime

import numpy as np
import pytest

from estimator.models.errors import GeometryError
from guidance.ground_geometry import geodesic_inverse
from guidance.orbit_propagation import (
    GRAVITATIONAL_PARAMETER,
    GRAVITY_RADIUS,
    SECOND_ZONAL_HARMONIC,
    EarthOrientation,
    orbit_of_request,
    passes_over,
    state_from_elements,
)
from guidance.survey_request import OrbitRequest

EPOCH = datetime(2025, 6, 21, 8, 30)


@pytest.mark.parametrize("epoch", [EPOCH, datetime(2016, 12, 31, 23, 55), datetime(2019, 1, 1)])
def test_orientation_agrees_with_astropy(epoch):
    import astropy.units as u
    from astropy.coordinates import GCRS, ITRS, CartesianRepresentation
    from astropy.time import Time
    from astropy.utils import iers

    times = np.array([-800.0, 0.0, 3500.0])
    position = np.array([6.9e6, 1.2e6, -2.1e6])
    with iers.conf.set_temp("auto_download", False), iers.conf.set_temp("auto_max_age", None):
        moment = Time(epoch, scale="utc") + times * u.s
        celestial = GCRS(CartesianRepresentation(np.tile(position, (3, 1)).T * u.m), obstime=moment)
        there = celestial.transform_to(ITRS(obstime=moment)).cartesian.xyz.to_value("m").T
    ours = EarthOrientation(epoch).fixed_from_inertial(times) @ position
    assert np.allclose(ours, there, rtol=0, atol=0.02)  # m; bulletins A and B differ by this much


def test_orientation_outside_the_table_says_so():
    earth = EarthOrientation(datetime(2060, 1, 1))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        matrix = earth.fixed_from_inertial(0.0)
    assert np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-14)
    assert "last known" in earth.name


def test_energy_and_momentum_about_the_pole_are_kept():
    orbit = orbit_of_request(OrbitRequest(EPOCH, eccentricity=0.01, node=0.3, argument_of_latitude=1.1))
    times = np.array([-3000.0, 0.0, 6000.0, 40000.0])
    states = orbit.states(times)
    r, v = states[:, :3], states[:, 3:]
    pole = orbit.earth.pole(0.0)
    radius = np.linalg.norm(r, axis=1)
    sine = r @ pole / radius
    potential = -GRAVITATIONAL_PARAMETER / radius * (
        1 - SECOND_ZONAL_HARMONIC * (GRAVITY_RADIUS / radius) ** 2 * (1.5 * sine**2 - 0.5))
    energy = 0.5 * np.sum(v * v, axis=1) + potential
    momentum = np.cross(r, v) @ pole
    assert np.allclose(energy, energy[1], rtol=1e-10)
    assert np.allclose(momentum, momentum[1], rtol=1e-10)


def test_node_of_the_sun_synchronous_orbit_turns_once_a_year():
    orbit = orbit_of_request(OrbitRequest(EPOCH, node=1.0, argument_of_latitude=0.0))
    times = np.arange(0.0, 5.0 * orbit.period, 60.0)
    states = orbit.states(times)
    pole = orbit.earth.pole(0.0)
    normal = np.cross(states[:, :3], states[:, 3:])
    east = np.cross(pole, normal)
    reference = np.cross(pole, [1.0, 0.0, 0.0])
    node = np.unwrap(np.arctan2(-(east @ np.cross(reference, pole)), east @ reference))
    slope = math.degrees(np.polyfit(times, node, 1)[0]) * 86400.0
    assert slope == pytest.approx(0.9857, abs=0.01)  # deg/day


def test_arc_is_the_integrated_orbit_and_its_derivative():
    orbit = orbit_of_request(OrbitRequest(EPOCH, overhead=(0.7, 0.5)))
    arc = orbit.arc(-700.0, 700.0)
    times = np.linspace(-690, 690, 37)
    states = orbit.states(times)
    position, velocity = arc.inertial(times)
    assert np.allclose(position, states[:, :3], rtol=0, atol=1e-3)
    assert np.allclose(velocity, states[:, 3:], rtol=0, atol=1e-5)
    later, _ = arc.inertial(times + 0.05)
    earlier, _ = arc.inertial(times - 0.05)
    assert np.allclose((later - earlier) / 0.1, velocity, rtol=0, atol=1e-2)


CASES = [(40.5, 29.2, True, 0.0), (-33.0, 151.0, False, 200e3), (70.0, -179.95, True, -300e3), (0.0, 0.0, False, 50e3),
         (81.0, 10.0, True, -120e3)]


@pytest.mark.parametrize(("latitude", "longitude", "ascending", "offset"), CASES)
@pytest.mark.parametrize("eccentricity", [0.0, 0.02])
def test_closest_ground_track_passes_at_the_asked_distance(latitude, longitude, ascending, offset, eccentricity):
    point = math.radians(latitude), math.radians(longitude)
    orbit = orbit_of_request(OrbitRequest(EPOCH, semi_major_axis=7.3e6, eccentricity=eccentricity, overhead=point,
                                          ascending=ascending, offset=offset))
    times = np.linspace(-300, 300, 601)
    track = orbit.arc(-310.0, 310.0).ground_track(times)
    distance, azimuth, _ = geodesic_inverse(*point, track[0], track[1])
    assert distance.argmin() == 300
    assert distance[300] == pytest.approx(abs(offset), abs=0.01)
    assert bool(orbit.velocity[2] > 0) == ascending
    if offset:
        side = math.sin(azimuth[300] - track[2][300])  # right of the flight is positive
        assert side * math.copysign(1, offset) > 0.9
    found = passes_over(orbit, *point, -600.0, 600.0, 900e3)
    assert len(found) == 1
    assert found[0].time == pytest.approx(0.0, abs=0.05)


def test_a_point_beyond_the_highest_latitude_is_refused():
    with pytest.raises(GeometryError, match="never passes") as caught:
        orbit_of_request(OrbitRequest(EPOCH, inclination=math.radians(51.6), overhead=(1.2, 0.0)))
    assert "51.6" in str(caught.value)


def test_state_has_the_elements_it_was_made_of():
    position, velocity = state_from_elements(7.2e6, 0.1, 1.1, 2.0, 0.4, 1.7)
    radius = np.linalg.norm(position)
    energy = 0.5 * velocity @ velocity - GRAVITATIONAL_PARAMETER / radius
    assert -GRAVITATIONAL_PARAMETER / (2 * energy) == pytest.approx(7.2e6)
    normal = np.cross(position, velocity)
    assert math.acos(normal[2] / np.linalg.norm(normal)) == pytest.approx(1.1)
    assert math.atan2(normal[0], -normal[1]) == pytest.approx(2.0)
    vector = np.cross(velocity, normal) / GRAVITATIONAL_PARAMETER - position / radius
    assert np.linalg.norm(vector) == pytest.approx(0.1)
    node = np.array([math.cos(2.0), math.sin(2.0), 0.0])
    assert math.acos(vector @ node / 0.1) == pytest.approx(0.4)
