"""The command ``boresight simulate``: a campaign file with known truth, and the truth in a JSON file beside it."""

from __future__ import annotations

import ast
import json
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from estimator.models.errors import RequestError
from estimator.models.files import written_atomically
from problems.console import jsonable, run


def simulate(
    out: Annotated[Path, typer.Argument(help="Campaign file to write; the truth goes to OUT.truth.json beside it.")],
    seed: Annotated[int, typer.Option(help="Seed of the random numbers; the same seed gives the same campaign.")] = 0,
    effects: Annotated[str, typer.Option(
        help="True effects, name=value or name=value:value:value, separated by commas; SI units, values in the order "
             "of the effect's parameters. A name alone takes the values that physics demands. Example: "
             "gravity-gradient-torque,residual-magnetic-dipole=0.4:-0.3:0.6,beam-mispointing:1=7e-5:-5e-5",
    )] = "",
    effects_file: Annotated[list[Path] | None, typer.Option(
        help="Python file or directory with effects of your own; may be repeated.",
    )] = None,
    preset: Annotated[str, typer.Option(
        help="reference (6 h), compact (about 1 h), full (2 days at 0.2 s), base, good, bad-short, small-slews, "
             "no-slews, slow, near-axisymmetric, single-pulse, no-torque, no-free-rotation, no-rotation.",
    )] = "reference",
    duration: Annotated[float | None, typer.Option(help="Length of the campaign in s.")] = None,
    gnss_step: Annotated[float | None, typer.Option(help="Time between positions in s.")] = None,
    outliers: Annotated[float | None, typer.Option(help="Fraction of gross errors in each channel.")] = None,
    change: Annotated[list[str] | None, typer.Option(
        "--set", help="Any other number of the scenario, name=value; may be repeated. Example: --set doppler_noise=5",
    )] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Machine-readable answer on standard output.")] = False,
) -> None:
    """Make an alignment campaign with known truth, from equations of its own."""
    run(lambda: _simulate(out, seed, effects, effects_file or [], preset, duration, gnss_step, outliers, change or []),
        as_json=as_json)


def truth_path(out: Path) -> Path:
    """Where the truth of the campaign file ``out`` stands: ``OUT.truth.json`` for ``OUT.nc``."""
    return out.with_suffix(".truth.json")


def _simulate(out: Path, seed: int, effects: str, effects_files: list[Path], preset_name: str,
              duration: float | None, gnss_step: float | None, outliers: float | None,
              change: list[str]) -> tuple[dict[str, Any], Any]:
    from estimator.effects.library import load
    from problems.alignment.simulator import parse_effects, preset
    from problems.alignment.simulator import simulate as simulated
    from problems.readers.campaign_file import write_campaign

    begin = time.perf_counter()
    changes: dict[str, Any] = dict(_assignment(text) for text in change)
    if duration is not None:
        changes["duration"] = duration
    if gnss_step is not None:
        changes["gnss_step"] = gnss_step
    if outliers is not None:
        for channel in ("gnss", "star_tracker", "doppler"):
            changes[f"{channel}_outlier_fraction"] = outliers
    load(effects_files)
    campaign, truth = simulated(preset(preset_name, **changes), seed, parse_effects(effects))
    write_campaign(campaign, out)
    beside = truth_path(out)
    with written_atomically(beside) as temporary:
        temporary.write_text(json.dumps(jsonable(truth.to_json()), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    doppler = 0 if campaign.doppler is None else campaign.doppler.frequency_shift.size
    result = {
        "status": "ok",
        "why": "the campaign and its truth are written",
        "campaign": str(out),
        "truth": str(beside),
        "preset": preset_name,
        "seed": seed,
        "effects": truth.to_json()["effects"],
        "samples": {"gnss": len(campaign.gnss.time), "star_tracker": len(campaign.star_tracker.time),
                    "doppler": doppler},
        "arcs": len(campaign.arcs),
        "seconds": time.perf_counter() - begin,
    }

    def text() -> str:
        hidden = ", ".join(truth.effects) or "none"
        return (f"{out}: {len(campaign.gnss.time)} positions, {len(campaign.star_tracker.time)} attitudes, {doppler} "
                f"Doppler shifts, {len(campaign.arcs)} arcs; effects: {hidden}\n{beside}: what is true")

    return result, text


def _assignment(text: str) -> tuple[str, Any]:
    """``name=value`` as a pair, the value a Python number, tuple or None."""
    name, equals, value = text.partition("=")
    try:
        if not equals:
            raise ValueError(text)
        return name.strip().replace("-", "_"), ast.literal_eval(value.strip())
    except (ValueError, SyntaxError) as error:
        raise RequestError("the setting cannot be read", where="--set", value=text,
                           remedy="write name=value, for example doppler_noise=5 or pulse_axes=(0,2)") from error
