"""What the readers give: stations, observations, the files' own settings. Mathematics nowhere, SI everywhere."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from estimator.models.ranging import Kind


@dataclass(frozen=True)
class Station:
    """A ground station.

    Attributes:
        name: as in the data.
        latitude, longitude: geodetic, rad; altitude: above the ellipsoid, m.
        sigma: standard deviation by component name ("range", "azimuth", ...), SI; empty takes the settings'.
        bias: start value of the bias by component, SI.
        estimated_biases: components whose bias is estimated.
    """

    name: str
    latitude: float
    longitude: float
    altitude: float
    sigma: dict[str, float] = field(default_factory=dict)
    bias: dict[str, float] = field(default_factory=dict)
    estimated_biases: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Observations:
    """Measurements of one kind by one station or bistatic pair, in the order of time.

    Attributes:
        kind: what is measured.
        receiver, transmitter: names of the stations; equal for two-way measurements.
        time: (n,) datetime64[us], TAI.
        value: (n, m) SI and radians.
        source: file, for messages.
        line: (n,) line in the file, for messages.
    """

    kind: Kind
    receiver: str
    transmitter: str
    time: np.ndarray
    value: np.ndarray
    source: str = ""
    line: np.ndarray | None = None

    @property
    def name(self) -> str:
        """Station, or pair."""
        return self.receiver if self.receiver == self.transmitter else f"{self.transmitter}>{self.receiver}"

    def subset(self, keep: np.ndarray) -> Observations:
        """The observations of the boolean mask ``keep`` (n,)."""
        return replace(
            self, time=self.time[keep], value=self.value[keep], line=None if self.line is None else self.line[keep]
        )


@dataclass(frozen=True, eq=False)
class Tracking:
    """Observations of one satellite and what the files say about stations and model.

    Attributes:
        observations: one entry per kind and station (or pair).
        stations: by name.
        settings: entries of the settings tables that a file carries (see :mod:`problems.geo_orbit.settings`).
        satellite: name, where a file gives one.
    """

    observations: tuple[Observations, ...]
    stations: dict[str, Station] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    satellite: str = ""

    def merged(self, other: Tracking) -> Tracking:
        """Both together; observations of the same kind and stations are put in the order of time."""
        groups: dict[tuple[str, str, str], list[Observations]] = {}
        for o in (*self.observations, *other.observations):
            groups.setdefault((o.kind, o.transmitter, o.receiver), []).append(o)
        return Tracking(
            tuple(_joined(g) for g in groups.values()),
            {**self.stations, **other.stations},
            deep_merged(self.settings, other.settings),
            self.satellite or other.satellite,
        )


def _joined(group: list[Observations]) -> Observations:
    if len(group) == 1:
        return group[0]
    time = np.concatenate([g.time for g in group])
    order = np.argsort(time, kind="stable")
    lines = [np.zeros(len(g.time), dtype=int) if g.line is None else g.line for g in group]
    return Observations(
        group[0].kind,
        group[0].receiver,
        group[0].transmitter,
        time[order],
        np.concatenate([g.value for g in group])[order],
        ", ".join(dict.fromkeys(g.source for g in group)),
        np.concatenate(lines)[order],
    )


def deep_merged(a: dict[str, Any], b: dict[str, Any]) -> dict[str, Any]:
    """Nested tables with those of ``b`` over those of ``a``."""
    merged = dict(a)
    for key, value in b.items():
        merged[key] = (
            deep_merged(merged[key], value) if isinstance(value, dict) and isinstance(merged.get(key), dict) else value
        )
    return merged
