"""What every command shares: JSON to standard output, words and progress to standard error, the exit status.

Exit status: 0 answered, 1 answered but not trustworthy (``status`` says why), 2 bad input.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from estimator.models.errors import BoresightError, InfeasibleError

words = Console(stderr=True, soft_wrap=True)
"""Where sentences, tables and progress go, so that standard output holds nothing but the JSON answer."""

EXIT_OF_STATUS = {"ok": 0, "quiet": 0, "named": 0, "ambiguous": 1, "unknown": 1, "bad_input": 2}


def progress() -> Progress:
    """A progress bar on standard error; it shows nothing where standard error is no terminal."""
    return Progress(SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
                    TimeElapsedColumn(), console=words, transient=True, disable=not words.is_terminal)


def jsonable(value: Any) -> Any:
    """``value`` with NumPy scalars and arrays as plain numbers and lists, and NaN or infinity as null."""
    if isinstance(value, dict):
        return {str(k): jsonable(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(v) for v in value]
    if isinstance(value, np.ndarray):
        return jsonable(value.tolist())
    if isinstance(value, np.bool_):
        return bool(value)
    if isinstance(value, np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value


def answer(result: dict[str, Any], *, as_json: bool, text: Callable[[], object]) -> None:
    """Print the answer, as one JSON object or as text, and leave with the exit status of its ``status``/``verdict``.

    Args:
        result: the machine-readable answer with a ``status`` or a ``verdict``.
        as_json: print JSON to standard output.
        text: called instead when no JSON is asked for; what it returns (a string or a rich renderable) is printed.
    """
    if as_json:
        typer.echo(json.dumps(jsonable(result), allow_nan=False))
    else:
        Console(file=sys.stdout, soft_wrap=True).print(text())  # standard output as it is now, redirected or not
    code = EXIT_OF_STATUS.get(str(result.get("status", result.get("verdict", "ok"))), 1)
    if code:
        raise typer.Exit(code)


def run(work: Callable[[], tuple[dict[str, Any], Callable[[], object]]], *, as_json: bool) -> None:
    """Do a command's work and print its answer; bad input and infeasible requests become an answer too.

    Args:
        work: returns the machine-readable result and a function that makes the text for a person.
        as_json: see :func:`answer`.
    """
    try:
        result, text = work()
    except InfeasibleError as error:
        why = str(error)
        answer({"status": "infeasible", "why": why}, as_json=as_json, text=lambda: escape(f"infeasible: {why}"))
        return
    except BoresightError as error:
        why = str(error)
        words.print(f"[red]bad input[/red]: {escape(why)}", highlight=False)
        answer({"status": "bad_input", "why": why}, as_json=as_json, text=lambda: "")
        return
    answer(result, as_json=as_json, text=text)
