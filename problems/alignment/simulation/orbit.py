"""The true orbit: two-body and zonal gravity, integrated in inertial axes, and turned into Earth-fixed axes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

from estimator.models.errors import RequestError

GRAVITATIONAL_PARAMETER = 3.986004418e14  # [m3/s2]
EARTH_RADIUS = 6378137.0  # [m]


def initial_state(
    semi_major_axis: float,
    eccentricity: float,
    inclination: float,
    ascending_node: float,
    argument_of_perigee: float,
    true_anomaly: float,
) -> np.ndarray:
    """Inertial position (m) and velocity (m/s), (6), from osculating elements (m, rad)."""
    parameter = semi_major_axis * (1.0 - eccentricity**2)
    radius = parameter / (1.0 + eccentricity * math.cos(true_anomaly))
    speed = math.sqrt(GRAVITATIONAL_PARAMETER / parameter)
    plane = np.array([
        [radius * math.cos(true_anomaly), -speed * math.sin(true_anomaly)],
        [radius * math.sin(true_anomaly), speed * (eccentricity + math.cos(true_anomaly))],
        [0.0, 0.0],
    ])
    turn = about_z(ascending_node).T @ about_x(inclination).T @ about_z(argument_of_perigee).T
    return (turn @ plane).T.ravel()


def about_x(angle: float) -> np.ndarray:
    """Matrix that takes coordinates into axes turned by ``angle`` (rad) about x."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]])


