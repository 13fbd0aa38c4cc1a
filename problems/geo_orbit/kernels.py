"""The per-measurement kernels of orbit determination, in terms of the engine's :class:`~estimator.residuals.Kernel`.

The same functions serve the joint batch, the filters and the simulation; the corrections that effects and biases make
enter by name.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from estimator.models.light_time import Earth
from estimator.models.orbit_environment import SpaceEnvironment
from estimator.models.ranging import SIZES, Antenna, Corrections, Kind, Signalling, difference, predicted
from estimator.models.station import east_north_up, station_position
from estimator.orbit_signal import STATE
from estimator.residuals import Kernel
from estimator.unknowns import Unknown
from problems.geo_orbit.tracking import Station


@dataclass(frozen=True)
class Correcting:
    """An unknown that corrects a measurement through one field of :class:`~estimator.models.ranging.Corrections`."""

    unknown: Unknown
    field: str
    component: int | None = None
    """Which number of the unknown it is; None for all of them."""


_DATA: tuple[tuple[str, int | tuple[int, int]], ...] = (
    ("intermediate", (3, 3)),
    ("angle", 1),
    ("pole", (3, 3)),
    ("transmitter", 3),
    ("transmitter_axes", (3, 3)),
    ("transmitter_altitude", 1),
    ("receiver", 3),
    ("receiver_axes", (3, 3)),
    ("receiver_altitude", 1),
)

_KERNELS: dict[tuple, Kernel] = {}


def measurement_kernel(kind: Kind, signalling: Signalling, same: bool, correcting: Sequence[Correcting]) -> Kernel:
    """The kernel of one kind of measurement: measured minus predicted, SI and radians.

    Args:
        kind: what is measured.
        signalling: how.
        same: two-way, or a bistatic pair.
        correcting: unknowns that correct it; several may act on one field and add up.
    """
    key = (kind, signalling, same, tuple(correcting))
    if key in _KERNELS:
        return _KERNELS[key]

    def build(seen: dict[str, ca.SX]) -> ca.SX:
        corrections = Corrections()
        for c in correcting:
            value = seen[c.unknown.name] if c.component is None else seen[c.unknown.name][c.component]
            before = getattr(corrections, c.field)
            setattr(corrections, c.field, value if before is None else before + value)
        earth = Earth(seen["intermediate"], seen["angle"], seen["pole"])
        sender, receptor = (
            Antenna(seen[n], seen[f"{n}_axes"], seen[f"{n}_altitude"]) for n in ("transmitter", "receiver")
        )
        value = predicted(kind, seen["state"], earth, sender, receptor, signalling, corrections, same=same)
        return difference(kind, seen["measured"], value)

    kernel = Kernel(
        f"orbit_{kind}",
        [c.unknown for c in correcting],
        [("state", STATE)],
        [("measured", SIZES[kind]), *_DATA],
        [],
        build,
    )
    _KERNELS[key] = kernel
    return kernel


def measurement_data(
    environment: SpaceEnvironment, time: np.ndarray, transmitter: Station, receiver: Station
) -> dict[str, np.ndarray]:
    """The kernel's data inputs (all but the measured value) at time tags (n,), s after the epoch."""
    intermediate, angle, pole = environment.orientation_parts(time)
    n = len(time)
    data = {"intermediate": intermediate, "angle": angle[:, None], "pole": pole}
    for role, s in (("transmitter", transmitter), ("receiver", receiver)):
        data[role] = np.tile(station_position(s.latitude, s.longitude, s.altitude), (n, 1))
        data[f"{role}_axes"] = np.tile(east_north_up(s.latitude, s.longitude), (n, 1, 1))
        data[f"{role}_altitude"] = np.full((n, 1), s.altitude)
    return data
