"""One call for every attitude format: the ending of the name chooses."""

from __future__ import annotations

import os
from pathlib import Path

from estimator.models.errors import RequestError
from guidance.export.series import AttitudeSeries

SUFFIXES = (".aem", ".bc", ".a", ".csv", ".nc")


def checked_suffix(path: str | os.PathLike[str]) -> str:
    """The ending of ``path`` in lower case.

    Raises:
        RequestError: no format has this ending.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise RequestError("no format has this ending", where="export", value=suffix or str(path),
                           remedy="use one of " + ", ".join(SUFFIXES))
    return suffix


def write_attitude(path: str | os.PathLike[str], series: AttitudeSeries, *, version: int = 2,
                   comment: str = "") -> list[Path]:
    """Write ``series`` in the format of the name's ending: .aem, .bc (SPICE CK), .a (STK), .csv, .nc (NetCDF).

    Args:
        path: of the file.
        series: what to write.
        version: of the AEM.
        comment: one line for the AEM.

    Returns:
        The files written.

    Raises:
        RequestError: another ending.
    """
    target = Path(path)
    suffix = checked_suffix(target)
    if suffix == ".aem":
        from guidance.export.aem import write_aem

        write_aem(target, series, version=version, comment=comment)
    elif suffix == ".bc":
        from guidance.export.spice_ck import write_spice_ck

        return list(write_spice_ck(target, series).values())
    elif suffix == ".a":
        from guidance.export.stk import write_stk

        write_stk(target, series)
    elif suffix == ".csv":
        from guidance.export.tables import write_csv

        write_csv(target, series)
    else:
        from guidance.export.tables import write_netcdf

        write_netcdf(target, series)
    return [target]
