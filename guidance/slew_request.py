"""What a slew is asked to do: limits, attitude and motion at both ends, and what must be kept away from.

The request file is TOML; every quantity is in SI and radians, quaternions ``(w, x, y, z)`` are ``inertial_from_body``::

    [limits]
    rate = 0.0436            # rad/s
    acceleration = 0.00349   # rad/s2
    jerk = 0.00175           # rad/s3

    [start]
    quaternion = [1.0, 0.0, 0.0, 0.0]
    rate = [0.0, 0.0, 0.0]            # body axes; default 0
    acceleration = [0.0, 0.0, 0.0]    # body axes; default 0

    [stop]
    quaternion = [0.9659258262890683, 0.25881904510252074, 0.0, 0.0]
    jerk = [0.0, 0.0, 0.0]            # optional: the jerk at the last instant

Optional tables: ``[[keep_out]]`` (``name``, ``axis`` in the body, ``direction`` in the inertial frame, ``angle``),
``[actuators]`` (``inertia``, ``torque``, ``momentum`` or ``gyro_momentum``, ``total_momentum``), ``[objective]``
(``kind = "time" | "smoothness"``, ``duration``), ``[solver]`` (``name = "ipopt" | "fatrop"``) and ``[export]``
(``epoch``, ``time_system``, ``reference_frame``, ``object_name``, ``object_id``, ``step``).
"""

from __future__ import annotations

import math
import os
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from estimator.models.errors import (
    FileFormatError,
    MissingDataError,
    NotFiniteError,
    RequestError,
    ShapeError,
    UnitError,
)
from guidance.kinematics import unit_quaternion

Array = np.ndarray

_LARGEST_PLAUSIBLE = {"rate": 1.0, "acceleration": 1.0, "jerk": 10.0}  # rad/s, rad/s2, rad/s3
_UNIT = {"rate": "rad/s", "acceleration": "rad/s2", "jerk": "rad/s3"}


@dataclass(frozen=True)
class Limits:
    """Largest Euclidean norms of rate (rad/s), acceleration (rad/s2) and jerk (rad/s3), body axes.

    Rate and acceleration may be infinite where the actuators limit them instead.

    Raises:
        RequestError: a limit is zero, negative or NaN.
        UnitError: a limit so large that it must be in degrees.
    """

    rate: float
    acceleration: float
    jerk: float

    def __post_init__(self) -> None:
        for name in ("rate", "acceleration", "jerk"):
            value = getattr(self, name)
            if not value > 0 or (name == "jerk" and math.isinf(value)):
                raise RequestError("a limit must be positive and finite", where=f"limits.{name}",
                                   value=f"{value:g} {_UNIT[name]}", limit=f"above 0 {_UNIT[name]}",
                                   remedy="give the largest value that the spacecraft can reach")
            if math.isfinite(value) and value > _LARGEST_PLAUSIBLE[name]:
                raise UnitError("the limit is implausibly large for radians, as if given in degrees",
                                where=f"limits.{name}", value=f"{value:g} {_UNIT[name]}",
                                limit=f"{_LARGEST_PLAUSIBLE[name]:g} {_UNIT[name]}",
                                remedy="limits are in radians: divide degrees by 57.2958")


@dataclass(frozen=True)
class Boundary:
    """Attitude and motion at one end.

    Attributes:
        quaternion: ``inertial_from_body`` (4,), of unit length.
        rate: body axes (3,), rad/s.
        acceleration: body axes (3,), rad/s2.
        jerk: body axes (3,), rad/s3, or None where it is free. Used at the stop only.
    """

    quaternion: Array
    rate: Array = field(default_factory=lambda: np.zeros(3))
    acceleration: Array = field(default_factory=lambda: np.zeros(3))
    jerk: Array | None = None


@dataclass(frozen=True)
class KeepOut:
    """A cone in which an axis of the body must not point: the telescope and the Sun.

    Attributes:
        name: for messages.
        axis: unit vector in body axes (3,).
        direction: unit vector in the inertial frame (3,), the centre of the cone.
        angle: half angle of the cone, rad.
    """

    name: str
    axis: Array
    direction: Array
    angle: float


