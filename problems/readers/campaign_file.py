"""The campaign file: one NetCDF-4 file with everything measured in one alignment campaign.

Layout (groups, variables, units) is that of the data format page: ``/gnss``, ``/star_tracker`` and ``/nominal`` always,
``/doppler``, ``/torque``, ``/arcs`` and ``/housekeeping`` where the campaign has them. Quaternions are scalar-first.
A ``units`` attribute that names another unit of the same quantity (``km``, ``deg``, ``kHz`` ...) is honoured and
converted; one that means another quantity is an error. Where no ``units`` stands, the format's unit is taken.

The accuracy is the attribute ``standard_deviation`` of a measured variable, or a variable
``<name>_standard_deviation`` where it varies from sample to sample. An attribute becomes an array that repeats one
value without using memory for it.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, cast

import h5py
import numpy as np

from estimator.models.errors import FileFormatError, InputError, MissingDataError, ShapeError, UnitError
from estimator.models.files import written_atomically
from problems.alignment.campaign import (
    Arc,
    ArcKind,
    Campaign,
    Covariate,
    DopplerSeries,
    GnssSeries,
    Nominal,
    TorqueCommands,
    TrackerSeries,
)
from problems.alignment.checks import checked

_DEGREE = math.pi / 180  # [rad]

_FACTORS: dict[str, dict[str, float]] = {
    "s": {
        "s": 1.0,
        "second": 1.0,
        "seconds": 1.0,
        "sec": 1.0,
        "ms": 1e-3,
        "us": 1e-6,
        "ns": 1e-9,
        "min": 60.0,
        "minutes": 60.0,
        "h": 3600.0,
        "hours": 3600.0,
        "d": 86400.0,
        "days": 86400.0,
    },
    "m": {"m": 1.0, "metre": 1.0, "metres": 1.0, "meter": 1.0, "meters": 1.0, "km": 1e3, "mm": 1e-3, "cm": 1e-2},
    "rad": {
        "rad": 1.0,
        "radian": 1.0,
        "radians": 1.0,
        "deg": _DEGREE,
        "degree": _DEGREE,
        "degrees": _DEGREE,
        "mrad": 1e-3,
        "urad": 1e-6,
        "arcsec": _DEGREE / 3600,
        "arcmin": _DEGREE / 60,
    },
    "rad/s": {"rad/s": 1.0, "rad s-1": 1.0, "deg/s": _DEGREE, "deg s-1": _DEGREE},
    "Hz": {"Hz": 1.0, "hertz": 1.0, "kHz": 1e3, "MHz": 1e6, "GHz": 1e9, "mHz": 1e-3},
    "N m": {"N m": 1.0, "Nm": 1.0, "N*m": 1.0, "N.m": 1.0, "mN m": 1e-3, "mNm": 1e-3},
    "kg m2": {"kg m2": 1.0, "kg m^2": 1.0, "kg*m2": 1.0, "kg*m^2": 1.0, "kg m**2": 1.0, "g m2": 1e-3, "kg cm2": 1e-4},
    "1": {"1": 1.0, "": 1.0, "dimensionless": 1.0},
}
"""What multiplies a value in the unit that a file states to give it in the unit of the format."""


def _factor(stated: str | None, unit: str, where: str) -> float:
    """The factor from the stated unit to ``unit``."""
    if stated is None:
        return 1.0
    factor = _FACTORS[unit].get(stated.strip())
    if factor is None:
        raise UnitError(
            "the units attribute does not name a unit of this quantity",
            where=where,
            value=repr(stated),
            limit=repr(unit),
            remedy=f"store the values in {unit} and say so",
        )
    return factor


def _instant(text: str) -> datetime:
    """A date and time in ISO 8601, UTC where it does not say."""
    instant = datetime.fromisoformat(text.strip().replace("Z", "+00:00"))
    return instant if instant.tzinfo is not None else instant.replace(tzinfo=UTC)


def _text(value: Any) -> str:
    """An attribute or string element as text, whether stored as bytes, as text or in an array of one."""
    if isinstance(value, np.ndarray):
        value = value.reshape(-1)[0] if value.size == 1 else b"".join(np.asarray(value, dtype="S").reshape(-1).tolist())
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace").rstrip("\0")
    return str(value)


class _Source:
    """One group of an open file, with errors that say where."""

    def __init__(self, group: h5py.Group, name: str):
        self.group, self.name = group, name

    def __contains__(self, variable: str) -> bool:
        return isinstance(self.group.get(variable), h5py.Dataset)

    def where(self, variable: str) -> str:
        return f"{self.name}/{variable}"

    def dataset(self, variable: str) -> h5py.Dataset:
        found = self.group.get(variable)
        if not isinstance(found, h5py.Dataset):
            raise MissingDataError(
                f"the variable {variable!r} is missing", where=self.name, remedy="write it as the campaign format says"
            )
        return found

    def attribute(self, variable: str, attribute: str) -> Any:
        return self.dataset(variable).attrs.get(attribute)

    def units(self, variable: str, attribute: str = "units") -> str | None:
        stated = self.attribute(variable, attribute)
        return None if stated is None else _text(stated)

    def numbers(self, variable: str, unit: str, shape: tuple[int | None, ...]) -> np.ndarray:
        """A numeric variable as float64 in ``unit``; fill values become NaN; None in ``shape`` is any length."""
        data = self.dataset(variable)
        where = self.where(variable)
        if data.dtype.kind not in "fiub":
            raise FileFormatError(
                "the variable does not hold real numbers",
                where=where,
                value=str(data.dtype),
                limit="floating point or integer",
            )
        values = np.empty(data.shape, dtype=np.float64)
        if data.shape is None or data.size == 0:
            values = np.empty(data.shape or (0,), dtype=np.float64)
        else:
            data.read_direct(values)
        for name in ("_FillValue", "missing_value"):
            fill = data.attrs.get(name)
            if fill is not None:
                number = float(np.asarray(fill).reshape(-1)[0])
                if math.isfinite(number):
                    values[values == number] = np.nan
        scale, offset = data.attrs.get("scale_factor"), data.attrs.get("add_offset")
        if scale is not None:
            values *= float(np.asarray(scale).reshape(-1)[0])
        if offset is not None:
            values += float(np.asarray(offset).reshape(-1)[0])
        factor = _factor(self._plain_units(variable), unit, where)
        if factor != 1.0:
            values *= factor
        _require_shape(values, shape, where)
        return values

    def _plain_units(self, variable: str) -> str | None:
        """The units attribute; "seconds since <date>" is accepted where the date is the epoch of the campaign."""
        stated = self.units(variable)
        if stated is None or " since " not in stated:
            return stated
        unit, _, origin = stated.partition(" since ")
        epoch = _text(self.group.file.attrs.get("epoch", ""))
        try:
            same = _instant(origin) == _instant(epoch)
        except ValueError:
            same = False
        if not same:
            raise UnitError(
                "the times count from another instant than the epoch of the campaign",
                where=self.where(variable),
                value=repr(stated),
                limit=f"since {epoch}",
                remedy="give times in seconds after the root attribute 'epoch'",
            )
        return unit

    def strings(self, variable: str) -> list[str]:
        data = self.dataset(variable)
        values = data[()]
        if data.dtype.kind == "S" and data.dtype.itemsize == 1 and data.ndim == 2:  # characters, one row a string
            return [b"".join(row.tolist()).decode("utf-8", "replace").strip().rstrip("\0") for row in values]
        if data.dtype.kind not in "SO" and h5py.check_string_dtype(data.dtype) is None:
            raise FileFormatError(
                "the variable does not hold strings", where=self.where(variable), value=str(data.dtype), limit="strings"
            )
        return [_text(v) for v in np.atleast_1d(values)]

    def require_frame(self, variable: str, frame: str) -> None:
        stated = self.attribute(variable, "frame")
        if stated is not None and _text(stated).strip() not in {frame, ""}:
            raise FileFormatError(
                "the frame attribute names another frame",
                where=self.where(variable),
                value=repr(_text(stated)),
                limit=repr(frame),
                remedy=f"transform the data to the {frame} frame",
            )

    def standard_deviation(self, variable: str, unit: str, shape: tuple[int, int]) -> np.ndarray:
        """Standard deviations of shape ``shape``, from the variable beside the data or from the attribute."""
        beside = f"{variable}_standard_deviation"
        if beside in self:
            return self.numbers(beside, unit, shape)
        stated = self.attribute(variable, "standard_deviation")
        where = f"{self.where(variable)}.standard_deviation"
        if stated is None:
            raise MissingDataError(
                "the accuracy of the measurement is missing",
                where=where,
                remedy=f"add the attribute in {unit}, or the variable {beside!r}",
            )
        try:
            values = np.asarray(stated, dtype=np.float64).reshape(-1)
        except (TypeError, ValueError) as error:
            raise FileFormatError("the attribute does not hold numbers", where=where, value=repr(stated)) from error
        if values.size not in (1, shape[1]):
            raise ShapeError(
                "the attribute has the wrong number of values", where=where, value=values.size, limit=f"1 or {shape[1]}"
            )
        units = self.units(variable, "standard_deviation_units")
        if units is None and unit not in {"rad"}:  # the accuracy is in the unit of the data it belongs to
            units = self.units(variable)
        values = values * _factor(units, unit, f"{where} (units)")
        return np.broadcast_to(values, shape)


def _require_shape(values: np.ndarray, shape: tuple[int | None, ...], where: str) -> None:
    """The number of dimensions and every fixed length agree."""
    fits = values.ndim == len(shape) and all(
        want is None or have == want for have, want in zip(values.shape, shape, strict=True)
    )
    if not fits:
        wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
        raise ShapeError(
            "the array has the wrong shape",
            where=where,
            value=values.shape,
            limit=wanted,
            remedy="the time dimension comes first, components last",
        )


def _number(attributes: Mapping[str, Any], name: str, unit: str) -> float:
    """A root attribute as a number."""
    if name not in attributes:
        raise MissingDataError(f"the root attribute {name!r} is missing", remedy=f"add it in {unit}")
    try:
        return float(np.asarray(attributes[name], dtype=np.float64).reshape(-1)[0])
    except (TypeError, ValueError, IndexError) as error:
        raise FileFormatError("the root attribute is not a number", where=name, value=repr(attributes[name])) from error


@contextmanager
def _opened(path: Path) -> Iterator[h5py.File]:
    """The file, open for reading; whatever the library cannot read becomes a typed error."""
    if not path.is_file():
        raise FileFormatError("there is no such file", where=str(path), remedy="check the path")
    try:
        with h5py.File(path, "r") as file:
            yield file
    except InputError:
        raise
    except (OSError, KeyError, RuntimeError, EOFError, TypeError, ValueError, MemoryError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise FileFormatError(
            f"the file is truncated, damaged or not NetCDF-4 ({reason})",
            where=str(path),
            value=f"{path.stat().st_size} bytes",
            remedy="copy or write it again; NetCDF-3 files must be converted to NetCDF-4",
        ) from error


def read_campaign(path: str | os.PathLike[str]) -> Campaign:
    """Read and check a campaign file.

    Args:
        path: the NetCDF-4 file.

    Returns:
        The campaign, in SI units, with quaternions of unit length and continuous sign; see
        :func:`problems.alignment.checks.checked` for what is accepted and what is refused.

    Raises:
        FileFormatError: no such file, truncated, damaged, or not NetCDF-4; a frame or type other than the format's.
        MissingDataError: a group, variable or attribute is not there.
        ShapeError: an array has the wrong shape.
        UnitError: a units attribute of another quantity, or a value implausible in its unit.
        InputError: the other subclasses, from the checks of the content.
    """
    path = Path(path)
    with _opened(path) as file:
        campaign = _campaign(file)
    return checked(campaign)


def _group(file: h5py.File, name: str, *, required: bool) -> _Source | None:
    found = file.get(name)
    if isinstance(found, h5py.Group):
        return _Source(found, name)
    if required:
        present = ", ".join(sorted(k for k, v in file.items() if isinstance(v, h5py.Group))) or "none"
        raise MissingDataError(
            f"the group {name!r} is missing (groups present: {present})",
            where=Path(file.filename).name,
            remedy="a campaign file needs the groups gnss, star_tracker and nominal",
        )
    return None


def _campaign(file: h5py.File) -> Campaign:
    attributes = dict(file.attrs)
    gnss = _read_gnss(cast(_Source, _group(file, "gnss", required=True)))
    star_tracker = _read_star_tracker(cast(_Source, _group(file, "star_tracker", required=True)))
    nominal = _read_nominal(cast(_Source, _group(file, "nominal", required=True)))
    doppler = _group(file, "doppler", required=False)
    torque = _group(file, "torque", required=False)
    arcs = _group(file, "arcs", required=doppler is not None or torque is not None)
    housekeeping = _group(file, "housekeeping", required=False)
    if "epoch" not in attributes:
        raise MissingDataError("the root attribute 'epoch' is missing", remedy="add the UTC epoch in ISO 8601")
    return Campaign(
        title=_text(attributes.get("title", "")),
        epoch=_text(attributes["epoch"]),
        earth_rotation_angle_at_epoch=_number(attributes, "earth_rotation_angle_at_epoch", "rad"),
        earth_rotation_rate=_number(attributes, "earth_rotation_rate", "rad/s"),
        gnss=gnss,
        star_tracker=star_tracker,
        doppler=None if doppler is None else _read_doppler(doppler),
        torque=None if torque is None else _read_torque(torque),
        arcs=() if arcs is None else _read_arcs(arcs),
        nominal=nominal,
        housekeeping={} if housekeeping is None else _read_housekeeping(housekeeping),
    )


def _read_gnss(source: _Source) -> GnssSeries:
    time = source.numbers("time", "s", (None,))
    source.require_frame("position", "earth_fixed")
    position = source.numbers("position", "m", (time.size, 3))
    return GnssSeries(time, position, source.standard_deviation("position", "m", (time.size, 3)))


def _read_star_tracker(source: _Source) -> TrackerSeries:
    time = source.numbers("time", "s", (None,))
    quaternion = _quaternions(source, "quaternion", time.size)
    return TrackerSeries(time, quaternion, source.standard_deviation("quaternion", "rad", (time.size, 3)))


def _quaternions(source: _Source, variable: str, rows: int | None) -> np.ndarray:
    """A quaternion variable; a last dimension named ``xyzw`` says that the scalar stands last, and is reordered."""
    shape = (4,) if rows is None else (rows, 4)
    values = source.numbers(variable, "1", shape)
    last = source.dataset(variable).dims[len(shape) - 1]
    names = [str(scale.name).rsplit("/", 1)[-1] for scale in last.values()]
    return np.ascontiguousarray(np.roll(values, 1, axis=-1)) if "xyzw" in names else values


def _read_doppler(source: _Source) -> DopplerSeries:
    time = source.numbers("time", "s", (None,))
    shift = source.numbers("frequency_shift", "Hz", (time.size, None))
    beams = shift.shape[1]
    source.require_frame("beam_direction", "antenna")
    varies = source.dataset("beam_direction").ndim == 3
    direction = source.numbers("beam_direction", "1", (time.size, beams, 3) if varies else (beams, 3))
    carrier = source.attribute("frequency_shift", "carrier_frequency")
    where = "doppler/frequency_shift.carrier_frequency"
    if carrier is None:
        raise MissingDataError("the carrier frequency is missing", where=where, remedy="add the attribute in Hz")
    try:
        frequency = float(np.asarray(carrier, dtype=np.float64).reshape(-1)[0])
    except (TypeError, ValueError, IndexError) as error:
        raise FileFormatError("the attribute is not a number", where=where, value=repr(carrier)) from error
    frequency *= _factor(source.units("frequency_shift", "carrier_frequency_units"), "Hz", where)
    return DopplerSeries(
        time, shift, source.standard_deviation("frequency_shift", "Hz", shift.shape), direction, frequency
    )


def _read_torque(source: _Source) -> TorqueCommands:
    start = source.numbers("start", "s", (None,))
    source.require_frame("command", "actuator")
    return TorqueCommands(
        start, source.numbers("stop", "s", (start.size,)), source.numbers("command", "N m", (start.size, 3))
    )


def _read_arcs(source: _Source) -> tuple[Arc, ...]:
    start = source.numbers("start", "s", (None,))
    stop = source.numbers("stop", "s", (start.size,))
    kinds = source.strings("kind")
    names = source.strings("name") if "name" in source else [f"arc-{i + 1}" for i in range(start.size)]
    for variable, values in (("kind", kinds), ("name", names)):
        if len(values) != start.size:
            raise ShapeError(
                "the array has the wrong shape", where=source.where(variable), value=len(values), limit=start.size
            )
    return tuple(
        Arc(name, cast(ArcKind, kind), float(a), float(b))
        for name, kind, a, b in zip(names, kinds, start, stop, strict=True)
    )


def _read_nominal(source: _Source) -> Nominal:
    source.require_frame("inertia", "tracker")
    return Nominal(
        _quaternions(source, "antenna_from_tracker", None),
        _quaternions(source, "actuator_from_tracker", None),
        source.numbers("inertia", "kg m2", (3, 3)),
    )


def _read_housekeeping(source: _Source) -> dict[str, Covariate]:
    series: dict[str, Covariate] = {}
    if "time" not in source:
        return series
    time = source.numbers("time", "s", (None,))
    for name, data in source.group.items():
        plain = isinstance(data, h5py.Dataset) and data.dtype.kind in "fiub" and data.shape == time.shape
        is_variable = plain and not _text(data.attrs.get("NAME", b"")).startswith("This is a netCDF dimension but not")
        if name == "time" or not is_variable:
            continue
        unit = source.units(name)
        bare = _Source(source.group, source.name)
        values = np.empty(data.shape, dtype=np.float64)
        if data.size:
            bare.dataset(name).read_direct(values)
        series[name] = Covariate(time, values, "1" if unit is None else unit)
    return series


def write_campaign(campaign: Campaign, path: str | os.PathLike[str]) -> None:
    """Write a campaign file; it appears whole under its name, or what stood there before stays.

    Reading it back gives ``checked(campaign)`` bit for bit. Large arrays are stored uncompressed: noise does not
    compress, and reading stays as fast as the disk.

    Args:
        campaign: what to write; it is not checked here.
        path: the file; an existing one is replaced.

    Raises:
        ShapeError: housekeeping series with different times (the format has one time per file for them).
        OSError: the disk refuses.
    """
    import h5netcdf

    with written_atomically(path) as temporary, h5netcdf.File(temporary, "w") as file:
        file.attrs["title"] = campaign.title
        file.attrs["epoch"] = campaign.epoch
        file.attrs["earth_rotation_angle_at_epoch"] = float(campaign.earth_rotation_angle_at_epoch)
        file.attrs["earth_rotation_rate"] = float(campaign.earth_rotation_rate)
        _write_series(file, campaign)
        _write_plan(file, campaign)


def _variable(group: Any, name: str, dimensions: tuple[str, ...], values: Any, **attributes: Any) -> None:
    """A variable with its dimensions (made where they are new), data and attributes."""
    if isinstance(values, list):
        data = np.asarray(values, dtype=object)
        kind: Any = h5py.string_dtype()
    else:
        data = np.ascontiguousarray(values, dtype=np.float64)
        kind = np.float64
    for dimension, length in zip(dimensions, data.shape, strict=True):
        if dimension not in group.dimensions:
            group.dimensions[dimension] = length
    variable = group.create_variable(name, dimensions, dtype=kind, data=data)
    for key, value in attributes.items():
        if value is not None:
            variable.attrs[key] = value


def _measured(
    group: Any,
    name: str,
    dimensions: tuple[str, ...],
    values: np.ndarray,
    deviation: np.ndarray,
    deviation_dimensions: tuple[str, ...],
    unit: str,
    deviation_unit: str,
    **attributes: Any,
) -> None:
    """A measured variable with its accuracy: an attribute where that is constant, a variable beside it where not."""
    constant = deviation.shape[0] > 0 and (deviation.strides[0] == 0 or bool(np.all(deviation == deviation[0])))
    row = np.array(deviation[0]) if constant else None
    if row is not None and name == "frequency_shift" and bool(np.all(row == row[0])):
        row = row[0]
    same = deviation_unit == unit
    _variable(
        group,
        name,
        dimensions,
        values,
        units=unit,
        standard_deviation=row,
        standard_deviation_units=None if same or row is None else deviation_unit,
        **attributes,
    )
    if row is None:
        _variable(group, f"{name}_standard_deviation", deviation_dimensions, deviation, units=deviation_unit)


def _write_series(file: Any, campaign: Campaign) -> None:
    time_attributes = {"units": "s", "long_name": "seconds since the epoch attribute"}
    group = file.create_group("gnss")
    gnss = campaign.gnss
    _variable(group, "time", ("time",), gnss.time, **time_attributes)
    _measured(
        group,
        "position",
        ("time", "xyz"),
        gnss.position,
        gnss.standard_deviation,
        ("time", "xyz"),
        "m",
        "m",
        frame="earth_fixed",
    )
    group = file.create_group("star_tracker")
    tracker = campaign.star_tracker
    _variable(group, "time", ("time",), tracker.time, **time_attributes)
    _measured(
        group,
        "quaternion",
        ("time", "wxyz"),
        tracker.quaternion,
        tracker.standard_deviation,
        ("time", "xyz"),
        "1",
        "rad",
        long_name="tracker_from_inertial, scalar first",
    )
    if campaign.doppler is not None:
        doppler = campaign.doppler
        group = file.create_group("doppler")
        _variable(group, "time", ("time",), doppler.time, **time_attributes)
        _measured(
            group,
            "frequency_shift",
            ("time", "beam"),
            doppler.frequency_shift,
            doppler.standard_deviation,
            ("time", "beam"),
            "Hz",
            "Hz",
            carrier_frequency=float(doppler.carrier_frequency),
        )
        dimensions = ("time", "beam", "xyz") if doppler.beam_direction.ndim == 3 else ("beam", "xyz")
        _variable(group, "beam_direction", dimensions, doppler.beam_direction, units="1", frame="antenna")
    if campaign.housekeeping:
        group = file.create_group("housekeeping")
        times = [c.time for c in campaign.housekeeping.values()]
        for name, covariate in campaign.housekeeping.items():
            if not np.array_equal(covariate.time, times[0]):
                raise ShapeError(
                    "the series has other times than the first one",
                    where=f"housekeeping/{name}",
                    remedy="interpolate all housekeeping to common times",
                )
        _variable(group, "time", ("time",), times[0], **time_attributes)
        for name, covariate in campaign.housekeeping.items():
            _variable(group, name, ("time",), covariate.values, units=covariate.unit)


def _write_plan(file: Any, campaign: Campaign) -> None:
    if campaign.torque is not None:
        group = file.create_group("torque")
        _variable(group, "start", ("segment",), campaign.torque.start, units="s")
        _variable(group, "stop", ("segment",), campaign.torque.stop, units="s")
        _variable(group, "command", ("segment", "xyz"), campaign.torque.command, units="N m", frame="actuator")
    group = file.create_group("arcs")
    _variable(group, "name", ("arc",), [arc.name for arc in campaign.arcs])
    _variable(group, "kind", ("arc",), [arc.kind for arc in campaign.arcs])
    _variable(group, "start", ("arc",), np.array([arc.start for arc in campaign.arcs]), units="s")
    _variable(group, "stop", ("arc",), np.array([arc.stop for arc in campaign.arcs]), units="s")
    group = file.create_group("nominal")
    nominal = campaign.nominal
    _variable(group, "antenna_from_tracker", ("wxyz",), nominal.antenna_from_tracker, units="1")
    _variable(group, "actuator_from_tracker", ("wxyz",), nominal.actuator_from_tracker, units="1")
    _variable(group, "inertia", ("row", "column"), nominal.inertia, units="kg m2", frame="tracker")
