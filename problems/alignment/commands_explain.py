"""``boresight explain``: where model and data disagree, which effect is missing, and the proof that it is that."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from problems import console


def explain(
    file: Annotated[Path, typer.Argument(help="Campaign file (NetCDF-4).")],
    hold_out: Annotated[float, typer.Option(help="Fraction of every arc kept from the fits for the proof.")] = 0.2,
    report: Annotated[Path | None, typer.Option(help="Write a report here, one self-contained HTML page.")] = None,
    effects_file: Annotated[list[Path] | None, typer.Option(
        help="Python file or directory with effects of your own; may be repeated.",
    )] = None,
    without: Annotated[str, typer.Option(help="Effects to leave out of the library, separated by commas.")] = "",
    as_json: Annotated[bool, typer.Option("--json", help="Machine-readable answer on standard output.")] = False,
) -> None:
    """Find the gap between model and data, name the missing effect, add it, and prove that the gap shrank."""

    def work() -> tuple[dict[str, Any], Callable[[], object]]:
        from estimator.models.errors import RequestError
        from problems.alignment.explain_answer import answer_of, text_of
        from problems.alignment.explanation import explained
        from problems.readers.campaign_file import read_campaign

        if not 0.05 <= hold_out <= 0.5:
            raise RequestError("the held-out fraction makes no sense", where="--hold-out", value=hold_out,
                               limit="0.05 to 0.5", remedy="0.2 keeps the last fifth of every arc for the proof")
        if report is not None and not report.resolve().parent.is_dir():
            raise RequestError("the folder of the report does not exist", where="--report", value=str(report),
                               remedy="make the folder first")
        with console.progress() as bar:
            task = bar.add_task("reading", total=None)
            campaign = read_campaign(file)
            explanation = explained(
                campaign, hold_out=hold_out, without=[n.strip() for n in without.split(",") if n.strip()],
                effects_places=[str(p) for p in effects_file or []],
                say=lambda text: bar.update(task, description=text, advance=1),
            )
            if report is not None:
                from problems.alignment.explain_report import write_report

                bar.update(task, description="report")
                write_report(explanation, report, source=file.name)
        return answer_of(explanation), lambda: text_of(explanation)

    console.run(work, as_json=as_json)