@dataclass(frozen=True)
class Actuators:
    """What the actuators can give, in place of, or besides, the isotropic limits.

    The body turns with ``M = J eps + w x (J w + H)``, where H is the momentum in the actuators; the total
    ``G = J w + H`` is constant in the inertial frame.

    Attributes:
        inertia: J in body axes (3, 3), kg m2.
        torque: largest torque: one number for a sphere, three for a box in body axes, N m; None for no limit.
        momentum: largest momentum of the actuators, as ``torque``, N m s; None for no limit.
        gyro_momentum: momentum of one gyro of a cluster of two scissored pairs with the common axis along body x
            (``|y| <= 2, |z| <= 2, |x| <= sqrt(4 - y^2) + sqrt(4 - z^2)`` in its units), N m s; None for another
            cluster.
        total_momentum: G in the inertial frame (3,), N m s.
    """

    inertia: Array
    torque: Array | None = None
    momentum: Array | None = None
    gyro_momentum: float | None = None
    total_momentum: Array = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True)
class ExportNames:
    """What an attitude file must name and a slew does not know: epoch, frames, object."""

    epoch: str = "2000-01-01T12:00:00"
    time_system: str = "UTC"
    reference_frame: str = "EME2000"
    object_name: str = "SPACECRAFT"
    object_id: str = "2000-001A"
    step: float = 0.1


@dataclass(frozen=True)
class SlewRequest:
    """One slew from ``start`` to ``stop``; see the module for the file that it is read from."""

    limits: Limits
    start: Boundary
    stop: Boundary
    keep_out: tuple[KeepOut, ...] = ()
    actuators: Actuators | None = None
    objective: str = "time"
    duration: float | None = None
    solver: str = "ipopt"
    export: ExportNames = ExportNames()

    def __post_init__(self) -> None:
        _check_consistent(self)


def _vector(value: Any, where: str, *, length: int = 3) -> Array:
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise RequestError("not a list of numbers", where=where, value=value) from error
    if array.shape != (length,):
        raise ShapeError(f"a list of {length} numbers is wanted", where=where, value=f"shape {array.shape}")
    if not np.all(np.isfinite(array)):
        raise NotFiniteError("a component is not finite", where=where, value=value)
    return array


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise RequestError("not a number", where=where, value=value)
    if not math.isfinite(value):
        raise NotFiniteError("the number is not finite", where=where, value=value)
    return float(value)


def _unit_vector(value: Any, where: str) -> Array:
    vector = _vector(value, where)
    length = float(np.linalg.norm(vector))
    if length < 1e-9:
        raise RequestError("a direction of length zero", where=where, value=value, remedy="give a unit vector")
    return vector / length


def _check_consistent(request: SlewRequest) -> None:
    limits = request.limits
    for name, end in (("start", request.start), ("stop", request.stop)):
        object.__setattr__(end, "quaternion", unit_quaternion(end.quaternion, where=f"{name}.quaternion"))
        for what in ("rate", "acceleration", "jerk"):
            value = getattr(end, what)
            if value is None:
                continue
            vector = _vector(value, f"{name}.{what}")
            object.__setattr__(end, what, vector)
            size, limit = float(np.linalg.norm(vector)), float(getattr(limits, what))
            if size > limit * (1 + 1e-9):
                remedy = f"lower the {what} or raise limits.{what}"
                if size > 5 * limit and size / 57.29577951308232 <= limit:
                    remedy += "; the value looks like degrees, radians are wanted"
                raise RequestError(f"the {what} at the {name} is above the limit", where=f"{name}.{what}",
                                   value=f"{size:.6g} {_UNIT[what]}", limit=f"{limit:.6g} {_UNIT[what]}",
                                   remedy=remedy)
    if request.start.jerk is not None:
        raise RequestError("the jerk at the start is free", where="start.jerk", remedy="give it at the stop only")
    if request.objective not in ("time", "smoothness"):
        raise RequestError("unknown objective", where="objective.kind", value=request.objective,
                           remedy='give "time" or "smoothness"')
    if request.objective == "smoothness" and request.duration is None:
        raise MissingDataError("the smoothest slew needs its duration", where="objective.duration",
                               remedy="give the duration in seconds")
    if request.duration is not None and not request.duration > 0:
        raise RequestError("the duration must be positive", where="objective.duration", value=request.duration)
    if request.duration is not None and request.objective == "time":
        raise RequestError("a duration was given, and the objective is the shortest time", where="objective.duration",
                           remedy='leave it out or set kind = "smoothness"')
    if request.solver not in ("ipopt", "fatrop"):
        raise RequestError("unknown solver", where="solver.name", value=request.solver,
                           remedy='give "ipopt" or "fatrop"')
    if not all(math.isfinite(x) for x in (limits.rate, limits.acceleration)) and request.actuators is None:
        raise MissingDataError("a limit is missing", where="limits", remedy="give rate, acceleration and jerk, "
                               "or the [actuators] that limit them")
    if request.actuators is not None:
        _check_actuators(request.actuators, limits)
    names = [k.name for k in request.keep_out]
    if len(set(names)) < len(names):
        raise RequestError("two keep-out cones have the same name", where="keep_out", value=names)
    for cone in request.keep_out:
        if not 0 < cone.angle < math.pi:
            raise RequestError("the half angle of the cone is not between 0 and pi", where=f"keep_out.{cone.name}",
                               value=f"{cone.angle:g} rad", remedy="angles are in radians")
    if not 1e-3 <= request.export.step <= 3600:
        raise RequestError("the step of the exported file is out of range", where="export.step",
                           value=f"{request.export.step:g} s", limit="0.001 to 3600 s")


