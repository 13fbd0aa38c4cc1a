"""``boresight slew REQUEST.toml``: one slew, the optimum and the closed forms side by side."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from problems import console

if TYPE_CHECKING:
    from guidance.slew import Slew


def slew(
    request: Annotated[Path, typer.Argument(help="TOML file with [limits], [start] and [stop], in radians.")],
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
    export: Annotated[list[Path] | None, typer.Option(
        "--export", help="Attitude file: .aem, .bc (SPICE), .a (STK), .csv or .nc; may be repeated.")] = None,
    aem_version: Annotated[int, typer.Option("--aem-version", help="Version of the AEM: 2, or 1 for old readers.")] = 2,
    solver: Annotated[str | None, typer.Option("--solver", help="ipopt or fatrop, in place of the request's.")] = None,
) -> None:
    """Find the quickest slew within the limits, with the closed-form laws and the lower bound beside it."""
    console.run(lambda: _work(request, export or [], aem_version, solver), as_json=as_json)


def _work(path: Path, exports: list[Path], aem_version: int, solver: str | None) \
        -> tuple[dict[str, Any], Callable[[], object]]:
    from dataclasses import replace

    from guidance.export.by_suffix import checked_suffix, write_attitude
    from guidance.export.series import sampling_times, series_of
    from guidance.slew import solve_slew
    from guidance.slew_optimum import prepare
    from guidance.slew_request import read_slew_request

    for target in exports:
        checked_suffix(target)
    wanted = read_slew_request(path)
    if solver is not None:
        wanted = replace(wanted, solver=solver)
    with console.progress() as bar:
        bar.add_task("making the solver (compiled once, then cached)", total=None)
        prepare()
    answer = solve_slew(wanted)
    result = answer.as_json()
    if exports and answer.optimum is not None:
        names = wanted.export
        times = sampling_times(answer.duration, names.step)
        series = series_of(times, answer.motion(times), epoch=names.epoch, time_system=names.time_system,
                           reference_frame=names.reference_frame, object_name=names.object_name,
                           object_id=names.object_id)
        written = [file for target in exports for file in write_attitude(
            target, series, version=aem_version, comment="slew, quaternion inertial_from_body")]
        result["exported"] = [str(file) for file in written]
        for file in written:
            console.words.print(f"wrote {file}", highlight=False)
    return result, lambda: _table(answer)


def _table(answer: Slew) -> object:
    """The answer for a person: durations side by side, and how near the limits it comes."""
    from rich.console import Group
    from rich.table import Table

    request = answer.request
    table = Table(title=f"slew: {answer.status}")
    for column in ("law", "duration, s", "over the optimum"):
        table.add_column(column, justify="left" if column == "law" else "right")

    def row(name: str, duration: float | None) -> None:
        over = "" if duration is None or math.isnan(answer.duration) else f"{duration / answer.duration - 1:+.2%}"
        table.add_row(name, "cannot meet the request" if duration is None else f"{duration:.4f}", over)

    row("lower bound", answer.lower_bound)
    if answer.optimum is not None:
        row("optimum", answer.duration)
    for name, law in answer.closed_forms.items():
        row(name, law.duration if law else None)
    parts: list[object] = [answer.why, table]
    v = answer.verification
    if v is not None:
        reached = Table(title=f"largest values, {v.samples} points")
        for column in ("quantity", "largest", "limit"):
            reached.add_column(column)
        limits = request.limits
        for name, value, limit, power in (("rate", v.rate, limits.rate, ""), ("acceleration", v.acceleration,
                                          limits.acceleration, "2"), ("jerk", v.jerk, limits.jerk, "3")):
            unit = f"deg/s{power}"
            reached.add_row(name, f"{math.degrees(value):.6f} {unit}", f"{math.degrees(limit):.6f} {unit}")
        parts += [reached, f"attitude at the stop within {math.degrees(v.terminal_error) * 3600:.1e} arcsec"]
    return Group(*parts)  # type: ignore[arg-type]
