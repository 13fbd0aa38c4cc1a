"""The Earth's gravity in spherical harmonics, as a pure CasADi function of the Earth-fixed position.

Source: the recursions of Cunningham (1970) as in Montenbruck and Gill, Satellite Orbits (2000), equations 3.29 to
3.33. The coefficients come from the package brahe (EGM2008, GGM05S, JGM3), or from an ICGEM ``.gfc`` file of the user.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import factorial, sqrt
from pathlib import Path

import casadi as ca
import numpy as np

from estimator.models.errors import FileFormatError, RequestError
from estimator.models.rotations import Matrix

CARRIED = ("EGM2008_120", "GGM05S", "JGM3")
"""Names of the fields that the package brahe carries."""


@dataclass(frozen=True, eq=False)
class GravityField:
    """Fully normalized Stokes coefficients.

    Attributes:
        name: of the model.
        gravitational_parameter: m3/s2 that belongs to the coefficients.
        radius: reference radius, m.
        cosine, sine: (degree + 1, degree + 1), row degree, column order, fully normalized.
    """

    name: str
    gravitational_parameter: float
    radius: float
    cosine: np.ndarray
    sine: np.ndarray

    @property
    def degree(self) -> int:
        return len(self.cosine) - 1

    def truncated(self, degree: int, order: int | None = None) -> GravityField:
        """The field without the terms above ``degree`` and ``order``.

        Raises:
            RequestError: the field has fewer terms than that.
        """
        order = degree if order is None else order
        if not 0 <= order <= degree <= self.degree:
            raise RequestError(
                "the gravity field has no such degree and order",
                where=self.name,
                value=f"{degree} x {order}",
                limit=f"{self.degree} x {self.degree}",
            )
        keep = np.arange(degree + 1) <= order
        return GravityField(
            self.name,
            self.gravitational_parameter,
            self.radius,
            self.cosine[: degree + 1, : degree + 1] * keep,
            self.sine[: degree + 1, : degree + 1] * keep,
        )


@cache
def gravity_field(name: str = "EGM2008_120", degree: int = 20) -> GravityField:
    """A gravity field that brahe carries (one of :data:`CARRIED`), or the ICGEM file at the path ``name``.

    Args:
        name: name of a carried field or path of a ``.gfc`` file.
        degree: highest degree and order that is read.

    Raises:
        RequestError: no such field, or it has fewer terms.
        FileFormatError: the file is not in the ICGEM format.
    """
    if name in CARRIED:
        import brahe

        model = brahe.GravityModel.from_model_type(getattr(brahe.GravityModelType, name))
        if degree > model.n_max:
            raise RequestError("the gravity field has no such degree", where=name, value=degree, limit=model.n_max)
        cosine, sine = np.zeros((degree + 1, degree + 1)), np.zeros((degree + 1, degree + 1))
        for n in range(degree + 1):
            for m in range(n + 1):
                cosine[n, m], sine[n, m] = model.get(n, m)
        return GravityField(name, float(model.gm), float(model.radius), cosine, sine)
    if not Path(name).exists():
        raise RequestError(
            "no such gravity field",
            where=name,
            remedy="choose from " + ", ".join(CARRIED) + ", or give the path of an ICGEM .gfc file",
        )
    return _read_icgem(Path(name), degree)


def _read_icgem(path: Path, degree: int) -> GravityField:
    header: dict[str, str] = {}
    cosine, sine = np.zeros((degree + 1, degree + 1)), np.zeros((degree + 1, degree + 1))
    cosine[0, 0] = 1.0
    highest = 0
    for number, line in enumerate(path.read_text(errors="replace").splitlines(), 1):
        words = line.replace("D", "e").replace("d", "e").split() if line[:3] in ("gfc", "gfct") else line.split()
        if len(words) >= 2 and not line.startswith("gfc"):
            header.setdefault(words[0], words[1])
        if words and words[0] in ("gfc", "gfct") and len(words) >= 5:
            try:
                n, m = int(words[1]), int(words[2])
                highest = max(highest, n)
                if n <= degree:
                    cosine[n, m], sine[n, m] = float(words[3]), float(words[4])
            except (ValueError, IndexError) as error:
                raise FileFormatError(
                    "a coefficient line cannot be read", where=f"{path}:{number}", value=line.strip()[:60]
                ) from error
    try:
        parameter = float(header["earth_gravity_constant"].replace("D", "e").replace("d", "e"))
        radius = float(header["radius"].replace("D", "e").replace("d", "e"))
    except (KeyError, ValueError) as error:
        raise FileFormatError(
            "this is no ICGEM gravity field: earth_gravity_constant or radius is missing", where=str(path)
        ) from error
    if highest < degree:
        raise RequestError("the gravity field has no such degree", where=str(path), value=degree, limit=highest)
    return GravityField(path.name, parameter, radius, cosine, sine)


def _unnormalized(n: int, m: int) -> float:
    return sqrt((1 if m == 0 else 2) * (2 * n + 1) * factorial(n - m) / factorial(n + m))


Series = tuple[np.ndarray, np.ndarray]
"""Coefficients of V and W, the solid harmonics, by degree and order."""


def _along(series: Series, axis: int) -> Series:
    """Derivative of a series along an axis, times the reference radius: again a series, of one degree more.

    This is Montenbruck and Gill's equation 3.33 read as a map between coefficients, so that a component of the
    acceleration, or of its gradient, costs one multiplication per coefficient.
    """
    c, s = series
    degree = len(c) - 1
    cosine, sine = np.zeros((degree + 2, degree + 2)), np.zeros((degree + 2, degree + 2))
    for n in range(degree + 1):
        for m in range(n + 1):
            if c[n, m] == 0.0 and s[n, m] == 0.0:
                continue
            if axis == 2:
                cosine[n + 1, m] -= (n - m + 1) * c[n, m]
                sine[n + 1, m] -= (n - m + 1) * s[n, m]
            elif m == 0:
                (cosine if axis == 0 else sine)[n + 1, 1] -= c[n, m]
            else:
                ratio = (n - m + 2) * (n - m + 1)
                if axis == 0:
                    cosine[n + 1, m + 1] -= 0.5 * c[n, m]
                    sine[n + 1, m + 1] -= 0.5 * s[n, m]
                    cosine[n + 1, m - 1] += 0.5 * ratio * c[n, m]
                    sine[n + 1, m - 1] += 0.5 * ratio * s[n, m]
                else:
                    sine[n + 1, m + 1] -= 0.5 * c[n, m]
                    cosine[n + 1, m + 1] += 0.5 * s[n, m]
                    sine[n + 1, m - 1] -= 0.5 * ratio * c[n, m]
                    cosine[n + 1, m - 1] += 0.5 * ratio * s[n, m]
    return cosine, sine


def _solid_harmonics(position: Matrix, radius: float, degree: int) -> tuple[dict, dict]:
    """V and W of Montenbruck and Gill, equations 3.29 to 3.31, up to ``degree``."""
    x, y, z = position[0], position[1], position[2]
    squared = x * x + y * y + z * z
    rho = radius * radius / squared
    x0, y0, z0 = radius * x / squared, radius * y / squared, radius * z / squared
    v: dict[tuple[int, int], Matrix] = {(0, 0): radius / ca.sqrt(squared)}
    w: dict[tuple[int, int], Matrix] = {(0, 0): 0.0}
    for m in range(degree + 1):
        if m > 0:
            v[m, m] = (2 * m - 1) * (x0 * v[m - 1, m - 1] - y0 * w[m - 1, m - 1])
            w[m, m] = (2 * m - 1) * (x0 * w[m - 1, m - 1] + y0 * v[m - 1, m - 1])
        for n in range(m + 1, degree + 1):
            a, b = z0 * ((2 * n - 1) / (n - m)), rho * ((n + m - 1) / (n - m))
            for table in (v, w):
                table[n, m] = a * table[n - 1, m] - (b * table[n - 2, m] if n - 2 >= m else 0.0)
    return v, w


def _sum(series: Series, v: dict, w: dict) -> Matrix:
    total: Matrix = 0.0
    for (n, m), c in np.ndenumerate(series[0]):
        s = series[1][n, m]
        if c != 0.0:
            total += float(c) * v[n, m]
        if s != 0.0 and m > 0:
            total += float(s) * w[n, m]
    return total


def gravity(position: Matrix, field: GravityField, *, lowest_degree: int = 0) -> tuple[Matrix, Matrix]:
    """Acceleration (3) of the Earth's gravity in Earth-fixed axes, m/s2, and its gradient (3, 3), 1/s2.

    Args:
        position: (3) Earth-fixed, m.
        field: coefficients, all of whose terms from ``lowest_degree`` up are used.
        lowest_degree: 0 for the whole field, 2 for what it adds to the central term.
    """
    scale = np.array(
        [
            [_unnormalized(n, m) if m <= n and n >= lowest_degree else 0.0 for m in range(field.degree + 1)]
            for n in range(field.degree + 1)
        ]
    )
    potential = (field.cosine * scale, field.sine * scale)
    v, w = _solid_harmonics(position, field.radius, field.degree + 2)
    first = [_along(potential, axis) for axis in range(3)]
    size = field.gravitational_parameter / field.radius**2
    acceleration = size * ca.vertcat(*(_sum(f, v, w) for f in first))
    xx, xy, xz, yy, yz = (_sum(_along(first[a], b), v, w) for a, b in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2)))
    gradient = (
        size / field.radius * ca.vertcat(ca.horzcat(xx, xy, xz), ca.horzcat(xy, yy, yz), ca.horzcat(xz, yz, -xx - yy))
    )
    return acceleration, gradient
