"""The repository is clean for its own linter and type checker, with the settings of pyproject.toml."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def checked(*command: str) -> str:
    """What the tool says when it finds something, else nothing."""
    if importlib.util.find_spec(command[0]) is None:
        pytest.skip(f"{command[0]} is not installed; pip install -e '.[test]' brings it")
    answer = subprocess.run([sys.executable, "-m", *command], cwd=ROOT, capture_output=True, text=True, check=False)
    return "" if answer.returncode == 0 else answer.stdout[-6000:] + answer.stderr[-2000:]


def test_linter() -> None:
    found = checked("ruff", "check", "--quiet", "--no-cache", ".")
    assert not found, found


def test_types() -> None:
    found = checked("mypy", "--no-error-summary")
    assert not found, found


def test_the_linter_looks_at_what_it_should() -> None:
    """A file with an unused import would be found, here as anywhere in the packages."""
    if importlib.util.find_spec("ruff") is None:
        pytest.skip("ruff is not installed; pip install -e '.[test]' brings it")
    for folder in ("estimator", "guidance", "problems", "tests", "benchmarks"):
        answer = subprocess.run(
            [sys.executable, "-m", "ruff", "check", "--quiet", "--no-cache", "--stdin-filename", f"{folder}/x.py", "-"],
            cwd=ROOT, capture_output=True, text=True, input="import os\n", check=False)
        assert "F401" in answer.stdout, folder
