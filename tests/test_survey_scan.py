"""One scan: the image motion it promises, its attitude and its footprint, by other means than those that make it."""

from __future__ import annotations

import math
from datetime import datetime

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.models.errors import GeometryError
from guidance.ground_geometry import (
    GroundLine,
    earth_fixed_from_geodetic,
    geodesic_inverse,
    geodetic_from_earth_fixed,
    nearest_intersection,
)
from guidance.orbit_propagation import orbit_of_request
from guidance.scan import Camera, make_scan
from guidance.survey_request import CameraRequest, OrbitRequest

RATE = 9.3e-3  # rad/s
ORBIT = orbit_of_request(OrbitRequest(datetime(2025, 6, 21, 8, 30), overhead=(math.radians(40.5), math.radians(29.2))))
ARC = ORBIT.arc(-600.0, 600.0)
AZIMUTH = float(ARC.ground_track(np.array(0.0))[2])
CAMERA = Camera(CameraRequest())
LINE = GroundLine(math.radians(40.2), math.radians(30.4), AZIMUTH)


def seen(scan, camera, point, times):
    """Tangents (along, across) in the camera of an Earth-fixed point, from the attitude alone."""
    position, _, turn = scan.arc.earth_fixed(times)
    inertial = np.einsum("nji,nj->ni", turn, point - position)
    body = Rotation.from_quat(scan.motion(times).quaternion, scalar_first=True).inv().apply(inertial)
    camera_axes = body @ camera.body_from_camera
    return camera_axes[:, [0, 2]] / camera_axes[:, [1]]


def image_velocity(scan, camera, time, tangent):
    """Image velocity (along, across) of the ground at a place of the detector line, by differences of its image."""
    position, _, turn = scan.arc.earth_fixed(np.array([time]))
    axes = turn[0] @ Rotation.from_quat(scan.motion([time]).quaternion[0], scalar_first=True).as_matrix() \
        @ camera.body_from_camera
    point = nearest_intersection(position[0], axes[:, 1] + tangent * axes[:, 2])
    step = 0.02  # s
    images = seen(scan, camera, point, time + step * np.array([-2.0, -1.0, 1.0, 2.0]))
    return (images[0] - 8 * images[1] + 8 * images[2] - images[3]) / (12 * step)


@pytest.mark.parametrize(("first", "last", "turned"), [(0.0, 150e3, False), (150e3, 0.0, False), (150e3, 0.0, True)])
def test_constant_image_motion(first, last, turned):
    scan = make_scan(ARC, CAMERA, LINE, first, last, -40.0, RATE, turned=turned)
    sense = -1.0 if last > first or turned else 1.0
    for time in np.linspace(scan.start + 0.1, scan.stop - 0.1, 9):
        velocity = image_velocity(scan, CAMERA, time, 0.0)
        assert velocity[0] == pytest.approx(sense * RATE, rel=1e-6)
        assert abs(velocity[1]) < 1e-8
        for side, rates in zip((-1, 0, 1), scan.image_rates([time])[0][:: 1 if scan.forward != scan.turned else -1],
                               strict=True):
            assert np.allclose(image_velocity(scan, CAMERA, time, side * CAMERA.half_field), rates, rtol=0, atol=1e-8)


@pytest.mark.parametrize(("first", "last"), [(0.0, 120e3), (120e3, 0.0)])
def test_equalised_image_motion_is_the_same_at_both_ends(first, last):
    constant = make_scan(ARC, CAMERA, LINE, first, last, -70.0, RATE)
    scan = make_scan(ARC, CAMERA, LINE, first, last, -70.0, RATE, kind_of_motion="equalised")
    gain = []
    for time in np.linspace(scan.start + 0.1, scan.stop - 0.1, 7):
        left, centre, right = (image_velocity(scan, CAMERA, time, s * CAMERA.half_field) for s in (-1, 0, 1))
        assert abs(left[0] - right[0]) < 1e-9
        assert abs(centre[0]) == pytest.approx(RATE, rel=1e-6)
        plain = [image_velocity(constant, CAMERA, time, s * CAMERA.half_field) for s in (-1, 1)]
        gain.append(abs(plain[0][0] - plain[1][0]))
    assert max(gain) > 1e-5  # what was equalised was not equal before


