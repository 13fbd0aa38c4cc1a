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
import numpy as np

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

    Two processes that compile the same kernel at once do no harm: each renames a whole library into place.
    """
    found = compiler()
    directory = cache_directory() if found else None
    if found is None or directory is None:
        return function
    path, version = found
    with tempfile.TemporaryDirectory(prefix="boresight-") as work:
        generator = ca.CodeGenerator("kernel.c", {"with_header": False})
        generator.add(function)
        source = generator.dump()
        flags = _flags(source)
        key = hashlib.sha256(
            "\n".join([source, version, *flags, ca.__version__, platform.machine(), _processor(),
                       function.name()]).encode()
        ).hexdigest()[:32]
        library = directory / f"{function.name()}-{key}.so"
        if not library.exists():
            source_file = Path(work) / "kernel.c"
            source_file.write_text(source)
            partial = directory / f".{library.name}.{os.getpid()}"
            answer = subprocess.run([path, *flags, str(source_file), "-o", str(partial), "-lm"],
                                    capture_output=True, text=True, check=False)
            if answer.returncode != 0:
                partial.unlink(missing_ok=True)
                return function
            partial.replace(library)
        return ca.external(function.name(), str(library))


class Mapped:
    """A kernel applied to many samples in one call, through CasADi's buffer interface (no copies of matrices).

    Args:
        kernel: the per-sample function; every input and output is made dense.
        shared: names of the inputs that are the same for all samples (unknowns); all others have one column, or one
            block of columns, per sample.

    Calling it with arrays of shape (samples, rows, columns), or (samples, rows) for vectors, returns a list of arrays
    of shape (samples, rows, columns), the last axis dropped for vectors. Shared inputs have no sample axis.
    """

    def __init__(self, kernel: ca.Function, shared: tuple[str, ...] = ()):
        self.names = [kernel.name_in(i) for i in range(kernel.n_in())]
        symbols = [ca.MX.sym(n, *kernel.size_in(i)) for i, n in enumerate(self.names)]
        outputs = kernel.call(symbols)
        dense = ca.Function(kernel.name() + "_dense", symbols, [ca.densify(o) for o in outputs], self.names,
                            [kernel.name_out(i) for i in range(kernel.n_out())])
        sparse = any(not kernel.sparsity_out(i).is_dense() for i in range(kernel.n_out()))
        self.kernel = dense if sparse else kernel
        self.shared = frozenset(shared)
        self._by_size: dict[int, ca.Function] = {}

    def _function(self, samples: int) -> ca.Function:
        if samples not in self._by_size:
            if len(self._by_size) > 32:
                self._by_size.clear()
            reduce_in = [i for i, n in enumerate(self.names) if n in self.shared]
            name = f"{self.kernel.name()}_map{samples}"
            if reduce_in:
                self._by_size[samples] = self.kernel.map(name, "serial", samples, reduce_in, [])
            else:
                self._by_size[samples] = self.kernel.map(samples, "serial")
        return self._by_size[samples]

    def __call__(self, samples: int, **inputs: np.ndarray) -> list[np.ndarray]:
        """Apply the kernel to ``samples`` samples; see the class for shapes."""
        if samples == 0:
            return [np.zeros((0, *self._shape(i))) for i in range(self.kernel.n_out())]
        function = self._function(samples)
        buffer, trigger = function.buffer()
        keep = []
        for i, name in enumerate(self.names):
            rows, columns = self.kernel.size_in(i)
            values = np.asarray(inputs[name], dtype=float)
            if name in self.shared:
                flat = np.ascontiguousarray(values.reshape(rows, columns).T if columns > 1 else values.reshape(-1))
            else:
                full = values.reshape(samples, rows, columns)
                flat = np.ascontiguousarray(full.transpose(0, 2, 1) if columns > 1 else full)
            keep.append(flat)
            buffer.set_arg(i, flat.data)
        results = []
        for i in range(self.kernel.n_out()):
            rows, columns = self.kernel.size_out(i)
            out = np.zeros((samples, columns, rows))
            results.append(out)
            buffer.set_res(i, out.data)
        trigger()
        return [r.transpose(0, 2, 1) if r.shape[1] > 1 else r[:, 0, :] for r in results]

    def _shape(self, i: int) -> tuple[int, ...]:
        rows, columns = self.kernel.size_out(i)
        return (rows, columns) if columns > 1 else (rows,)
