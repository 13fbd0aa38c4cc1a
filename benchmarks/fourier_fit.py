"""The linear Fourier fit: time, memory and accuracy against a dense decomposition, normal equations and the FFT floor.

    python -m benchmarks.fourier_fit [--quick] [--repeat N]

Positions of a low orbit (J2, J3, J4; integrated in inertial axes, turned to Earth-fixed ones) with 1 m white noise on
each axis are fitted on a Fourier frame. Each method runs in a process of its own, so that its peak memory is its own
(interpreter, libraries and data included). Times are medians, as ratios to three zero-padded real FFTs of twice the
number of samples, taken in the same process between the repetitions.

Methods:
    compressed: :func:`estimator.linear_block.compress`, the product.
    compressed, irregular: the same on sampling times drawn at random.
    degree: :func:`estimator.linear_block.choose_degree`, which picks the degree from the data (its own D is reported).
    dense: numpy.linalg.svd of the design matrix, singular values below 1e-12 dropped.
    normal: right-hand side by FFT, closed-form Gram matrix split by parity, Cholesky with 1e-13 of the largest
        eigenvalue added to the diagonal: short, at the price of the square of the condition number.

"noise only" is the error of an unbiased fit with the rank that the compressed fit found, sigma sqrt(3 rank / N).
Results go to benchmarks/results/fourier_fit.json.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time as clock
from collections.abc import Callable
from pathlib import Path

import numpy as np
import scipy.fft
from scipy.integrate import solve_ivp
from scipy.linalg import cho_factor, cho_solve

from estimator.linear_block import choose_degree, compress
from estimator.models.files import written_atomically
from estimator.models.fourier_trajectory import FourierFrame, concentrated_directions

GRAVITATION = 3.986004418e14  # m3/s2
EARTH_RADIUS = 6378137.0  # m
EARTH_RATE = 7.292115e-5  # rad/s
ZONAL = {2: 1.08262668e-3, 3: -2.53265649e-6, 4: -1.61962159e-6}
SIGMA = 1.0  # m

# samples, step s, degree, methods
TASKS: list[tuple[int, float, int, tuple[str, ...]]] = [
    (10_000, 2.0, 64, ("compressed", "compressed, irregular", "degree", "normal", "dense")),
    (100_000, 1.0, 256, ("compressed", "compressed, irregular", "degree", "normal")),
    (864_000, 0.2, 64, ("compressed", "normal")),
    (864_000, 0.2, 512, ("compressed", "compressed, irregular", "degree", "normal")),
    (864_000, 0.2, 2048, ("compressed", "normal")),
]


def acceleration(r: np.ndarray) -> np.ndarray:
    """Earth's gravity with zonal harmonics to degree 4, m/s2, in inertial axes."""
    distance = float(np.sqrt(r @ r))
    up, pole = r / distance, np.array([0.0, 0.0, 1.0])
    s = up[2]
    legendre = {2: (1.5 * s**2 - 0.5, 3.0 * s), 3: (2.5 * s**3 - 1.5 * s, 7.5 * s**2 - 1.5),
                4: ((35.0 * s**4 - 30.0 * s**2 + 3.0) / 8.0, (35.0 * s**3 - 15.0 * s) / 2.0)}
    total = -GRAVITATION * up / distance**2
    for n, j in ZONAL.items():
        value, slope = legendre[n]
        total = total + GRAVITATION * j * EARTH_RADIUS**n / distance ** (n + 2) * (
            (n + 1) * value * up - slope * (pole - s * up))
    return total


