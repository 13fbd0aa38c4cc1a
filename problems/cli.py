"""The command line: each command lives with its problem and is loaded when it is asked for.

Usage errors are bad input like any other: exit status 2, the sentence on standard error, and with ``--json`` the
answer ``{"status": "bad_input", "why": ...}`` on standard output.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import sys
from collections.abc import Callable
from typing import Any

import typer
import typer.core
import typer.main

UsageError: type[Any] = typer.BadParameter.__bases__[0]
"""The class of all usage errors of the command-line library."""

COMMANDS: dict[str, str | dict[str, str]] = {
    "solve": "problems.alignment.commands_solve:solve",
    "explain": "problems.alignment.commands_explain:explain",
    "design": "problems.alignment.commands_design:design",
    "simulate": "problems.alignment.commands_simulate:simulate",
    "import": {"sentinel1": "problems.alignment.commands_import:import_sentinel1"},
    "slew": "problems.area_survey.commands_slew:slew",
    "survey": "problems.area_survey.commands_survey:survey",
    "orbit": {
        "solve": "problems.geo_orbit.commands:solve_command",
        "explain": "problems.geo_orbit.commands:explain_command",
        "simulate": "problems.geo_orbit.commands:simulate_command",
    },
    "stars": "problems.star_configuration.commands:stars",
    "demo": "problems.alignment.commands_demo:demo",
}
"""Where each command is, ``module:function``; a group of commands is a dictionary."""

GROUP_HELP = {
    "import": "Real measurements to a campaign file.",
    "orbit": "Geostationary orbit determination.",
}


def function_at(place: str) -> Callable[..., Any] | None:
    """The function at ``module:function``, or None where this installation has no such module or function."""
    module, name = place.split(":")
    try:
        if importlib.util.find_spec(module) is None:
            return None
    except ModuleNotFoundError:
        return None
    found: Callable[..., Any] | None = getattr(importlib.import_module(module), name, None)
    return found


def _built(name: str, place: str | dict[str, str]) -> Any:
    """The command of that name, or None where there is nothing at its place."""
    if isinstance(place, dict):
        return group(name, place, GROUP_HELP.get(name, "")) if any(map(function_at, place.values())) else None
    function = function_at(place)
    if function is None:
        return None
    alone = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    alone.command(name)(function)
    return typer.main.get_command(alone)


def group(name: str, commands: dict[str, Any], help_text: str) -> Any:
    """A group whose commands are imported when they are used or listed, so that one is not slowed by the others."""

    class OnDemand(typer.core.TyperGroup):
        def list_commands(self, ctx: Any) -> list[str]:
            return [c for c in commands if self._present(ctx, c)]

        def _present(self, ctx: Any, name: str) -> bool:
            try:
                return self.get_command(ctx, name) is not None
            except ImportError:  # said in full to whoever calls that command; the others stay listed
                return False

        def get_command(self, ctx: Any, cmd_name: str) -> Any:
            if cmd_name not in commands:
                return None
            if cmd_name not in self.commands:
                command = _built(cmd_name, commands[cmd_name])
                if command is None:
                    return None
                self.commands[cmd_name] = command
            return self.commands[cmd_name]

    empty = typer.Typer(name=name, cls=OnDemand, no_args_is_help=True, add_completion=False, help=help_text,
                        pretty_exceptions_enable=False)
    empty.callback()(lambda: None)
    return typer.main.get_group(empty)


def main(arguments: list[str] | None = None) -> None:
    """Entry point of the console script; leaves with the exit status of the command.

    Args:
        arguments: of the command line without the name of the program; default: those of the process.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    app = group("boresight", COMMANDS, "Alignment, guidance and model gaps of spacecraft, from flight data.")
    try:
        status = app(arguments, prog_name="boresight", standalone_mode=False)
    except UsageError as error:
        error.show()
        if "--json" in arguments:
            typer.echo(json.dumps({"status": "bad_input", "why": error.format_message()}))
        raise SystemExit(2) from None
    except (KeyboardInterrupt, typer.Abort):
        raise SystemExit(130) from None
    raise SystemExit(status if isinstance(status, int) else 0)
