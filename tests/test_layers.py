"""The rooms of the code import each other in one direction only; read from the sources, without running them."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
OURS = ("estimator", "guidance", "problems", "benchmarks", "tests")

ALLOWED: dict[str, tuple[str, ...]] = {
    "estimator": ("estimator",),
    "estimator.models": ("estimator.models",),
    "estimator.effects": ("estimator.effects", "estimator.models", "estimator.unknowns", "estimator.residuals"),
    "guidance": ("guidance", "estimator.models"),
    "problems": ("problems", "estimator", "guidance"),
    "problems.readers": ("problems", "estimator.models"),
}
"""What a room (with everything in it) may import of ours. Every rule of a file's rooms holds, the widest included."""


def modules() -> dict[str, Path]:
    """Every module of the packages by its full name."""
    found = {}
    for package in ("estimator", "guidance", "problems"):
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


MODULES = modules()


def imported(source: str, module: str, is_package: bool, known: set[str]) -> set[str]:
    """Full names of our modules that a source imports anywhere, inside functions and under conditions included."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parts = module.split(".")
            base = parts[: len(parts) - node.level + is_package] if node.level else []
            name = ".".join([*base, *([node.module] if node.module else [])])
            # "from package import module" imports the module, not the package alone.
            found |= {f"{name}.{a.name}" if f"{name}.{a.name}" in known else name for a in node.names}
        elif (isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant)
              and isinstance(node.args[0].value, str)
              and getattr(node.func, "attr", getattr(node.func, "id", "")) in ("import_module", "__import__")):
            found.add(node.args[0].value)
    return {name for name in found if name.split(".")[0] in OURS}


def inside(name: str, rooms: tuple[str, ...]) -> bool:
    return any(name == room or name.startswith(room + ".") for room in rooms)


def breaches(module: str, names: set[str]) -> list[str]:
    """Sentences about every import of ``module`` that a rule forbids."""
    found = []
    for room, allowed in ALLOWED.items():
        if inside(module, (room,)):
            found += [f"{module} imports {n}; {room} may import {', '.join(allowed)}"
                      for n in sorted(names) if not inside(n, allowed)]
    if not inside(module, ("estimator.discrepancy", "problems")):
        found += [f"{module} imports {n}; only problems may" for n in sorted(names)
                  if inside(n, ("estimator.discrepancy",))]
    return found


def names_of(module: str) -> set[str]:
    path = MODULES[module]
    return imported(path.read_text(encoding="utf-8"), module, path.name == "__init__.py", set(MODULES))


def test_the_packages_are_there() -> None:
    assert {"estimator.problem", "estimator.models.rotations", "guidance.kinematics", "problems.cli"} <= set(MODULES)
    assert names_of("problems.alignment.solution") >= {"estimator.estimate", "problems.alignment.campaign"}


@pytest.mark.parametrize("room", ["estimator", "guidance", "problems"])
def test_every_import_goes_down(room: str) -> None:
    found = [line for module in MODULES if inside(module, (room,)) for line in breaches(module, names_of(module))]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("estimator.problem", "from problems.alignment import campaign"),
        ("estimator.models.radar", "from estimator.unknowns import Unknown"),
        ("estimator.models.radar", "def f():\n    import estimator.problem"),
        ("estimator.effects.lag", "from estimator.solvers import solve"),
        ("estimator.effects.lag", "from ..solvers import solve"),
        ("estimator.problem", "from estimator import discrepancy"),
        ("estimator.problem", "import importlib\nimportlib.import_module('estimator.discrepancy.gap')"),
        ("guidance.scan", "from estimator.estimate import Estimate"),
        ("guidance.scan", "from problems import console"),
        ("problems.cli", "from tests import helpers"),
        ("problems.cli", "import benchmarks.fourier_fit"),
    ],
)
def test_the_test_sees_every_kind_of_breach(module: str, source: str) -> None:
    known = {*MODULES, "estimator.discrepancy", "estimator.discrepancy.gap"}
    assert breaches(module, imported(source, module, False, known))


def test_no_module_needs_itself() -> None:
    """Imports at the top of modules form no circle."""
    above: dict[str, set[str]] = {}
    for module, path in MODULES.items():
        tree = ast.parse(path.read_text(encoding="utf-8"))
        top = ast.unparse(ast.Module([n for n in tree.body if isinstance(n, ast.Import | ast.ImportFrom)], []))
        names = imported(top, module, path.name == "__init__.py", set(MODULES))
        above[module] = {n for n in names if n in MODULES and n != module}
    finished: set[str] = set()

    def visit(module: str, way: tuple[str, ...]) -> None:
        assert module not in way, " -> ".join([*way[way.index(module):], module])
        if module not in finished:
            for name in sorted(above[module]):
                visit(name, (*way, module))
            finished.add(module)

    for module in MODULES:
        visit(module, ())
