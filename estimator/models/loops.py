"""A small kernel applied to many samples, or step after step along an arc, in one call.

Where the kernel is machine code, a loop of a few lines of C calls it with pointers that advance through the arrays: no
copies, nothing built per length, and Python's lock is free meanwhile. Where it is interpreted, CasADi's own maps do the
same and give the same numbers.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from estimator.models.compiled import built, library_of

_LOOP = """
typedef int (*kernel)(const double**, double**, long long*, double*, int);

int boresight_loop(kernel function, long long count, int inputs, int outputs, const double** in,
                   const long long* in_stride, double** out, const long long* out_stride, long long* iw, double* w) {
  for (long long k = 0; k < count; ++k) {
    int failed = function(in, out, iw, w, 0);
    if (failed) return failed;
    for (int i = 0; i < inputs; ++i) in[i] += in_stride[i];
    for (int i = 0; i < outputs; ++i) out[i] += out_stride[i];
  }
  return 0;
}
"""


@functools.cache
def _loop() -> Any:
    """The loop as a function of C, or None where there is no compiler."""
    path = built("boresight_loop", _LOOP)
    if path is None:
        return None
    function = ctypes.CDLL(str(path)).boresight_loop
    function.restype = ctypes.c_int
    return function


@dataclass(frozen=True)
class _Argument:
    """An array of the loop: where the kernel finds it first, and by how many numbers it advances at each call."""

    array: np.ndarray
    stride: int


class NativeLoop:
    """A compiled kernel in the loop of C.

    Args:
        kernel: with a library of its own; inputs and outputs dense.
    """

    def __init__(self, kernel: ca.Function):
        path, loop = library_of(kernel), _loop()
        if path is None or loop is None:
            raise ValueError(f"{kernel.name()} is no machine code")
        self._loop = loop
        library = ctypes.CDLL(str(path))
        self._function = getattr(library, kernel.name())
        sizes = [ctypes.c_longlong() for _ in range(4)]
        getattr(library, kernel.name() + "_work")(*(ctypes.byref(s) for s in sizes))
        self._pointers_in, self._pointers_out, self._integers, self._numbers = (max(s.value, 1) for s in sizes)

    @staticmethod
    def of(kernel: ca.Function) -> NativeLoop | None:
        """The loop of a kernel, or None where the kernel is interpreted or has parts that are not dense."""
        dense = all(kernel.sparsity_in(i).is_dense() for i in range(kernel.n_in())) and \
            all(kernel.sparsity_out(i).is_dense() for i in range(kernel.n_out()))
        return NativeLoop(kernel) if dense and library_of(kernel) is not None and _loop() is not None else None

    def __call__(self, count: int, inputs: Sequence[_Argument], outputs: Sequence[_Argument]) -> None:
        """Call the kernel ``count`` times; the arrays are contiguous, and outputs are written in place.

        Raises:
            RuntimeError: the kernel failed.
        """
        pointers_in = (ctypes.c_void_p * self._pointers_in)(*(a.array.ctypes.data for a in inputs))
        pointers_out = (ctypes.c_void_p * self._pointers_out)(*(a.array.ctypes.data for a in outputs))
        strides_in = (ctypes.c_longlong * len(inputs))(*(a.stride for a in inputs))
        strides_out = (ctypes.c_longlong * len(outputs))(*(a.stride for a in outputs))
        integers, numbers = np.empty(self._integers, dtype=np.int64), np.empty(self._numbers)
        work = ctypes.c_void_p(integers.ctypes.data), ctypes.c_void_p(numbers.ctypes.data)
        failed = self._loop(self._function, ctypes.c_longlong(count), len(inputs), len(outputs), pointers_in,
                            strides_in, pointers_out, strides_out, *work)
        if failed:
            raise RuntimeError(f"a compiled kernel failed with code {failed}")


class Mapped:
    """A kernel applied to many samples in one call.

    Args:
        kernel: the per-sample function; every input and output is made dense.
        shared: names of the inputs that are the same for all samples (unknowns); all others have one column, or one
            block of columns, per sample.

    Calling it with arrays of shape (samples, rows, columns), or (samples, rows) for vectors, returns a list of arrays
    of shape (samples, rows, columns), the last axis dropped for vectors. Shared inputs have no sample axis.
    """

    def __init__(self, kernel: ca.Function, shared: tuple[str, ...] = ()):
        self.names = [kernel.name_in(i) for i in range(kernel.n_in())]
        self._native = NativeLoop.of(kernel)
        self.kernel = kernel if self._native else _dense(kernel)
        self.shared = frozenset(shared)
        self._sizes_in = [kernel.size_in(i) for i in range(kernel.n_in())]
        self._sizes_out = [kernel.size_out(i) for i in range(kernel.n_out())]
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
            return [np.zeros((0, rows, columns) if columns > 1 else (0, rows)) for rows, columns in self._sizes_out]
        given = []
        for name, (rows, columns) in zip(self.names, self._sizes_in, strict=True):
            values = np.asarray(inputs[name], dtype=float)
            if name in self.shared:
                flat = np.ascontiguousarray(values.reshape(rows, columns).T if columns > 1 else values.reshape(-1))
            else:
                full = values.reshape(samples, rows, columns)
                flat = np.ascontiguousarray(full.transpose(0, 2, 1) if columns > 1 else full)
            given.append(_Argument(flat, 0 if name in self.shared else rows * columns))
        results = [np.empty((samples, columns, rows)) for rows, columns in self._sizes_out]
        if self._native:
            self._native(samples, given, [_Argument(r, r[0].size) for r in results])
        else:
            _trigger(self._function(samples), [a.array for a in given], results)
        return [r.transpose(0, 2, 1) if r.shape[1] > 1 else r[:, 0, :] for r in results]


class Stepped:
    """A step function applied again and again, each time to what the step before has left.

    Args:
        step: its first inputs and outputs are the quantities that are carried along, in the same order; every input
            and output is dense.
        carried: number of these.
        shared: names of the inputs that are the same for all steps; all others have one value per step.
    """

    def __init__(self, step: ca.Function, carried: int, shared: Sequence[str] = ()):
        self._step, self._carried, self._shared = step, carried, frozenset(shared)
        self._names = [step.name_in(i) for i in range(step.n_in())]
        self._sizes_out = [step.size_out(i) for i in range(step.n_out())]
        self._native = NativeLoop.of(step)
        self._accumulated: dict[int, ca.Function] = {}

    def __call__(self, steps: int, start: Sequence[np.ndarray], inputs: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        """Take ``steps`` steps.

        Args:
            steps: their number.
            start: the carried quantities before the first step, (rows,) or (rows, columns).
            inputs: the others by name: (rows,) for shared ones, (steps, rows) else.

        Returns:
            The carried quantities at the start and after every step, (steps + 1, columns, rows), and the other outputs
            of every step, (steps, columns, rows); without the axis of columns where there is one.
        """
        results = [np.empty((steps + (i < self._carried), columns, rows))
                   for i, (rows, columns) in enumerate(self._sizes_out)]
        for result, value in zip(results, start, strict=False):
            result[0] = np.asarray(value, dtype=float).reshape(result.shape[2], result.shape[1]).T
        if steps:
            others = [np.ascontiguousarray(inputs[n], dtype=float) for n in self._names[self._carried :]]
            if self._native:
                self._loop(self._native, steps, results, others)
            else:
                self._interpreted(steps, results, others)
        return [r if r.shape[1] > 1 else r[:, 0, :] for r in results]

    def _loop(self, native: NativeLoop, steps: int, results: list[np.ndarray], others: list[np.ndarray]) -> None:
        before = [_Argument(r, r[0].size) for r in results[: self._carried]]
        given = [_Argument(a, 0 if name in self._shared else a.size // steps)
                 for name, a in zip(self._names[self._carried :], others, strict=True)]
        after = [_Argument(r[1:] if i < self._carried else r, r[0].size) for i, r in enumerate(results)]
        native(steps, [*before, *given], after)

    def _interpreted(self, steps: int, results: list[np.ndarray], others: list[np.ndarray]) -> None:
        if steps not in self._accumulated:
            if len(self._accumulated) > 16:
                self._accumulated.clear()
            names_out = [self._step.name_out(i) for i in range(self._carried)]
            self._accumulated[steps] = self._step.mapaccum("arc", steps, self._names[: self._carried], names_out)
        tiled = [np.ascontiguousarray(np.broadcast_to(a, (steps, *a.shape))) if name in self._shared else a
                 for name, a in zip(self._names[self._carried :], others, strict=True)]
        first = [np.ascontiguousarray(r[0]) for r in results[: self._carried]]
        _trigger(self._accumulated[steps], [*first, *tiled],
                 [r[1:] if i < self._carried else r for i, r in enumerate(results)])


def _dense(kernel: ca.Function) -> ca.Function:
    """The kernel with dense outputs."""
    if all(kernel.sparsity_out(i).is_dense() for i in range(kernel.n_out())):
        return kernel
    names = [kernel.name_in(i) for i in range(kernel.n_in())]
    symbols = [ca.MX.sym(n, *kernel.size_in(i)) for i, n in enumerate(names)]
    return ca.Function(kernel.name() + "_dense", symbols, [ca.densify(o) for o in kernel.call(symbols)], names,
                       [kernel.name_out(i) for i in range(kernel.n_out())])


def _trigger(function: ca.Function, inputs: Sequence[np.ndarray], outputs: Sequence[np.ndarray]) -> None:
    """Call a function through CasADi's buffer interface, which copies no matrices; outputs are written in place."""
    buffer, trigger = function.buffer()
    for i, array in enumerate(inputs):
        buffer.set_arg(i, (array if array.size else np.zeros(1)).data)
    for i, array in enumerate(outputs):
        buffer.set_res(i, array.data)
    trigger()
