"""``boresight orbit solve`` and ``boresight orbit explain``: tracking data of one satellite to its orbit."""

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
