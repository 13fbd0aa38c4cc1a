"""Kernels as machine code where there is a C compiler, interpreted where there is none: the same numbers either way.

``compiled`` writes the C source that CasADi generates for a pure function, compiles it once and keeps the library in
a cache directory under a key made of the source, the compiler, the processor and the CasADi version. The cache
directory is ``$BORESIGHT_CACHE``, else ``$XDG_CACHE_HOME/boresight``, else ``~/.cache/boresight``; if none of them can
be written, or ``BORESIGHT_COMPILER=none``, the function is returned as it is.
"""

from __future__ import annotations

import functools
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
from pathlib import Path

import casadi as ca

_FLAGS = ("-fPIC", "-shared", "-fno-math-errno")
_OPTIMIZATION = ((25_000, "-O2"), (40_000, "-O1"))
"""Lines of source up to which a level is used, none above: the compiler's time grows faster than the source (70,000
lines of straight-line code: 124 s with -O2, 26 s with -O1, 3.5 s with -O0, which runs 1.2 times as long)."""


def _flags(source: str) -> tuple[str, ...]:
    lines = source.count("\n")
    level = next((level for most, level in _OPTIMIZATION if lines <= most), "-O0")
    return (level, *_FLAGS, *(("-march=native",) if _processor() else ()))


@functools.cache
def _processor() -> str:
    """What this processor can do, where machine code is made for it alone (a cache may be shared between machines)."""
    information = Path("/proc/cpuinfo")
    if platform.machine() != "x86_64" or not information.exists():
        return ""
    return next((line for line in information.read_text().splitlines() if line.startswith("flags")), "")


@functools.cache
def compiler() -> tuple[str, str] | None:
    """Path and version of the C compiler, or None where there is none (or ``BORESIGHT_COMPILER=none``)."""
    wish = os.environ.get("BORESIGHT_COMPILER", "")
    if wish == "none":
        return None
    for name in filter(None, (wish, "cc", "gcc", "clang")):
        path = shutil.which(name)
        if path is None:
            continue
        answer = subprocess.run([path, "--version"], capture_output=True, text=True, check=False)
        if answer.returncode == 0:
            return path, answer.stdout.splitlines()[0]
    return None


def cache_directory() -> Path | None:
    """The directory of compiled kernels, made if need be; None where no directory can be written."""
    if chosen := os.environ.get("BORESIGHT_CACHE"):
        candidates = [Path(chosen)]
    else:
        base = os.environ.get("XDG_CACHE_HOME")
        candidates = [Path(base) / "boresight" if base else Path.home() / ".cache" / "boresight"]
        candidates.append(Path(tempfile.gettempdir()) / f"boresight-{os.getuid() if hasattr(os, 'getuid') else 0}")
    for directory in candidates:
        try:
            directory.mkdir(parents=True, exist_ok=True, mode=0o700)
        except OSError:
            continue
        if os.access(directory, os.W_OK):
            return directory
    return None


def compiled(function: ca.Function) -> ca.Function:
    """The same function as machine code, or ``function`` itself where it cannot be compiled.

    Args:
        function: a pure CasADi function without callbacks or solvers inside.
    """
    if compiler() is None or cache_directory() is None:
        return function
    generator = ca.CodeGenerator("kernel.c", {"with_header": False})
    generator.add(function)
    source = generator.dump()
    library = built(function.name(), source)
    if library is None:
        return function
    made = ca.external(function.name(), str(library))
    _libraries[hash(made)] = made, library
    return made


_libraries: dict[int, tuple[ca.Function, Path]] = {}
"""Of every compiled function its library, under the identity that CasADi gives it; held, so that it stays unique."""


def library_of(function: ca.Function) -> Path | None:
    """The library of a function that :func:`compiled` made, None for any other."""
    found = _libraries.get(hash(function))
    return None if found is None else found[1]


def built(name: str, source: str) -> Path | None:
    """The library of a source in C, from the cache or compiled now; None where it cannot be compiled.

    Two processes that compile the same source at once do no harm: each renames a whole library into place.
    """
    found = compiler()
    directory = cache_directory() if found else None
    if found is None or directory is None:
        return None
    path, version = found
    flags = _flags(source)
    key = hashlib.sha256("\n".join([source, version, *flags, ca.__version__, platform.machine(), _processor(),
                                    name]).encode()).hexdigest()[:32]
    library = directory / f"{name}-{key}.so"
    if not library.exists():
        with tempfile.TemporaryDirectory(prefix="boresight-") as work:
            source_file = Path(work) / "kernel.c"
            source_file.write_text(source)
            partial = directory / f".{library.name}.{os.getpid()}"
            answer = subprocess.run([path, *flags, str(source_file), "-o", str(partial), "-lm"],
                                    capture_output=True, text=True, check=False)
            if answer.returncode != 0:
                partial.unlink(missing_ok=True)
                return None
            partial.replace(library)
    return library
