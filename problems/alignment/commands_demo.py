"""``boresight demo``: the main job on a generated campaign with known truth, every method side by side."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from problems import console


def demo(
    out: Annotated[Path, typer.Option(help="directory for the campaign, the answer and the plots")] = Path("demo"),
    seed: Annotated[int, typer.Option(help="seed of the simulated campaign")] = 7,
    preset: Annotated[str, typer.Option(help="preset of the simulator")] = "reference",
    as_json: Annotated[bool, typer.Option("--json", help="print the answer as JSON")] = False,
) -> None:
    """Generate a campaign, solve it jointly and in closed form, print the errors and write plots."""

    def work() -> tuple[dict[str, Any], Callable[[], object]]:
        from problems.alignment.demonstration import demonstrate

        with console.progress() as bar:
            task = bar.add_task("demo", total=5)

            def say(what: str) -> None:
                bar.update(task, description=what, advance=1)

            result, table = demonstrate(out, seed=seed, preset_name=preset, say=say)
        return result, lambda: table

    console.run(work, as_json=as_json)
