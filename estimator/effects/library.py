"""The whole library: the effects shipped here, those of installed packages, and those in a user's own files.

A user's effect is found in three ways, none of which touches this package:

- an installed package names a module, or an :class:`~estimator.effects.declaration.Effect`, under the entry point group
  ``boresight.effects``;
- the environment variable ``BORESIGHT_EFFECTS`` lists files or directories, separated as in ``PATH``;
- the caller lists files or directories (the command line's ``--effects-file``).

Every file of a directory that ends in ``.py`` and does not begin with ``_`` is one.
"""

from __future__ import annotations

import difflib
import importlib
import importlib.metadata
import importlib.util
import os
import pkgutil
import sys
from collections.abc import Iterable
from pathlib import Path

import estimator.effects
from estimator.effects import declaration
from estimator.effects.declaration import Effect, EffectInstance, Layout
from estimator.models.errors import RequestError

GROUP = "boresight.effects"
VARIABLE = "BORESIGHT_EFFECTS"
_MACHINERY = {"checks", "declaration", "documentation", "library"}
_loaded_files: set[Path] = set()
_loaded_entry_points: set[str] = set()


def shipped() -> dict[str, Effect]:
    """The effects of this package alone, by name, in alphabetical order; every file of it defines ``EFFECT``."""
    modules = [importlib.import_module(f"estimator.effects.{module.name}")
               for module in pkgutil.iter_modules(estimator.effects.__path__) if module.name not in _MACHINERY]
    return dict(sorted((module.EFFECT.name, module.EFFECT) for module in modules))


def _withdraw(before: set[str]) -> None:
    """Take back what a file registered before it failed."""
    for name in set(declaration.registry()) - before:
        del declaration._REGISTRY[name]


def _failed(what: str, where: str, error: BaseException) -> RequestError:
    return RequestError(f"{what} could not be loaded: {type(error).__name__}: {error}", where=where,
                        remedy="correct the file or take it out of the list of effects")


def _load_entry_points() -> None:
    for entry in importlib.metadata.entry_points(group=GROUP):
        if entry.value in _loaded_entry_points:
            continue
        before = set(declaration.registry())
        try:
            found = entry.load()
            if isinstance(found, Effect):
                declaration.register(found)
        except Exception as error:
            _withdraw(before)
            raise _failed(f"the effect {entry.name!r} of an installed package", entry.value, error) from error
        _loaded_entry_points.add(entry.value)


def effect_files(places: Iterable[str | os.PathLike[str]]) -> list[Path]:
    """The effect files in a list of files and directories, absolute, each once, in order.

    Raises:
        RequestError: a place does not exist, or is a file that is not Python.
    """
    files: list[Path] = []
    for place in places:
        path = Path(place).expanduser()
        if path.is_dir():
            files.extend(sorted(f.resolve() for f in path.glob("*.py") if not f.name.startswith("_")))
        elif path.is_file() and path.suffix == ".py":
            files.append(path.resolve())
        else:
            raise RequestError("this is neither a directory nor a Python file of effects", where=str(place),
                               remedy="give an existing file that ends in .py, or a directory of such files")
    return list(dict.fromkeys(files))


def load_file(path: Path) -> None:
    """Run one file of effects, once in the life of the process; what it declares is then in the registry.

    Raises:
        RequestError: the file fails, or declares a name that is taken.
    """
    path = path.resolve()
    if path in _loaded_files:
        return
    name = f"boresight_user_effects.{path.stem}_{len(_loaded_files)}"
    specification = importlib.util.spec_from_file_location(name, path)
    if specification is None or specification.loader is None:
        raise RequestError("this file cannot be imported", where=str(path))
    module = importlib.util.module_from_spec(specification)
    before = set(declaration.registry())
    sys.modules[name] = module
    try:
        specification.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        _withdraw(before)
        raise _failed("the file of effects", str(path), error) from error
    _loaded_files.add(path)


def load(places: Iterable[str | os.PathLike[str]] = ()) -> dict[str, Effect]:
    """Load everything that can be found and give the registry: effects by name, in alphabetical order.

    Args:
        places: files or directories beside those of ``BORESIGHT_EFFECTS``.

    Raises:
        RequestError: a file or an entry point cannot be loaded.
    """
    shipped()
    _load_entry_points()
    named = [p for p in os.environ.get(VARIABLE, "").split(os.pathsep) if p]
    for path in effect_files([*named, *places]):
        load_file(path)
    return declaration.registry()


def instances(layout: Layout, places: Iterable[str | os.PathLike[str]] = ()) -> dict[str, EffectInstance]:
    """Every instance that exists on a campaign, by instance name ("beam-mispointing:1"), in order of effects."""
    found: dict[str, EffectInstance] = {}
    for effect in load(places).values():
        for instance in effect.instances(layout):
            found[instance.name] = instance
    return found


def select(names: Iterable[str], layout: Layout, places: Iterable[str | os.PathLike[str]] = ()
           ) -> tuple[EffectInstance, ...]:
    """The instances of the given names; the name of an effect alone stands for all its instances.

    Raises:
        RequestError: a name is not in the library, or its effect does not exist on this campaign.
    """
    library = load(places)
    existing = instances(layout)
    chosen: dict[str, EffectInstance] = {}
    for name in names:
        if name in existing:
            chosen[name] = existing[name]
            continue
        family = [i for i in existing.values() if i.family == name]
        if family:
            chosen.update({i.name: i for i in family})
            continue
        if name.split(":")[0] in library:
            there = [i.name for i in existing.values() if i.family == name.split(":")[0]]
            raise RequestError("this effect does not exist on this campaign", where=name,
                               remedy=f"choose {', '.join(there)}" if there else "leave it out: it has no instance")
        near = difflib.get_close_matches(name, [*existing, *library], n=3, cutoff=0.5)
        raise RequestError("no effect of this name is in the library", where=name,
                           remedy=f"did you mean {' or '.join(near)}?" if near else f"choose from {', '.join(library)}")
    return tuple(chosen.values())


__all__ = ["GROUP", "VARIABLE", "effect_files", "instances", "load", "load_file", "select", "shipped"]
