"""Tracking measurements of a satellite from the ground, as pure CasADi functions of one measurement.

Range (half the sum of the two legs, or the sum), its rate, azimuth and elevation, and the direction cosines of the
line of sight towards north and east. :class:`Corrections` collects everything that may be wrong with a station, all
zero where nothing is; the batch, the filters and the effects of the discrepancy workflow use the same functions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import casadi as ca

from estimator.models.light_time import Earth, Path, TimeTag, local_direction, range_sum_rate, signal_path
from estimator.models.rotations import Matrix
from estimator.models.troposphere import ionosphere_mapping, refraction, saastamoinen_delay, zenith_mapping

Kind = Literal["range", "range_rate", "azimuth_elevation", "direction_cosines"]
SIZES: dict[str, int] = {"range": 1, "range_rate": 1, "azimuth_elevation": 2, "direction_cosines": 2}
"""Numbers in one measurement of each kind."""
UNITS: dict[str, str] = {"range": "m", "range_rate": "m/s", "azimuth_elevation": "rad", "direction_cosines": "1"}
COMPONENTS: dict[str, tuple[str, ...]] = {
    "range": ("range",),
    "range_rate": ("range_rate",),
    "azimuth_elevation": ("azimuth", "elevation"),
    "direction_cosines": ("cosine_north", "cosine_east"),
}
"""Names of the numbers in one measurement."""


@dataclass(frozen=True)
class Signalling:
    """How a station measures.

    Attributes:
        tag: which instant of the signal the time tag names.
        legs: "half" where a range is half of both legs, "sum" where it is their sum (the book's total range).
        troposphere: whether ranges are delayed by the air.
        bending: whether elevations are lifted by the air.
        light_time: False for a model that takes the geometry of one instant.
    """

    tag: TimeTag = "reception"
    legs: Literal["half", "sum"] = "half"
    troposphere: bool = True
    bending: bool = True
    light_time: bool = True


@dataclass(frozen=True)
class Antenna:
    """A station: Earth-fixed position (3) m, local east-north-up axes (3, 3), altitude m."""

    position: Matrix
    east_north_up: Matrix
    altitude: Matrix


@dataclass
class Corrections:
    """What is added to the ideal measurement; every number is zero in the ideal.

    Attributes:
        range_bias: m; range_scale: relative; range_rate_bias: m/s; angle_bias: (2) rad (or cosines).
        station: (3) east, north, up, m, of the receiver (and of the transmitter where it is the same station).
        time_tag: s that the true instant is later than the tag.
        zenith_troposphere, vertical_ionosphere: one-way delay, m.
        light_time: added to the light-time switch of the model (1 is the physics).
        earth_angle: rad.
    """

    range_bias: Matrix = 0.0
    range_scale: Matrix = 0.0
    range_rate_bias: Matrix = 0.0
    angle_bias: Matrix = None
    station: Matrix = None
    time_tag: Matrix = 0.0
    zenith_troposphere: Matrix = 0.0
    vertical_ionosphere: Matrix = 0.0
    light_time: Matrix = 0.0
    earth_angle: Matrix = 0.0


def _path(
    state: Matrix,
    earth: Earth,
    transmitter: Antenna,
    receiver: Antenna,
    signalling: Signalling,
    corrections: Corrections,
    same: bool,
) -> tuple[Path, Earth, Antenna]:
    earth = Earth(earth.intermediate, earth.angle + corrections.earth_angle, earth.pole)
    place, sender = receiver.position, transmitter.position
    if corrections.station is not None:
        place = place + ca.mtimes(receiver.east_north_up.T, corrections.station)
        sender = place if same else sender
    base = 1.0 if signalling.light_time else 0.0
    path = signal_path(
        state,
        earth,
        sender,
        place,
        tag=signalling.tag,
        offset=corrections.time_tag,
        light_time=base + corrections.light_time,
    )
    return path, earth, Antenna(place, receiver.east_north_up, receiver.altitude)


def predicted(
    kind: Kind,
    state: Matrix,
    earth: Earth,
    transmitter: Antenna,
    receiver: Antenna,
    signalling: Signalling,
    corrections: Corrections,
    *,
    same: bool,
) -> Matrix:
    """The measurement that the model predicts, SI and radians.

    Args:
        kind: what is measured.
        state: (6) of the satellite at the time tag, GCRS.
        earth: orientation at the time tag.
        transmitter, receiver: the stations.
        signalling: how they measure.
        corrections: what is wrong.
        same: whether transmitter and receiver are one station (two-way), else a bistatic pair.
    """
    path, earth, receiver = _path(state, earth, transmitter, receiver, signalling, corrections, same)
    share = 0.5 if signalling.legs == "half" else 1.0
    if kind == "range":
        elevation = _elevation(local_direction(path, earth, receiver.east_north_up))
        total = path.up + path.down
        legs = [(elevation, receiver.altitude)]
        if same:
            legs = legs * 2
        else:
            line = (path.satellite[0] - path.transmitter[0]) / path.up
            local = ca.mtimes(transmitter.east_north_up, ca.mtimes(earth.celestial_from_fixed(path.t1).T, line))
            legs.append((_elevation(local), transmitter.altitude))
        for e, altitude in legs:
            if signalling.troposphere:
                total += saastamoinen_delay(e, altitude)
            total += corrections.zenith_troposphere * zenith_mapping(e)
            total += corrections.vertical_ionosphere * ionosphere_mapping(e)
        return share * total * (1 + corrections.range_scale) + corrections.range_bias
    if kind == "range_rate":
        return share * range_sum_rate(path) + corrections.range_rate_bias
    direction = local_direction(path, earth, receiver.east_north_up)
    if kind == "direction_cosines":
        result = ca.vertcat(direction[1], direction[0])
    else:
        elevation = _elevation(direction)
        if signalling.bending:
            elevation = elevation + refraction(elevation, receiver.altitude)
        result = ca.vertcat(ca.atan2(direction[0], direction[1]), elevation)
    return result if corrections.angle_bias is None else result + corrections.angle_bias


def _elevation(direction: Matrix) -> Matrix:
    return ca.atan2(direction[2], ca.sqrt(direction[0] ** 2 + direction[1] ** 2))


def difference(kind: Kind, measured: Matrix, prediction: Matrix) -> Matrix:
    """Measured minus predicted, the azimuth within half a turn."""
    change = measured - prediction
    if kind == "azimuth_elevation":
        return ca.vertcat(ca.atan2(ca.sin(change[0]), ca.cos(change[0])), change[1])
    return change
