"""``boresight solve``: one campaign, one joint estimate (or the closed form, to compare)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from problems import console


def solve(
    file: Annotated[Path, typer.Argument(help="campaign file (NetCDF-4)")],
    method: Annotated[str, typer.Option(help="joint, closed-form or closed-form-literal")] = "joint",
    solver: Annotated[str, typer.Option(help="gauss-newton or ipopt")] = "gauss-newton",
    effects: Annotated[str, typer.Option(help="effects to estimate too, separated by commas")] = "",
    loss: Annotated[str, typer.Option(help="quadratic, huber, cauchy or barron")] = "quadratic",
    degree: Annotated[int | None, typer.Option(help="degree of the Fourier trajectory; default: from the data")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="print the answer as JSON")] = False,
) -> None:
    """Estimate antenna, inertia and actuator alignment and the trajectory of one campaign, all at once."""

    def work() -> tuple[dict[str, Any], Callable[[], object]]:
        from estimator.losses import LOSSES
        from estimator.models.errors import RequestError
        from estimator.solvers import Options
        from problems.alignment.solution import solve_campaign
        from problems.readers.campaign_file import read_campaign

        if method not in ("joint", "closed-form", "closed-form-literal"):
            raise RequestError(f"no method is named {method!r}", where="--method",
                               remedy="choose joint, closed-form or closed-form-literal")
        if loss not in LOSSES:
            raise RequestError(f"no loss is named {loss!r}", where="--loss", remedy="choose from " + ", ".join(LOSSES))
        if solver not in ("gauss-newton", "ipopt"):
            raise RequestError(f"no solver is named {solver!r}", where="--solver",
                               remedy="choose gauss-newton or ipopt")
        if solver == "ipopt" and loss != "quadratic":
            raise RequestError("IPOPT checks the quadratic loss alone", where="--loss", remedy="leave --loss out")
        with console.progress() as bar:
            task = bar.add_task("reading", total=None)
            campaign = read_campaign(file)
            if method != "joint":
                from problems.alignment.closed_form import closed_form_answer

                bar.update(task, description="closed form")
                return closed_form_answer(campaign, literal=method == "closed-form-literal")
            bar.update(task, description="solving")
            solution = solve_campaign(
                campaign, solver=solver, loss=LOSSES[loss], degree=degree,  # type: ignore[arg-type]
                effects=[name.strip() for name in effects.split(",") if name.strip()],
                options=Options(progress=lambda i, cost: bar.update(task, description=f"iteration {i}")),
            )
        return solution.as_dict(), lambda: str(solution)

    console.run(work, as_json=as_json)