def about_z(angle: float) -> np.ndarray:
    """Matrix that takes coordinates into axes turned by ``angle`` (rad) about z."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def acceleration(position: np.ndarray, zonal: Sequence[float]) -> np.ndarray:
    """Acceleration (..., 3) m/s2 in the field -mu/r (1 - sum J_n (R/r)^n P_n(z/r)), axes with z along the pole.

    Gradient of the potential with the Legendre polynomials by Bonnet's recursion: the radial part is
    -mu/r2 (1 - sum (n+1) J_n (R/r)^n P_n(s)), the part towards the pole -mu/r2 sum J_n (R/r)^n P_n'(s), with s = z/r.
    """
    x, y, z = position[..., 0], position[..., 1], position[..., 2]
    radius = np.sqrt(x * x + y * y + z * z)
    along, towards = _field(z / radius, EARTH_RADIUS / radius, zonal)
    factor = GRAVITATIONAL_PARAMETER / radius**2
    s = z / radius
    scale = factor * (along + s * towards) / radius
    result = -position * scale[..., None]
    result[..., 2] += factor * towards
    return result


def _field(s, ratio, zonal: Sequence[float]):  # type: ignore[no-untyped-def]
    """The radial and the poleward factor of the field for s = z/r and R/r (numbers or arrays).

    The unit vector to the pole has the part (pole - s radial) across the radius.
    """
    previous, current = 1.0, s
    slope_previous, slope = 0.0, 1.0
    power = ratio
    along, towards = 1.0, 0.0
    for n, coefficient in enumerate(zonal, start=2):
        following = ((2 * n - 1) * s * current - (n - 1) * previous) / n
        slope_following = slope_previous + (2 * n - 1) * current
        previous, current = current, following
        slope_previous, slope = slope, slope_following
        power = power * ratio
        along = along - (n + 1) * coefficient * power * current
        towards = towards - coefficient * power * slope
    return along, towards


def _derivative(zonal: Sequence[float]):  # type: ignore[no-untyped-def]
    """Right side for the integrator, in plain numbers: an array of three costs more than the arithmetic."""

    def derivative(_t: float, state: np.ndarray) -> list[float]:
        x, y, z, u, v, w = state.tolist()
        radius = math.sqrt(x * x + y * y + z * z)
        s = z / radius
        along, towards = _field(s, EARTH_RADIUS / radius, zonal)
        factor = GRAVITATIONAL_PARAMETER / (radius * radius)
        scale = -factor * (along + s * towards) / radius
        return [u, v, w, scale * x, scale * y, scale * z + factor * towards]

    return derivative


@dataclass(frozen=True)
class Orbit:
    """The true trajectory as a function of time.

    Attributes:
        solution: dense output of the integrator over the campaign, inertial position and velocity (6, n).
        zonal: J2, J3, ...
        earth_rotation_angle_at_epoch, earth_rotation_rate: rad, rad/s.
        start_state: (6) inertial at the epoch.
    """

    solution: object
    zonal: tuple[float, ...]
    earth_rotation_angle_at_epoch: float
    earth_rotation_rate: float
    start_state: np.ndarray

    def inertial(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Inertial position (n, 3) m and velocity (n, 3) m/s at ``time`` (n,) s after the epoch."""
        state = self.solution(np.asarray(time, dtype=float))  # type: ignore[operator]
        return state[:3].T, state[3:].T

    def acceleration(self, position: np.ndarray) -> np.ndarray:
        """Inertial acceleration (n, 3) m/s2 at inertial positions (n, 3) m."""
        return acceleration(position, self.zonal)

    def earth_angle(self, time: np.ndarray) -> np.ndarray:
        """Rotation angle of the Earth (rad), not reduced."""
        return self.earth_rotation_angle_at_epoch + self.earth_rotation_rate * np.asarray(time, dtype=float)

    def to_earth_fixed(self, time: np.ndarray, vector: np.ndarray) -> np.ndarray:
        """Coordinates (n, 3) of inertial vectors (n, 3) in Earth-fixed axes."""
        angle = self.earth_angle(time)
        c, s = np.cos(angle), np.sin(angle)
        x, y, z = vector.T
        return np.stack([c * x + s * y, c * y - s * x, z], axis=1)

    def from_earth_fixed(self, time: np.ndarray, vector: np.ndarray) -> np.ndarray:
        """Inertial coordinates (n, 3) of Earth-fixed vectors (n, 3)."""
        angle = self.earth_angle(time)
        c, s = np.cos(angle), np.sin(angle)
        x, y, z = vector.T
        return np.stack([c * x - s * y, c * y + s * x, z], axis=1)

    def relative_velocity(self, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Velocity against the rotating Earth (n, 3) m/s, coordinates in inertial axes."""
        rate = self.earth_rotation_rate
        carried = np.stack([-rate * position[:, 1], rate * position[:, 0], np.zeros(len(position))], axis=1)
        return velocity - carried

    def earth_fixed(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Earth-fixed position (n, 3) m and velocity as seen in the rotating frame (n, 3) m/s."""
        position, velocity = self.inertial(time)
        relative = self.relative_velocity(position, velocity)
        return self.to_earth_fixed(time, position), self.to_earth_fixed(time, relative)


def integrate_orbit(
    state: np.ndarray,
    span: tuple[float, float],
    zonal: tuple[float, ...],
    earth_rotation_angle_at_epoch: float,
    earth_rotation_rate: float,
) -> Orbit:
    """Integrate from the state (6) at the epoch over ``span`` (s after the epoch, from at most 0 to at least 0).

    Raises:
        RequestError: the orbit meets the Earth.
    """
    radius = np.linalg.norm(state[:3])
    energy = 0.5 * state[3:] @ state[3:] - GRAVITATIONAL_PARAMETER / radius
    momentum = np.cross(state[:3], state[3:])
    eccentricity = math.sqrt(max(0.0, 1.0 + 2.0 * energy * (momentum @ momentum) / GRAVITATIONAL_PARAMETER**2))
    perigee = (momentum @ momentum) / GRAVITATIONAL_PARAMETER / (1.0 + eccentricity)
    if perigee < EARTH_RADIUS:
        raise RequestError("the orbit meets the Earth", where="scenario.semi_major_axis", value=f"{perigee:.0f} m",
                           limit=f"perigee radius above {EARTH_RADIUS:.0f} m")
    speed = math.sqrt(GRAVITATIONAL_PARAMETER / radius)
    # Step limit: a twentieth of a revolution keeps the dense output far below a millimetre.
    options = {"method": "DOP853", "rtol": 1e-12, "atol": np.repeat([1e-6, 1e-6 * speed / radius], 3),
               "dense_output": True, "max_step": 0.05 * radius / speed * 2.0 * math.pi}
    # A margin before the first and after the last sample, for clocks that run off.
    ends = solve_ivp(_derivative(zonal), (0.0, span[0]), state, **options), \
        solve_ivp(_derivative(zonal), (0.0, span[1]), state, **options)
    return Orbit(_Joined(ends[0].sol, ends[1].sol), zonal, earth_rotation_angle_at_epoch, earth_rotation_rate,
                 np.array(state, dtype=float))


@dataclass(frozen=True)
class _Joined:
    """Dense output before and after the epoch."""

    before: object
    after: object

    def __call__(self, time: np.ndarray) -> np.ndarray:
        early = time < 0.0
        if not early.any():
            return self.after(time)  # type: ignore[operator]
        result = np.empty((6, len(time)))
        result[:, early] = self.before(time[early])  # type: ignore[operator]
        result[:, ~early] = self.after(time[~early])  # type: ignore[operator]
        return result
