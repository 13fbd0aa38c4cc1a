"""What is true in a simulated campaign: the numbers that the data hide, trajectory and attitude as functions."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from problems.alignment.simulation.scenario import Scenario


@dataclass(frozen=True)
class ArcState:
    """State at the start of a rotation arc: ``tracker_from_inertial`` quaternion (4), rate (3) rad/s, tracker axes."""

    attitude: np.ndarray
    rate: np.ndarray


@dataclass(frozen=True)
class Truth:
    """The truth of one campaign; :meth:`to_json` gives what stands in the file beside it.

    Attributes:
        seed: that the campaign was made with.
        scenario: that the campaign was made with.
        antenna_from_tracker, actuator_from_tracker: unit quaternions (4).
        inertia: (3, 3) kg m2, tracker axes.
        torque_map_over_inertia_trace: (3, 3) 1/(kg m2), from command (actuator axes) to torque (tracker axes) over the
            trace of the inertia, with gains and skew axes where such effects are on.
        effects: values of the parameters (SI) by effect and parameter.
        arc_states: by name of the rotation arc.
        orbit_state: (6) inertial position m and velocity m/s at the epoch.
        earth_rotation_angle_at_epoch: rad.
        noise: actual standard deviations ``gnss`` m, ``doppler`` Hz, ``tracker`` (3) rad.
        outliers: indices of gross errors by channel; pairs (sample, beam) for ``doppler``.
        trajectory: time (n,) to Earth-fixed position (n, 3) m and velocity (n, 3) m/s, without any effect.
        inertial_state: time (n,) to inertial position (n, 3) m and velocity (n, 3) m/s.
        attitude: time (n,), all of it inside arcs, to ``tracker_from_inertial`` quaternions (n, 4) and rates (n, 3)
            rad/s in tracker axes, without any effect of the tracker.
    """

    seed: int
    scenario: Scenario
    antenna_from_tracker: np.ndarray
    actuator_from_tracker: np.ndarray
    inertia: np.ndarray
    torque_map_over_inertia_trace: np.ndarray
    effects: Mapping[str, Mapping[str, float]]
    arc_states: Mapping[str, ArcState]
    orbit_state: np.ndarray
    earth_rotation_angle_at_epoch: float
    noise: Mapping[str, Any]
    outliers: Mapping[str, np.ndarray]
    trajectory: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    inertial_state: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    attitude: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]

    @property
    def normalized_inertia(self) -> np.ndarray:
        """Inertia over its trace (3, 3), 1."""
        return self.inertia / np.trace(self.inertia)

    def to_json(self) -> dict[str, Any]:
        """Everything but the functions as plain numbers; of the trajectory a table every 60 s."""
        time = np.arange(0.0, self.scenario.duration + 1e-9, 60.0)  # [s]
        position, velocity = self.trajectory(time)
        return {
            "seed": self.seed,
            "effects": {name: dict(values) for name, values in self.effects.items()},
            "antenna_from_tracker": self.antenna_from_tracker.tolist(),
            "actuator_from_tracker": self.actuator_from_tracker.tolist(),
            "inertia_tracker": self.inertia.tolist(),
            "torque_map_over_inertia_trace": self.torque_map_over_inertia_trace.tolist(),
            "noise": {name: np.asarray(value).tolist() for name, value in self.noise.items()},
            "outliers": {name: value.tolist() for name, value in self.outliers.items()},
            "arc_states": {name: {"tracker_from_inertial": state.attitude.tolist(), "rate_rad_s": state.rate.tolist()}
                           for name, state in self.arc_states.items()},
            "orbit": {"position_inertial_m": self.orbit_state[:3].tolist(),
                      "velocity_inertial_m_s": self.orbit_state[3:].tolist(),
                      "earth_rotation_angle_at_epoch": self.earth_rotation_angle_at_epoch,
                      "zonal_coefficients": list(self.scenario.zonal_coefficients)},
            "trajectory": {"time_s": time.tolist(), "position_earth_fixed_m": position.tolist(),
                           "velocity_earth_fixed_m_s": velocity.tolist()},
            "scenario": dataclasses.asdict(self.scenario),
        }
