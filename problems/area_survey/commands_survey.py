"""``boresight survey``: from an area request to scans, slews, an attitude file and pictures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from problems import console


def survey(
    request: Annotated[Path, typer.Argument(help="request (TOML)")],
    as_json: Annotated[bool, typer.Option("--json", help="print the answer as JSON")] = False,
    export: Annotated[Path | None, typer.Option(help="write the attitude (AEM), the orbit as OEM beside it")] = None,
    report: Annotated[Path | None, typer.Option(help="write a report with a globe (one HTML file)")] = None,
    plots: Annotated[Path | None, typer.Option(help="write the figures into this directory (PNG)")] = None,
    slews: Annotated[str, typer.Option(help="optimal or closed-form")] = "optimal",
) -> None:
    """Plan the scans of areas and routes and the slews between them; write attitude, orbit and pictures."""

    def work() -> tuple[dict[str, Any], Callable[[], object]]:
        import time

        from estimator.models.errors import RequestError
        from guidance.survey_plan import plan_survey
        from guidance.survey_request import read_survey_request

        if slews not in ("optimal", "closed-form"):
            raise RequestError(f"no kind of slew is named {slews!r}", where="--slews",
                               remedy="choose optimal or closed-form")
        started = time.perf_counter()
        asked = read_survey_request(request)
        with console.progress() as bar:
            task = bar.add_task("planning", total=None)
            plan = plan_survey(asked, optimal=slews == "optimal",
                               progress=lambda sentence: bar.update(task, description=sentence))
            answer = plan.answer()
            answer["seconds"] = time.perf_counter() - started
            if export is not None:
                from problems.area_survey.exports import save_attitude_and_orbit

                bar.update(task, description="writing attitude and orbit")
                answer["files"] = [str(p) for p in save_attitude_and_orbit(plan, export)]
            if plots is not None:
                from problems.area_survey.figures import save_figures

                bar.update(task, description="drawing")
                answer.setdefault("files", []).extend(str(p) for p in save_figures(plan, plots))
            if report is not None:
                from problems.area_survey.report import save_report

                bar.update(task, description="writing the report")
                save_report(plan, report)
                answer.setdefault("files", []).append(str(report))

        def text() -> object:
            from problems.area_survey import tables

            return tables.text(plan)

        return answer, text

    console.run(work, as_json=as_json)
