"""The effects that the model of an orbit may be missing: each declared once, with parameters, zero and reference.

An :class:`OrbitEffect` either adds an acceleration, or a velocity step, or corrects a measurement through one field of
:class:`estimator.models.ranging.Corrections`. :func:`instances` gives those that exist on a set of data: one for all
stations and one per station where the effect belongs to a station. With all ordinary parameters zero each is the model
without it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

from estimator.effects.declaration import Parameter, Search, axes
from estimator.models.errors import RequestError
from estimator.models.orbit_motion import (
    BURN_MISALIGNMENT,
    BURN_SCALE,
    LUNI_SOLAR,
    OBLIQUE_PRESSURE,
    SOLAR_PRESSURE,
    Acceleration,
    constant_acceleration,
    further_geopotential,
)

Channel = Literal["force", "manoeuvre", "measurement"]


@dataclass(frozen=True)
class OrbitLayout:
    """What the effects need to know about the data and the model.

    Attributes:
        stations: names, with the kinds of measurement of each.
        span: first and last time, s after the epoch.
        gravity, degree: the model's field.
        luni_solar: whether Sun and Moon are both in the model.
        reflection: the model's reflection coefficient; 0 where sunlight is not in the model.
        reflection_estimated, acceleration_estimated: whether the model estimates these already.
        burns: number of commanded burns.
        light_time: whether the model takes the light time into account.
        biased: components with an estimated bias, by station.
    """

    stations: tuple[tuple[str, tuple[str, ...]], ...]
    span: tuple[float, float]
    gravity: str
    degree: int
    luni_solar: bool
    reflection: float
    reflection_estimated: bool
    acceleration_estimated: bool
    burns: int
    light_time: bool
    biased: tuple[tuple[str, tuple[str, ...]], ...]


@dataclass(frozen=True)
class OrbitEffect:
    """One effect on one set of data.

    Attributes:
        name: with ":station" or ":variant" where there are several.
        family: the fixed name of the effect.
        channel: what it changes.
        parameters: the added numbers.
        acceleration: of a force.
        correction: field of :class:`estimator.models.ranging.Corrections`, of a measurement.
        kinds: kinds of measurement that it changes.
        station: the station it belongs to; "" for all.
        each: stations that have one parameter each, in the order of the parameters; empty where all share them.
        zero: the condition under which it vanishes.
        reference: where the formula comes from.
    """

    name: str
    family: str
    channel: Channel
    parameters: tuple[Parameter, ...]
    acceleration: Acceleration | None = None
    correction: str = ""
    kinds: tuple[str, ...] = ()
    station: str = ""
    zero: str = ""
    reference: str = ""
    each: tuple[str, ...] = ()
    state_size: int = 0  # an orbit effect has no internal states


_ALL = ("range", "range_rate", "azimuth_elevation", "direction_cosines")
_MEASUREMENTS: tuple[tuple[str, str, tuple[str, ...], tuple[Parameter, ...], bool, str], ...] = (
    ("range-bias", "range_bias", ("range",), (Parameter("bias", "m", 100.0, (-1e5, 1e5)),), True, "delay of equipment"),
    (
        "range-rate-bias",
        "range_rate_bias",
        ("range_rate",),
        (Parameter("bias", "m/s", 0.1, (-10.0, 10.0)),),
        True,
        "offset of a frequency standard",
    ),
    (
        "angle-bias",
        "angle_bias",
        ("azimuth_elevation", "direction_cosines"),
        (Parameter("first", "rad", 1e-3, (-0.05, 0.05)), Parameter("second", "rad", 1e-3, (-0.05, 0.05))),
        True,
        "orientation of a mount",
    ),
    (
        "range-scale-error",
        "range_scale",
        ("range",),
        # 3e5 km/s in place of the speed of light makes 6.9e-4; beyond 2e-3 no constant in use is as wrong.
        (Parameter("scale", "1", 1e-6, (-2e-3, 2e-3)),),
        False,
        "a wrong constant or rate of a clock multiplies every range",
    ),
    (
        "station-position-error",
        "station",
        _ALL,
        axes("offset", "m", 300.0, 3000.0, ("east", "north", "up")),
        True,
        "survey of the antenna",
    ),
    (
        "timetag-offset",
        "time_tag",
        _ALL,
        (Parameter("offset", "s", 0.01, (-100.0, 100.0)),),
        True,
        "clock of a station",
    ),
    (
        "tropospheric-delay",
        "zenith_troposphere",
        ("range",),
        (Parameter("zenith_delay", "m", 0.3, (-1.0, 4.0)),),
        True,
        "Saastamoinen (1972), thin flat layer",
    ),
    (
        "ionospheric-delay",
        "vertical_ionosphere",
        ("range",),
        (Parameter("vertical_delay", "m", 1.0, (0.0, 30.0)),),
        True,
        "thin shell at 350 km",
    ),
)


@lru_cache(maxsize=64)
def instances(layout: OrbitLayout) -> tuple[OrbitEffect, ...]:
    """All effects that may be added to the model of these data, the same objects for the same layout."""
    found: list[OrbitEffect] = []

    def force(
        name: str, parameters: tuple[Parameter, ...], acceleration: Acceleration, zero: str, reference: str
    ) -> None:
        found.append(
            OrbitEffect(name, name.split(":")[0], "force", parameters, acceleration, zero=zero, reference=reference)
        )

    three = axes("acceleration", "m/s2", 1e-5, 1e-3)
    if not layout.acceleration_estimated:
        rates = axes("rate", "m/s3", 1e-10, 1e-7)
        force(
            "constant-acceleration",
            three,
            constant_acceleration("constant-acceleration"),
            "acceleration = 0",
            "leak or outgassing of a satellite that keeps its attitude against the stars",
        )
        force(
            "constant-acceleration:orbital",
            axes("acceleration", "m/s2", 1e-5, 1e-3, ("radial", "along", "cross")),
            constant_acceleration("constant-acceleration:orbital", orbital=True),
            "acceleration = 0",
            "leak or outgassing of a satellite that keeps its attitude against the Earth",
        )
        force(
            "constant-acceleration:linear",
            (*three, *rates),
            constant_acceleration("constant-acceleration:linear", linear=True),
            "acceleration = rate = 0",
            "leak that changes with time",
        )
    if not layout.reflection_estimated:
        force(
            "solar-radiation-pressure",
            (Parameter("coefficient", "1", 1.0, (-layout.reflection, 3.0 - layout.reflection)),),
            SOLAR_PRESSURE,
            "coefficient added to the model's = 0",
            "Montenbruck and Gill (2000), equation 3.75",
        )
    if layout.reflection:
        force(
            "solar-radiation-pressure:oblique",
            (
                Parameter("across", "1", 0.2, (-layout.reflection, layout.reflection)),
                Parameter("normal", "1", 0.2, (-layout.reflection, layout.reflection)),
            ),
            OBLIQUE_PRESSURE,
            "both coefficients = 0",
            "panels and body do not push along the line from the Sun alone: Soop (1994), Handbook of Geostationary "
            "Orbits, section 3.5",
        )
    if not layout.luni_solar:
        force(
            "luni-solar-gravity",
            (Parameter("scale", "1", 1.0, (0.0, 2.0), nominal=1.0),),
            LUNI_SOLAR,
            "scale = 0",
            "Battin (1999), section 8.4",
        )
    if layout.degree < 20:
        force(
            f"geopotential-degree:{layout.degree + 1}-20",
            (Parameter("scale", "1", 1.0, (0.0, 2.0), nominal=1.0),),
            _extension(layout.gravity, layout.degree),
            "scale = 0",
            "the gravity field's own further terms",
        )
    if layout.burns:
        force(
            "thrust-scale-error",
            (Parameter("scale", "1", 0.05, (-0.5, 0.5)),),
            BURN_SCALE,
            "scale = 0",
            "the book's error of the control acceleration",
        )
        force(
            "thrust-misalignment",
            (Parameter("about_along", "rad", 0.02, (-0.3, 0.3)), Parameter("about_cross", "rad", 0.02, (-0.3, 0.3))),
            BURN_MISALIGNMENT,
            "both angles = 0",
            "two small rotations of the thrust",
        )
    a, b = layout.span
    found.append(
        OrbitEffect(
            "impulsive-manoeuvre",
            "impulsive-manoeuvre",
            "manoeuvre",
            (
                Parameter(
                    "time",
                    "s",
                    max(600.0, (b - a) / 100),
                    (a, b),
                    search=Search(a + 0.02 * (b - a), b - 0.02 * (b - a), 40, "linear"),
                ),
                *axes("velocity", "m/s", 0.1, 2000.0, ("radial", "along", "cross")),
            ),
            zero="velocity = 0",
            reference="a burn short against the orbit",
        )
    )
    biased = dict(layout.biased)
    for family, correction, kinds, parameters, per_station, reference in _MEASUREMENTS:
        present = [name for name, has in layout.stations if set(has) & set(kinds)]
        if not present:
            continue
        taken = [
            name
            for name in present
            if (family == "range-bias" and "range" in biased.get(name, ()))
            or (family == "range-rate-bias" and "range_rate" in biased.get(name, ()))
            or (family == "angle-bias" and set(biased.get(name, ())) & {"azimuth", "elevation", "cosine_north"})
        ]
        zero = "all parameters = 0"
        if not taken and family != "station-position-error":
            found.append(
                OrbitEffect(family, family, "measurement", parameters, None, correction, kinds, "", zero, reference)
            )
        if per_station:
            found += [
                OrbitEffect(
                    f"{family}:{name}",
                    family,
                    "measurement",
                    parameters,
                    None,
                    correction,
                    kinds,
                    name,
                    zero,
                    reference,
                )
                for name in present
                if name not in taken
            ]
    ranging = tuple(name for name, has in layout.stations if "range" in has and "range" not in biased.get(name, ()))
    if len(ranging) > 1:
        found.append(
            OrbitEffect(
                "range-bias:each",
                "range-bias",
                "measurement",
                tuple(Parameter(name, "m", 100.0, (-1e5, 1e5)) for name in ranging),
                None,
                "range_bias",
                ("range",),
                each=ranging,
                zero="all biases = 0",
                reference="delay of equipment, another one at every station",
            )
        )
    if not layout.light_time:
        found.append(
            OrbitEffect(
                "light-time",
                "light-time",
                "measurement",
                (Parameter("scale", "1", 1.0, (0.0, 2.0), nominal=1.0),),
                None,
                "light_time",
                _ALL,
                "",
                "scale = 0",
                "the signal travels at the speed of light",
            )
        )
    found.append(
        OrbitEffect(
            "earth-rotation-offset",
            "earth-rotation-offset",
            "measurement",
            (Parameter("angle", "rad", 1e-6, (-0.01, 0.01)),),
            None,
            "earth_angle",
            _ALL,
            "",
            "angle = 0",
            "error of UT1",
        )
    )
    return tuple(found)


@lru_cache(maxsize=8)
def _extension(gravity: str, degree: int) -> Acceleration:
    from estimator.models.orbit_gravity import gravity_field

    return further_geopotential(f"geopotential-degree:{degree + 1}-20", gravity_field(gravity, 20), degree)


def chosen(layout: OrbitLayout, names: Iterable[str]) -> tuple[OrbitEffect, ...]:
    """The effects asked for by name; a family's name gives the instance of that name, else all of the family.

    Raises:
        RequestError: no such effect on these data.
    """
    offered = instances(layout)
    by_name = {e.name: e for e in offered}
    result: list[OrbitEffect] = []
    for name in names:
        found = [by_name[name]] if name in by_name else [e for e in offered if e.family == name]
        if not found:
            raise RequestError(
                f"no effect {name!r} exists on these data", where="effects", remedy="choose from " + ", ".join(by_name)
            )
        result += [e for e in found if e not in result]
    return tuple(result)