def orbit(time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Earth-fixed position and velocity (n, 3) of a 693 km polar orbit."""
    radius = 7071.0e3  # m
    speed = np.sqrt(GRAVITATION / radius) * 1.0005  # m/s
    start = np.r_[radius, 0.0, 0.0, 0.0, speed * np.cos(1.71), speed * np.sin(1.71)]
    solution = solve_ivp(lambda _, y: np.r_[y[3:], acceleration(y[:3])], (0.0, float(time[-1])), start, method="DOP853",
                         rtol=1e-12, atol=1e-6, dense_output=True).sol
    parts = [solution(time[i : i + 100_000]) for i in range(0, time.size, 100_000)]
    x, y, z, vx, vy, vz = np.concatenate(parts, axis=1)
    cos, sin = np.cos(EARTH_RATE * time), np.sin(EARTH_RATE * time)
    position = np.stack([cos * x + sin * y, cos * y - sin * x, z], axis=1)
    velocity = np.stack([cos * vx + sin * vy + EARTH_RATE * position[:, 1],
                         cos * vy - sin * vx - EARTH_RATE * position[:, 0], vz], axis=1)
    return position, velocity


def normal_equations(frame: FourierFrame, time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Coefficients from the normal equations; regular sampling from start to stop of the frame only."""
    n, degree = time.size, frame.degree
    spectrum = scipy.fft.rfft(np.ascontiguousarray(values.T), 2 * (n - 1))[:, : degree + 1]
    # e^{-j pi d (t - middle) / T}: the FFT counts phases from the first sample, a quarter turn a degree earlier.
    spectrum = spectrum * 1j ** (np.arange(degree + 1) % 4)
    right_even, right_odd = spectrum.real.T, -spectrum.imag.T[1:]
    delta = np.arange(2 * degree + 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        kernel = np.sin(n * np.pi * delta / (2.0 * (n - 1))) / np.sin(np.pi * delta / (2.0 * (n - 1)))
    kernel[0] = n
    d = np.arange(degree + 1)
    difference, total = kernel[np.abs(d[:, None] - d)], kernel[d[:, None] + d]
    parts = []
    for gram, right in ((0.5 * (difference + total), right_even), (0.5 * (difference - total)[1:, 1:], right_odd)):
        gram[np.diag_indices_from(gram)] += 1e-13 * n
        parts.append(cho_solve(cho_factor(gram, overwrite_a=True, check_finite=False), right, check_finite=False))
    return np.concatenate(parts)


def dense_decomposition(frame: FourierFrame, time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Coefficients from the truncated singular value decomposition of the design matrix."""
    u, s, vt = np.linalg.svd(frame.basis(time), full_matrices=False)
    keep = s > 1e-12 * s[0]
    return vt[keep].T @ ((u[:, keep].T @ values) / s[keep, None])


def run(method: str, degree: int, data: Path, repeat: int) -> dict[str, object]:
    """One method on one data file, in this process."""
    with np.load(data) as file:
        time, values = file["time"], file["values"]
    weights = np.full(values.shape, SIGMA**-2)
    frame = FourierFrame(float(time[0]), float(time[-1]), degree)
    padded = np.zeros((3, 2 * time.size))
    padded[:, : time.size] = values.T

    rank: int | None = None
    coefficients = np.zeros((frame.size, 3))

    def compressed() -> None:
        nonlocal coefficients, rank
        concentrated_directions.cache_clear()  # count the first call, not a cached one
        block = compress(frame, time, values, weights)
        coefficients, rank = block.coefficients, block.rank

    def degree_from_data() -> None:
        nonlocal frame
        concentrated_directions.cache_clear()
        frame = choose_degree(time, values, SIGMA).frame

    def normal() -> None:
        nonlocal coefficients
        coefficients = normal_equations(frame, time, values)

    def dense() -> None:
        nonlocal coefficients
        coefficients = dense_decomposition(frame, time, values)

    actions: dict[str, Callable[[], None]] = {"compressed": compressed, "compressed, irregular": compressed,
                                              "degree": degree_from_data, "normal": normal, "dense": dense}
    action = actions[method]
    seconds, floor = [], []
    for _ in range(repeat):
        start = clock.perf_counter()
        scipy.fft.rfft(padded)
        middle = clock.perf_counter()
        action()
        seconds.append(clock.perf_counter() - middle)
        floor.append(middle - start)
    del padded
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0  # MB; Linux counts in kB
    if method == "degree":
        compressed()
    with np.load(data) as file:
        position, velocity = file["position"], file["velocity"]
    error = frame.evaluate(coefficients, time) - position
    rate_error = frame.evaluate(coefficients, time, 1) - velocity
    return {"method": method, "samples": int(time.size), "degree": frame.degree, "rank": rank,
            "seconds": float(np.median(seconds)), "seconds_floor": float(np.median(floor)),
            "ratio_to_floor": float(np.median(np.array(seconds) / np.array(floor))),
            "position_rms_m": float(np.sqrt((error**2).sum(axis=1).mean())),
            "velocity_rms_m_s": float(np.sqrt((rate_error**2).sum(axis=1).mean())),
            "noise_only_m": None if rank is None else float(SIGMA * np.sqrt(3.0 * rank / time.size)),
            "peak_memory_mb": float(memory)}


def write_data(samples: int, step: float, irregular: bool, path: Path) -> None:
    """Times, noisy positions and the truth."""
    generator = np.random.default_rng(samples)
    time = step * np.arange(samples)
    if irregular:
        time = np.sort(generator.uniform(0.0, time[-1], samples))
    position, velocity = orbit(time)
    np.savez(path, time=time, values=position + SIGMA * generator.normal(size=position.shape), position=position,
             velocity=velocity)


def main() -> None:
    """Run all tasks, each method in its own process, print the table and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="the smallest task only, nothing is written")
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--one", nargs=3, metavar=("METHOD", "DEGREE", "DATA"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        method, degree, data = arguments.one
        print(json.dumps(run(method, int(degree), Path(data), arguments.repeat)))
        return
    rows = []
    print(f"{'method':22s} {'N':>8s} {'D':>5s} {'rank':>5s} {'s':>9s} {'/floor':>7s} {'position m':>11s} "
          f"{'noise only':>10s} {'velocity m/s':>12s} {'MB':>6s}")
    with tempfile.TemporaryDirectory() as directory:
        for samples, step, degree, methods in TASKS[:1] if arguments.quick else TASKS:
            files = {}
            for irregular in {"irregular" in m for m in methods}:
                files[irregular] = Path(directory) / f"{samples}-{irregular}.npz"
                if not files[irregular].exists():
                    write_data(samples, step, irregular, files[irregular])
            for method in methods:
                command = [sys.executable, "-m", "benchmarks.fourier_fit", "--repeat", str(arguments.repeat), "--one",
                           method, str(degree), str(files["irregular" in method])]
                row = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
                rows.append(row)
                noise = "" if row["noise_only_m"] is None else f"{row['noise_only_m']:.4f}"
                print(f"{row['method']:22s} {row['samples']:8d} {row['degree']:5d} {row['rank'] or '':>5} "
                      f"{row['seconds']:9.4f} {row['ratio_to_floor']:7.2f} {row['position_rms_m']:11.4f} {noise:>10s} "
                      f"{row['velocity_rms_m_s']:12.3e} {row['peak_memory_mb']:6.0f}", flush=True)
    if not arguments.quick:
        target = Path(__file__).parent / "results" / "fourier_fit.json"
        target.parent.mkdir(exist_ok=True)
        with written_atomically(target) as partial:
            Path(partial).write_text(json.dumps({"sigma_m": SIGMA, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