def _check_actuators(actuators: Actuators, limits: Limits) -> None:
    inertia = np.asarray(actuators.inertia, dtype=float)
    if inertia.shape != (3, 3) or not np.all(np.isfinite(inertia)):
        raise ShapeError("the inertia is a 3 x 3 matrix of finite numbers", where="actuators.inertia",
                         value=f"shape {inertia.shape}")
    if not np.allclose(inertia, inertia.T, rtol=1e-9):
        raise RequestError("the inertia is not symmetric", where="actuators.inertia")
    moments = np.linalg.eigvalsh(inertia)
    if moments[0] <= 0 or moments[2] > (moments[0] + moments[1]) * (1 + 1e-9):
        raise RequestError("the inertia is that of no body (positive moments, none above the sum of the others)",
                           where="actuators.inertia", value=moments.tolist())
    for name in ("torque", "momentum"):
        value = getattr(actuators, name)
        if value is not None and not np.all(np.asarray(value) > 0):
            raise RequestError("must be positive", where=f"actuators.{name}", value=value)
    if actuators.gyro_momentum is not None:
        if not actuators.gyro_momentum > 0:
            raise RequestError("must be positive", where="actuators.gyro_momentum", value=actuators.gyro_momentum)
        if actuators.momentum is not None:
            raise RequestError("give either momentum or gyro_momentum", where="actuators")
    momentum_limited = actuators.momentum is not None or actuators.gyro_momentum is not None
    if math.isinf(limits.rate) and not momentum_limited:
        raise MissingDataError("nothing limits the rate", where="limits.rate",
                               remedy="give limits.rate, actuators.momentum or actuators.gyro_momentum")
    if math.isinf(limits.acceleration) and actuators.torque is None:
        raise MissingDataError("nothing limits the acceleration", where="limits.acceleration",
                               remedy="give limits.acceleration or actuators.torque")


_KEYS: dict[str, tuple[str, ...]] = {
    "limits": ("rate", "acceleration", "jerk"),
    "start": ("quaternion", "rate", "acceleration"),
    "stop": ("quaternion", "rate", "acceleration", "jerk"),
    "actuators": ("inertia", "torque", "momentum", "gyro_momentum", "total_momentum"),
    "objective": ("kind", "duration"),
    "solver": ("name",),
    "export": ("epoch", "time_system", "reference_frame", "object_name", "object_id", "step"),
}
_CONE_KEYS = ("name", "axis", "direction", "angle")


def _known_keys(table: Mapping[str, Any], allowed: tuple[str, ...], where: str) -> None:
    for key in table:
        if key not in allowed:
            raise RequestError(f"unknown key {key!r}", where=where,
                               remedy="known keys are " + ", ".join(allowed) + " (SI and radians)")