def test_along_track_keeps_its_pitch():
    scan = make_scan(ARC, CAMERA, LINE, 0.0, 150e3, 60.0, RATE, kind_of_motion="along_track")
    times = np.linspace(scan.start, scan.stop, 25)
    inertial = Rotation.from_quat(scan.motion(times).quaternion, scalar_first=True).apply([0.0, -1.0, 0.0])
    local = np.einsum("nji,nj->ni", ARC.orbital_axes(times), inertial)
    pitch = np.arctan2(local[:, 0], -local[:, 1])
    assert np.ptp(pitch) < 1e-9
    assert pitch[0] < -0.2
    rates = scan.image_rates(times)
    assert np.abs(rates[:, 1, 1]).max() < 1e-9


@pytest.mark.parametrize("kind", ["constant", "equalised", "along_track"])
def test_the_spline_follows_the_geodesic_and_its_derivatives_are_its_own(kind):
    scan = make_scan(ARC, CAMERA, LINE, 10e3, 160e3, -30.0, RATE, kind_of_motion=kind)
    times = np.linspace(scan.start, scan.stop, 201)
    ground, _ = LINE.at(scan.distance(times))
    assert np.linalg.norm(scan.footprint(times).center - ground, axis=1).max() < 1e-3  # m
    start, stop = (geodetic_from_earth_fixed(scan.footprint(np.array([t])).center) for t in (scan.start, scan.stop))
    assert geodesic_inverse(start[0], start[1], stop[0], stop[1])[0][0] == pytest.approx(150e3, abs=0.01)
    assert scan.spline.degree == 7
    inner, step = times[5:-5], 1e-3
    before, here, after = (scan.motion(inner + s) for s in (-step, 0.0, step))
    turned = (Rotation.from_quat(before.quaternion, scalar_first=True).inv()
              * Rotation.from_quat(after.quaternion, scalar_first=True)).as_rotvec() / (2 * step)
    assert np.allclose(turned, here.rate, rtol=0, atol=1e-10)
    assert np.allclose((after.rate - before.rate) / (2 * step), here.acceleration, rtol=0, atol=1e-10)
    assert np.allclose((after.acceleration - before.acceleration) / (2 * step), here.jerk, rtol=0, atol=1e-9)


def test_corners_are_in_the_promised_order():
    for first, last in ((0.0, 100e3), (100e3, 0.0)):
        scan = make_scan(ARC, CAMERA, LINE, first, last, -20.0, RATE)
        corner = [earth_fixed_from_geodetic(*c) for c in scan.corners]
        along = 0.5 * (corner[2] + corner[3]) - 0.5 * (corner[0] + corner[1])
        right = np.cross(along, corner[0])
        assert (corner[1] - corner[0]) @ right > 0
        assert (corner[2] - corner[3]) @ right > 0
        middle = [geodetic_from_earth_fixed(p) for p in (scan.footprint(np.array([scan.middle])).left[0],
                                                         scan.footprint(np.array([scan.middle])).right[0])]
        assert geodesic_inverse(middle[0][0], middle[0][1], middle[1][0], middle[1][1])[0] == pytest.approx(scan.width)


def test_another_mounting_of_the_camera_turns_the_body_and_nothing_else():
    other = Camera(CameraRequest(line_of_sight=(0.6, 0.0, 0.8), along=(0.0, -1.0, 0.0)))
    here = make_scan(ARC, CAMERA, LINE, 0.0, 100e3, -20.0, RATE)
    there = make_scan(ARC, other, LINE, 0.0, 100e3, -20.0, RATE)
    assert there.duration == pytest.approx(here.duration, abs=1e-9)
    assert np.allclose(there.corners, here.corners, rtol=0, atol=1e-9)
    time = np.array([0.5 * (there.start + there.stop)])
    assert np.allclose(there.image_rates(time), here.image_rates(time), rtol=0, atol=1e-9)
    assert not np.allclose(there.motion(time).quaternion, here.motion(time).quaternion, atol=0.1)


def test_what_cannot_be_seen_or_followed_is_refused():
    with pytest.raises(GeometryError, match="horizon"):
        make_scan(ARC, CAMERA, GroundLine(math.radians(-40), 0.5, 0.0), 0.0, 50e3, 0.0, RATE)
    with pytest.raises(GeometryError, match="along the track"):
        make_scan(ARC, CAMERA, GroundLine(LINE.latitude, LINE.longitude, AZIMUTH + math.pi), 0.0, 50e3, 0.0, RATE,
                  kind_of_motion="along_track")
