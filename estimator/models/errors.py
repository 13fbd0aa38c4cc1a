"""The errors that bad input raises: what is wrong, where, the value against its limit, and what to do.

Every error of the product is a :class:`BoresightError`. Input that cannot be used raises a subclass of
:class:`InputError`; a request that no solution can meet raises :class:`InfeasibleError`. The command line turns
them into ``{"status": "bad_input" | "infeasible", "why": ...}`` and exit status 2 or 1.
"""

from __future__ import annotations


class BoresightError(Exception):
    """Base of all errors that Boresight raises on purpose."""


class InputError(BoresightError, ValueError):
    """Input that cannot be used.

    Args:
        what: what is wrong, one clause ("the quaternion is not of unit length").
        where: file, group, variable and index ("star_tracker/quaternion[17]").
        value: the offending value, with unit.
        limit: the limit that it breaks, with unit.
        remedy: what the user can do about it.
    """

    def __init__(self, what: str, *, where: str = "", value: object = None, limit: object = None, remedy: str = ""):
        self.what, self.where, self.value, self.limit, self.remedy = what, where, value, limit, remedy
        sentence = f"{where}: {what}" if where else what
        if value is not None and limit is not None:
            sentence += f" (found {value}, limit {limit})"
        elif value is not None:
            sentence += f" (found {value})"
        elif limit is not None:
            sentence += f" (limit {limit})"
        if remedy:
            sentence += f"; {remedy}"
        super().__init__(sentence)

    def __reduce__(self) -> tuple[object, ...]:
        return (_rebuild, (type(self), self.what, self.where, self.value, self.limit, self.remedy))


def _rebuild(kind: type[InputError], what: str, where: str, value: object, limit: object, remedy: str) -> InputError:
    """Make the error again in another process (exceptions with keyword arguments do not pickle by themselves)."""
    return kind(what, where=where, value=value, limit=limit, remedy=remedy)


class FileFormatError(InputError):
    """The file is missing, truncated, or of another format."""


class MissingDataError(InputError):
    """A group, variable or attribute that the task needs is not there."""


class ShapeError(InputError):
    """An array has the wrong number of dimensions or rows."""


class NotFiniteError(InputError):
    """A value is NaN or infinite."""


class TimeOrderError(InputError):
    """Times go backwards or repeat."""


class UnitError(InputError):
    """A value is implausible in its unit: kilometres for metres, degrees for radians, a swapped component order."""


class QuaternionError(InputError):
    """A quaternion is not of unit length."""


class TooFewDataError(InputError):
    """Fewer samples than unknowns, or fewer than the method needs."""


class ArcError(InputError):
    """Arcs overlap, are reversed, or leave the data."""


class GeometryError(InputError):
    """A geometry that determines nothing: coplanar beams, a station inside the Earth, a target never visible."""


class RequestError(InputError):
    """A request (file or argument) asks for something that has no meaning."""


class InfeasibleError(BoresightError):
    """A request that is meaningful and cannot be met: says which limit, and by how much."""

    def __init__(self, why: str, *, limit: str = "", excess: float | None = None):
        self.why, self.limit, self.excess = why, limit, excess
        super().__init__(why)