def _table(document: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    if name not in document:
        raise MissingDataError(f"the table [{name}] is missing", where="slew request",
                               remedy=f"add [{name}] with " + ", ".join(_KEYS[name]))
    table = document[name]
    if not isinstance(table, Mapping):
        raise RequestError(f"[{name}] must be a table", where="slew request", value=type(table).__name__)
    _known_keys(table, _KEYS[name], name)
    return table


def _boundary(document: Mapping[str, Any], name: str) -> Boundary:
    table = _table(document, name)
    if "quaternion" not in table:
        raise MissingDataError("the attitude is missing", where=f"{name}.quaternion",
                               remedy="give (w, x, y, z), inertial_from_body")
    return Boundary(
        unit_quaternion(_quaternion_array(table["quaternion"], f"{name}.quaternion"), where=f"{name}.quaternion"),
        _vector(table.get("rate", [0, 0, 0]), f"{name}.rate"),
        _vector(table.get("acceleration", [0, 0, 0]), f"{name}.acceleration"),
        _vector(table["jerk"], f"{name}.jerk") if "jerk" in table else None,
    )


def _quaternion_array(value: Any, where: str) -> Array:
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise RequestError("not a list of four numbers", where=where, value=value) from error


def _actuators(table: Mapping[str, Any]) -> Actuators:
    if "inertia" not in table:
        raise MissingDataError("the inertia is missing", where="actuators.inertia", remedy="give 3 or 3 x 3 numbers")
    try:
        inertia = np.asarray(table["inertia"], dtype=float)
    except (TypeError, ValueError) as error:
        raise RequestError("not numbers", where="actuators.inertia", value=table["inertia"]) from error
    if inertia.shape == (3,):
        inertia = np.diag(inertia)

    def sphere_or_box(name: str) -> Array | None:
        if name not in table:
            return None
        value = table[name]
        if isinstance(value, list):
            return _vector(value, f"actuators.{name}")
        return np.array([_number(value, f"actuators.{name}")])

    return Actuators(
        inertia, sphere_or_box("torque"), sphere_or_box("momentum"),
        _number(table["gyro_momentum"], "actuators.gyro_momentum") if "gyro_momentum" in table else None,
        _vector(table.get("total_momentum", [0, 0, 0]), "actuators.total_momentum"),
    )


def slew_request_from(document: Mapping[str, Any]) -> SlewRequest:
    """The request in a parsed TOML document.

    Raises:
        MissingDataError, RequestError, ShapeError, NotFiniteError, QuaternionError, UnitError: what cannot be used,
            where it stands, and what to do.
    """
    _known_keys(document, (*_KEYS, "keep_out"), "slew request")
    limits_table = _table(document, "limits")
    has_actuators = "actuators" in document
    values = {}
    for name in _KEYS["limits"]:
        if name in limits_table:
            values[name] = _number(limits_table[name], f"limits.{name}")
        elif has_actuators and name != "jerk":
            values[name] = math.inf
        else:
            raise MissingDataError("the limit is missing", where=f"limits.{name}", remedy=f"give it in {_UNIT[name]}")
    cones = []
    listed = document.get("keep_out", [])
    if not isinstance(listed, list):
        raise RequestError("keep_out must be an array of tables", where="keep_out", remedy="write [[keep_out]]")
    for i, cone in enumerate(listed):
        where = f"keep_out[{i}]"
        _known_keys(cone, _CONE_KEYS, where)
        for key in _CONE_KEYS[1:]:
            if key not in cone:
                raise MissingDataError(f"{key} is missing", where=where)
        cones.append(KeepOut(str(cone.get("name", f"cone {i + 1}")), _unit_vector(cone["axis"], f"{where}.axis"),
                             _unit_vector(cone["direction"], f"{where}.direction"),
                             _number(cone["angle"], f"{where}.angle")))
    objective = _table(document, "objective") if "objective" in document else {}
    solver = _table(document, "solver") if "solver" in document else {}
    return SlewRequest(
        Limits(**values), _boundary(document, "start"), _boundary(document, "stop"), tuple(cones),
        _actuators(_table(document, "actuators")) if has_actuators else None,
        str(objective.get("kind", "time")),
        _number(objective["duration"], "objective.duration") if "duration" in objective else None,
        str(solver.get("name", "ipopt")),
        _export_names(_table(document, "export")) if "export" in document else ExportNames(),
    )


_EPOCH = re.compile(r"\d{4}-\d{2}-\d{2}T\d{2}:\d{2}:\d{2}(\.\d+)?Z?")


def _export_names(table: Mapping[str, Any]) -> ExportNames:
    values: dict[str, Any] = {k: str(v) for k, v in table.items() if k != "step"}
    if "step" in table:
        values["step"] = _number(table["step"], "export.step")
    if "epoch" in table:
        moment = table["epoch"]
        text = moment.isoformat().removesuffix("+00:00") if hasattr(moment, "isoformat") else str(moment)
        if not _EPOCH.fullmatch(text):
            raise RequestError("the epoch is not a date and time", where="export.epoch", value=text,
                               remedy="write it as 2025-06-21T08:30:00")
        values["epoch"] = text.removesuffix("Z")
    return ExportNames(**values)


def read_slew_request(path: str | os.PathLike[str]) -> SlewRequest:
    """Read a request from a TOML file.

    Raises:
        FileFormatError: the file is not there or is not TOML; and the errors of :func:`slew_request_from`.
    """
    file = Path(path)
    try:
        document = tomllib.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise FileFormatError("there is no such file", where=str(file)) from error
    except OSError as error:
        raise FileFormatError(f"the file cannot be read ({error.strerror})", where=str(file)) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise FileFormatError(f"the file is not TOML ({error})", where=str(file)) from error
    return slew_request_from(document)
