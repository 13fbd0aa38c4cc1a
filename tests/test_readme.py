"""The first screen keeps its word: the README's example prints what it says, its commands are those of the project."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
import subprocess
import tomllib
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(text: str, language: str) -> list[str]:
    """The fenced blocks of one language."""
    return re.findall(rf"^```{language}\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)


def tracked() -> list[Path]:
    """Files of the repository; without git, everything but what is made by running it."""
    try:
        listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout.decode()
        found = [ROOT / name for name in listed.split("\0") if name]
    except (OSError, subprocess.CalledProcessError):
        made = {".git", ".venv", ".venv-test", "__pycache__", "build", "dist", ".pytest_cache", ".mypy_cache",
                ".ruff_cache", ".hypothesis", "demo"}
        found = [p for p in ROOT.rglob("*") if not made & set(p.relative_to(ROOT).parts) and ".egg-info" not in str(p)]
    return [p for p in found if p.is_file()]


def test_the_example_prints_the_numbers_that_stand_below_it() -> None:
    (block,) = blocks(README, "python")
    lines = [line for line in block.splitlines() if line and not line.startswith("#")]
    assert len(lines) <= 12
    (said,) = re.findall(r"^# (.*)", block, flags=re.MULTILINE)
    printed, names = io.StringIO(), {"__name__": "readme"}
    with contextlib.redirect_stdout(printed):
        exec(compile(block, "README.md", "exec"), names)
    number = r"[+-]?\d+\.\d+"
    found, expected = (np.array([float(x) for x in re.findall(number, t)]) for t in (printed.getvalue(), said))
    assert found.shape == expected.shape == (6,)
    assert printed.getvalue().split()[0] == said.split()[0] == "ok"
    assert printed.getvalue().count("+-") == said.count("+-") == 3
    # Another linear algebra library may move the last digit of a number, not more.
    assert np.max(np.abs(found - expected)) < 1.5e-4

    # And the numbers are right: the truth lies within four sigmas of each.
    from scipy.spatial.transform import Rotation

    campaign, truth = names["campaign"], names["truth"]
    true, design = (Rotation.from_quat(q, scalar_first=True)
                    for q in (truth.antenna_from_tracker, campaign.nominal.antenna_from_tracker))  # type: ignore[attr-defined]
    error = found[0::2] - (true * design.inv()).as_rotvec(degrees=True)
    assert np.all(np.abs(error) < 4 * np.asarray(names["sigma"]) + 1e-4)


@pytest.mark.parametrize("page", sorted((ROOT / "docs").glob("*.md")), ids=lambda p: p.name)
def test_python_on_the_pages_runs(page: Path) -> None:
    """All blocks of a page that states conventions run one after the other; others must at least be Python."""
    text = page.read_text(encoding="utf-8")
    names: dict[str, object] = {"__name__": "page"}
    for block in blocks(text, "python"):
        code = compile(block, page.name, "exec")
        if page.name == "conventions.md":
            exec(code, names)
    if page.name == "conventions.md":
        assert sum(block.count("assert ") for block in blocks(text, "python")) >= 12


def test_the_readme_has_one_command_to_run_and_one_to_test() -> None:
    demo, test = (block.strip() for block in blocks(README, "sh"))
    assert "\n" not in demo and "\n" not in test
    assert demo.endswith("boresight demo")
    assert "pytest" in test
    for command in (demo, test):
        make, install, run = (shlex.split(part) for part in command.split(" && "))
        assert make[:3] == ["python3", "-m", "venv"]
        environment = make[-1]
        assert install[:3] == ["python3", "-m", "pip"] and environment in install and "-q" in install
        assert run[0].startswith(f"{environment}/bin/")
    assert demo.split()[4] != test.split()[4], "the two commands need environments of their own"


def test_continuous_integration_runs_the_test_command() -> None:
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    commands = [line for line in script.splitlines() if line and not line.startswith(("#", "set ", "cd "))]
    assert commands == [blocks(README, "sh")[1].strip()]
    assert (ROOT / ".ci" / "run").stat().st_mode & 0o111


def test_the_commands_are_those_of_the_project() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert project["project"]["scripts"]["boresight"] == "problems.cli:main"
    assert project["project"]["requires-python"] == ">=3.11"
    assert "test" in project["project"]["optional-dependencies"]
    needed = {re.split(r"[<>=\[]", name)[0] for name in project["project"]["optional-dependencies"]["test"]}
    assert {"pytest", "pytest-xdist", "ruff", "mypy", "hypothesis"} <= needed
    assert project["tool"]["pytest"]["ini_options"]["filterwarnings"][0] == "error"


def test_every_command_that_a_page_names_exists() -> None:
    from problems.cli import COMMANDS

    pages = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), ROOT / "examples" / "README.md"]
    named = {m for page in pages for m in re.findall(r"(?:`|^ *)boresight ([a-z]+)(?: ([a-z0-9]+))?",
                                                     page.read_text(encoding="utf-8"), flags=re.MULTILINE)}
    commands = {first for first, _ in named}
    assert {"solve", "demo", "simulate"} <= commands
    for first, second in named:
        if first not in COMMANDS:
            pytest.fail(f"no command is named {first!r}")
        group = COMMANDS[first]
        assert not isinstance(group, dict) or second in group, f"boresight {first} {second}"


def test_links_lead_somewhere() -> None:
    broken = []
    for page in [p for p in tracked() if p.suffix == ".md"]:
        for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
            if "://" in target or target.startswith("#"):
                continue
            if not (page.parent / target.split("#")[0]).exists():
                broken.append(f"{page.relative_to(ROOT)}: {target}")
    assert not broken, "\n".join(broken)


def test_no_address_of_a_registry_and_no_path_of_a_machine() -> None:
    """Installing must follow the user's own settings, and nothing may depend on where it was written."""
    forbidden = {
        "a package registry": re.compile("|".join((
            "py" + r"pi\.org", "python" + r"hosted\.org", r"--(extra-)?index" + "-url", "conda" + r"\.anaconda",
            "artifact" + "ory"))),
        "a path of a machine": re.compile(
            r"(?<![\w.~-])/(?:" + "|".join(("home", "root", "Users", "work", "mnt")) + r")/[\w.-]+"),
    }
    found = []
    for path in tracked():
        try:
            text = path.read_text(encoding="utf-8")
        except UnicodeDecodeError:
            continue
        for what, pattern in forbidden.items():
            found += [f"{path.relative_to(ROOT)}: {what}: {m.group(0)}" for m in pattern.finditer(text)]
    assert not found, "\n".join(found[:20])
