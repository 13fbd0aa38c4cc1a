"""Geometry on the ellipsoid against published values, an independent integration and its own inverses."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from estimator.models.errors import GeometryError
from guidance.ground_geometry import (
    ECCENTRICITY_SQUARED,
    EQUATORIAL_RADIUS,
    POLAR_RADIUS,
    EquidistantPlane,
    earth_fixed_from_geodetic,
    ellipsoid_normal,
    geodesic_direct,
    geodesic_inverse,
    geodetic_from_earth_fixed,
    nearest_intersection,
    off_nadir_angle,
    wrapped,
)

latitudes = st.floats(-1.55, 1.55)
longitudes = st.floats(-3.14, 3.14)
azimuths = st.floats(-3.14, 3.14)


def test_geodesic_of_flinders_peak_and_buninyong():
    # Geocentric Datum of Australia technical manual: 54,972.271 m, 306 deg 52' 05.37", 127 deg 10' 25.07", on GRS 80,
    # whose flattening agrees with WGS 84 to 2e-11.
    def angle(d: float, m: float, s: float) -> float:
        return math.radians(math.copysign(abs(d) + m / 60 + s / 3600, d))

    start = angle(-37, 57, 3.72030), angle(144, 25, 29.52440)
    stop = angle(-37, 39, 10.15610), angle(143, 55, 35.38390)
    length, azimuth, arriving = geodesic_inverse(*start, *stop)
    assert length == pytest.approx(54972.271, abs=6e-4)
    assert math.degrees(azimuth) % 360 == pytest.approx(306 + 52 / 60 + 5.37 / 3600, abs=2e-6)
    assert (math.degrees(arriving) + 180) % 360 == pytest.approx(127 + 10 / 60 + 25.07 / 3600, abs=2e-6)


@given(latitudes, longitudes, azimuths, st.floats(1.0, 3e6))
def test_direct_and_inverse_agree(latitude, longitude, azimuth, distance):
    end = geodesic_direct(latitude, longitude, azimuth, distance)
    length, begun, _ = geodesic_inverse(latitude, longitude, end[0], end[1])
    assert length == pytest.approx(distance, abs=1e-4 + 1e-9 * distance)
    assert abs(float(wrapped(begun - azimuth))) * distance < 1e-2


def test_direct_follows_the_differential_equations_of_a_geodesic():
    # Latitude, longitude and azimuth along the line by the radii of curvature: another algorithm altogether.
    def derivative(_: float, state: np.ndarray) -> list[float]:
        latitude, _, azimuth = state
        root = math.sqrt(1 - ECCENTRICITY_SQUARED * math.sin(latitude) ** 2)
        transverse = EQUATORIAL_RADIUS / root
        meridian = EQUATORIAL_RADIUS * (1 - ECCENTRICITY_SQUARED) / root**3
        return [math.cos(azimuth) / meridian, math.sin(azimuth) / (transverse * math.cos(latitude)),
                math.tan(latitude) * math.sin(azimuth) / transverse]

    start = np.radians([40.5, 29.2, -13.7])
    solution = solve_ivp(derivative, (0, 800e3), start, rtol=1e-12, atol=1e-14)
    latitude, longitude, azimuth = geodesic_direct(*start, 800e3)
    assert np.allclose([latitude, longitude, azimuth], solution.y[:, -1], rtol=0, atol=2e-10)


def test_nearly_opposite_points_are_refused():
    with pytest.raises(GeometryError, match="opposite"):
        geodesic_inverse(0.0, 0.0, 1e-4, math.pi - 1e-4)


@given(latitudes, longitudes, st.floats(-5e3, 4e7))
def test_geodetic_coordinates_come_back(latitude, longitude, height):
    back = geodetic_from_earth_fixed(earth_fixed_from_geodetic(latitude, longitude, height))
    assert float(back[0]) == pytest.approx(latitude, abs=1e-12)
    assert abs(float(wrapped(back[1] - longitude))) < 1e-12
    assert float(back[2]) == pytest.approx(height, abs=2e-8 * max(1.0, abs(height) / 1e3))


@given(latitudes, longitudes, st.floats(2e5, 2e6), st.floats(0.0, 0.9), azimuths)
def test_a_line_of_sight_meets_the_ellipsoid_in_its_nearer_point(latitude, longitude, height, tilt, turn):
    position = earth_fixed_from_geodetic(latitude, longitude, height)
    down = -ellipsoid_normal(latitude, longitude)
    side = np.cross(down, [0.3, -0.5, 0.8])
    side /= np.linalg.norm(side)
    direction = math.cos(tilt) * down + math.sin(tilt) * (math.cos(turn) * side + math.sin(turn) * np.cross(down, side))
    point = nearest_intersection(position, direction)
    if np.isnan(point).any():
        assert tilt > math.asin(POLAR_RADIUS / (EQUATORIAL_RADIUS + height)) - 0.01
        return
    assert np.sum((point / [EQUATORIAL_RADIUS, EQUATORIAL_RADIUS, POLAR_RADIUS]) ** 2) == pytest.approx(1, abs=1e-12)
    assert np.linalg.norm(np.cross(point - position, direction)) < 1e-6
    normal = ellipsoid_normal(*geodetic_from_earth_fixed(point)[:2])
    assert normal @ direction < 1e-9  # the side of the Earth that the satellite sees
    assert float(off_nadir_angle(position, direction)) == pytest.approx(tilt, abs=1e-9)


def test_a_ray_into_space_misses_the_earth():
    assert np.isnan(nearest_intersection([7e6, 0, 0], [1.0, 0, 0])).all()
    assert np.isnan(nearest_intersection([7e6, 0, 0], [0, 1.0, 0])).all()


@given(latitudes, longitudes, azimuths, st.floats(-4e5, 4e5), st.floats(-4e5, 4e5))
def test_equidistant_plane_is_true_from_its_centre(latitude, longitude, azimuth, along, across):
    plane = EquidistantPlane(latitude, longitude, azimuth)
    point = plane.to_ellipsoid(along, across)
    back = plane.to_plane(*point)
    assert np.allclose([*back], [along, across], atol=2e-2)
    assert geodesic_inverse(latitude, longitude, *point)[0] == pytest.approx(math.hypot(along, across), abs=1e-3)


def test_the_plane_crosses_the_date_line():
    plane = EquidistantPlane(math.radians(-17.0), math.radians(179.9))
    latitude, longitude = plane.to_ellipsoid(0.0, 50e3)
    assert longitude < 0
    assert np.allclose(plane.to_plane(latitude, longitude), (0.0, 50e3), atol=1e-3)
