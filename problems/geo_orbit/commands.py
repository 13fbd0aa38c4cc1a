"""``boresight orbit solve``, ``explain`` and ``simulate``: tracking data of one satellite to its orbit, and back."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from problems import console

app = typer.Typer(no_args_is_help=True, help="Orbit determination from ground tracking.")

Files = Annotated[
    list[Path],
    typer.Argument(
        help="tracking data (.aer, .gmd, CCSDS TDM), with settings (.toml, .in), initial orbit (CCSDS OEM, two-line "
        "elements) and IERS Bulletins B where wanted, in any order"
    ),
]
Settings = Annotated[Path | None, typer.Option("--settings", help="stations, forces, orbit: one TOML file")]
AsJson = Annotated[bool, typer.Option("--json", help="print the answer as JSON")]


@app.command("solve")
def solve_command(
    files: Files,
    settings: Settings = None,
    effects: Annotated[str, typer.Option(help="effects to estimate too, separated by commas")] = "",
    loss: Annotated[str, typer.Option(help="quadratic, huber, cauchy or barron")] = "quadratic",
    oem: Annotated[Path | None, typer.Option(help="write the orbit over the data's span as a CCSDS OEM")] = None,
    as_json: AsJson = False,
) -> None:
    """Estimate orbit, force parameters and biases of stations, all at once."""

    def work() -> tuple[dict[str, Any], Callable[[], object]]:
        from estimator.losses import LOSSES
        from estimator.models.errors import RequestError
        from estimator.solvers import Options
        from problems.geo_orbit.solution import solve_tracking
        from problems.readers.tracking_files import read_files

        if loss not in LOSSES:
            raise RequestError(f"no loss is named {loss!r}", where="--loss", remedy="choose from " + ", ".join(LOSSES))
        with console.progress() as bar:
            task = bar.add_task("reading", total=None)
            tracking, chosen = read_files(files, settings)
            bar.update(task, description="solving")
            solution = solve_tracking(
                tracking,
                chosen,
                effects=[e.strip() for e in effects.split(",") if e.strip()],
                loss=LOSSES[loss],
                options=Options(progress=lambda i, cost: bar.update(task, description=f"iteration {i}")),
            )
            if oem is not None:
                from problems.geo_orbit.ephemeris import ephemeris_of
                from problems.readers.tracking_ccsds import write_oem

                write_oem(oem, ephemeris_of(solution))
        return solution.as_dict(), lambda: str(solution)

    console.run(work, as_json=as_json)


@app.command("explain")
def explain_command(
    files: Files,
    settings: Settings = None,
    hold_out: Annotated[float, typer.Option(help="fraction of the data kept from the fits for the proof")] = 0.2,
    without: Annotated[str, typer.Option(help="effects to leave out of the library, separated by commas")] = "",
    as_json: AsJson = False,
) -> None:
    """Find what separates the measurements from the model of the orbit, name it, and prove that the gap shrank."""

    def work() -> tuple[dict[str, Any], Callable[[], object]]:
        from estimator.models.errors import RequestError
        from problems.geo_orbit.explanation import explained
        from problems.readers.tracking_files import read_files

        if not 0.05 <= hold_out <= 0.5:
            raise RequestError(
                "the held-out fraction makes no sense", where="--hold-out", value=hold_out, limit="0.05 to 0.5"
            )
        with console.progress() as bar:
            task = bar.add_task("reading", total=None)
            tracking, chosen = read_files(files, settings)
            found = explained(
                tracking,
                chosen,
                hold_out=hold_out,
                without=[n.strip() for n in without.split(",") if n.strip()],
                say=lambda text: bar.update(task, description=text, advance=1),
            )
        return found.as_dict(), lambda: str(found)

    console.run(work, as_json=as_json)


@app.command("simulate")
def simulate_command(
    settings: Annotated[Path, typer.Argument(help="stations, forces, epoch and orbit: one TOML file")],
    out: Annotated[Path, typer.Argument(help="CCSDS TDM to write")],
    hours: Annotated[float, typer.Option(help="length of the data, h")] = 24.0,
    step: Annotated[float, typer.Option(help="s between measurements of one kind at one station")] = 420.0,
    kinds: Annotated[str, typer.Option(help="range, range_rate, azimuth_elevation; separated by commas")]
    = "range,azimuth_elevation",
    effect: Annotated[
        list[str] | None, typer.Option(help="a hidden effect, name=value,value,...; may be repeated")
    ] = None,
    elevation: Annotated[float, typer.Option(help="lowest elevation, degrees")] = 8.0,
    seed: Annotated[int, typer.Option(help="of the noise; negative for none")] = 1,
    as_json: AsJson = False,
) -> None:
    """Write what the stations would measure of the settings' orbit, with noise and hidden effects."""

    def work() -> tuple[dict[str, Any], Callable[[], object]]:
        import numpy as np

        from estimator.models.errors import RequestError
        from problems.geo_orbit.settings import read_toml, settings_from
        from problems.geo_orbit.simulator import simulated_tracking
        from problems.readers.tracking_ccsds import write_tdm

        effects = {}
        for text in effect or []:
            name, _, numbers = text.partition("=")
            try:
                effects[name.strip()] = [float(n) for n in numbers.split(",")]
            except ValueError as error:
                raise RequestError("an effect is not readable", where="--effect", value=text,
                                   remedy="write name=value or name=value,value, for example range-bias=120") from error
        tables = read_toml(settings)
        # What a TDM means where the settings are silent.
        tables.setdefault("measurements", {}).setdefault("range", "sum")
        chosen = settings_from(tables, {})
        tracking = simulated_tracking(
            chosen,
            hours=hours,
            step=step,
            kinds=[k.strip() for k in kinds.split(",") if k.strip()],  # type: ignore[misc]
            effects=effects,
            seed=None if seed < 0 else seed,
            minimum_elevation=float(np.radians(elevation)),
        )
        write_tdm(out, tracking, time_tag=chosen.time_tag)
        answer = {"file": str(out), "observations": {f"{o.name}/{o.kind}": len(o.time) for o in tracking.observations},
                  "effects": effects}
        listed = "\n".join(f"  {name}: {count}" for name, count in answer["observations"].items())  # type: ignore[attr-defined]
        return answer, lambda: f"{out}\n{listed}"

    console.run(work, as_json=as_json)
