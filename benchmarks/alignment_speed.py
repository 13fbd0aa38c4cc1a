"""Speed and memory of the joint alignment estimate: against the FFT floor, growing with the data, against rivals.

    python -m benchmarks.alignment_speed [--quick] [--repeat N]

Full size: 2 days of positions at 0.2 s (864,000), degree 512, 20 Doppler sessions, 3 free arcs, 3 pulses. A process of
its own reads the campaign file and solves it, and times the floor between the repetitions: three zero-padded real FFTs
of the number of positions. The compiled kernels are in the cache and built before the clock starts. Times are medians
of CPU and elapsed seconds; the machine may be loaded by others, so ratios are of the same process. Peak memory is that
of the process: interpreter, libraries and data included.

Position error over noise: root mean square error of the fitted positions over that of an unbiased fit with the same
number of parameters. Velocity error over QR: the same against a dense orthogonal decomposition of one axis on every
eighth position with as much less noise, which is what fits in memory.

Rivals solve 10,000 positions at degree 64 with the same Doppler and star tracker residuals and the same whitening,
every Fourier coefficient an unknown; each is given up after a time limit. Results go to
benchmarks/results/alignment_speed.json.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import scipy.fft
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares

from benchmarks.tables import RESULTS, write_result, write_tables
from estimator.problem import Problem
from estimator.residuals import KernelResidual
from estimator.solvers import Options, solve
from estimator.trajectory_residual import TrajectoryResidual
from estimator.unknowns import Unknown, Vector, offsets
from problems.alignment.problem import AlignmentModel, alignment_model, alignment_problem
from problems.alignment.simulator import preset, simulate
from problems.alignment.solution import solve_campaign
from problems.readers.campaign_file import read_campaign, write_campaign

RIVAL_LIMIT = 60.0  # CPU s after which a rival is given up
GROWTH: tuple[tuple[int, float, int], ...] = ((10_000, 17.28, 256), (10_000, 17.28, 512), (100_000, 1.728, 256),
                                              (100_000, 1.728, 512), (864_000, 0.2, 256), (864_000, 0.2, 1024))
"""Positions, step (s) and degree; the span stays 2 days, which degrees below 256 follow to kilometres only."""


def peak_gigabytes() -> float:
    """Most memory that this process ever held (getrusage would count that of the process which started it)."""
    status = Path("/proc/self/status")
    if status.exists():
        line = next(x for x in status.read_text(encoding="utf-8").splitlines() if x.startswith("VmHWM"))
        return int(line.split()[1]) * 1024 / 1e9
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


def measured(path: Path, degree: int, repeat: int) -> dict[str, Any]:
    """Read and solve a campaign file, with the floor, in this process."""
    solve_campaign(read_campaign(path), degree=degree)  # kernels compiled and loaded
    cpu, wall, floor_cpu, floor_wall, iteration = [], [], [], [], []
    campaign = read_campaign(path)
    count = len(campaign.gnss.time)
    noise = np.random.default_rng(0).normal(size=(3, count))
    solution = None
    for _ in range(repeat):
        for _ in range(3):
            a, b = time.process_time(), time.perf_counter()
            scipy.fft.rfft(noise, 2 * count)
            floor_cpu.append(time.process_time() - a)
            floor_wall.append(time.perf_counter() - b)
        a, b = time.process_time(), time.perf_counter()
        solution = solve_campaign(read_campaign(path), degree=degree)
        cpu.append(time.process_time() - a)
        wall.append(time.perf_counter() - b)
        problem = solution.estimate.problem
        start = problem.starting_at(solution.estimate.values)
        a = time.process_time()
        prepared = start.prepared(start.start)
        prepared.linearize(start.start)
        iteration.append(time.process_time() - a)
    assert solution is not None
    medians = {"cpu_seconds": cpu, "seconds": wall, "floor_cpu_seconds": floor_cpu, "floor_seconds": floor_wall,
               "iteration_seconds": iteration}
    result: dict[str, Any] = {k: float(np.median(v)) for k, v in medians.items()}
    result |= {"ratio_cpu": result["cpu_seconds"] / result["floor_cpu_seconds"],
               "ratio": result["seconds"] / result["floor_seconds"], "positions": count, "degree": degree,
               "repetitions": repeat, "status": str(solution.status), "iterations": solution.estimate.iterations,
               "peak_gigabytes": peak_gigabytes(),
               "load": os.getloadavg()[0], "star_tracker_samples": len(campaign.star_tracker.time),
               "sessions": len(campaign.arcs_of_kind("doppler")),
               "arcs": sum(a.kind != "doppler" for a in campaign.arcs)}
    return result


def in_process(path: Path, degree: int, repeat: int) -> dict[str, Any]:
    """:func:`measured` in a process of its own."""
    answer = subprocess.run([sys.executable, "-m", "benchmarks.alignment_speed", "--measure", str(path), str(degree),
                             str(repeat)], check=True, capture_output=True, text=True)
    return dict(json.loads(answer.stdout.splitlines()[-1]))


def quality(campaign: Any, truth: Any, degree: int) -> dict[str, float]:
    """Errors of the fitted positions and velocities over what noise alone and a dense decomposition give."""
    model = alignment_model(campaign, degree=degree)
    block, sigma = model.block, float(np.median(campaign.gnss.standard_deviation))
    time_, n = campaign.gnss.time, len(campaign.gnss.time)
    every = max(1, n // 4000)
    position, velocity = truth.trajectory(time_[::every])
    error = block.values(time_[::every], 0) - position
    expected = sigma * np.sqrt(float(np.mean(block.ranks)) / n)
    thin = max(1, n // 20_000)
    at = time_[::thin]
    # A dense fit to thinned positions whose noise is as much smaller, so that the information is the same.
    noise = np.random.default_rng(5).normal(size=len(at)) * sigma / np.sqrt(thin)
    columns = model.frame.basis(at)
    u, s, vt = np.linalg.svd(columns, full_matrices=False)
    keep = s > 1e-12 * s[0]
    coefficients = vt[keep].T @ ((u[:, keep].T @ (truth.trajectory(at)[0][:, 0] + noise)) / s[keep])
    dense = model.frame.basis(time_[::every], 1) @ coefficients - velocity[:, 0]
    ours = block.values(time_[::every], 1) - velocity
    return {"position_over_noise": float(np.sqrt(np.mean(error**2)) / expected),
            "position_rms": float(np.sqrt(np.mean(error**2))),
            "velocity_over_qr": float(np.sqrt(np.mean(ours**2)) / np.sqrt(np.mean(dense**2)))}


# --- rivals ----------------------------------------------------------------------------------------------------------


def uncompressed(model: AlignmentModel, problem: Problem, values: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """The same problem with every Fourier coefficient an unknown, as one CasADi expression in tangent coordinates.

    The coefficients are taken in combinations of unit information (from a QR decomposition that is not charged to the
    rivals): without that, none of them converges on a Fourier frame.
    """
    gnss, frame = model.campaign.gnss, model.frame
    basis = frame.basis(gnss.time)
    positions = problem.residuals[0]
    assert isinstance(positions, TrajectoryResidual)
    transforms, designs, centre = [], [], model.block.coefficients
    for axis in range(3):
        sigma = gnss.standard_deviation[:, axis]
        triangle = np.linalg.qr(basis / sigma[:, None], mode="r")
        transforms.append(solve_triangular(triangle, np.eye(frame.size)))
        designs.append((basis / sigma[:, None]) @ transforms[-1])
    whitened = ((gnss.position - basis @ centre) / gnss.standard_deviation)
    others = tuple(u for u in problem.free if u.name != positions.trajectory.name)
    columns = offsets(others)
    small = sum(u.manifold.tangent for u in others)
    size = small + 3 * frame.size
    scale = np.concatenate([*(u.scales for u in others), np.ones(3 * frame.size)])
    z = ca.MX.sym("z", size)
    step = z * ca.DM(scale)
    symbols = {u.name: ca.MX(ca.DM(np.asarray(values[u.name]))) for u in problem.unknowns}
    for u in others:
        symbols[u.name] = u.manifold.retract(symbols[u.name], step[columns[u.name]])
    coefficients = [z[small + a * frame.size : small + (a + 1) * frame.size] for a in range(3)]
    rows = [ca.DM(whitened[:, a]) - ca.mtimes(ca.DM(designs[a]), coefficients[a]) for a in range(3)]
    for residual in problem.prepared(values).residuals[1:]:
        assert isinstance(residual, KernelResidual)
        if any(u.name == positions.trajectory.name for u in residual.unknowns):
            slope = frame.basis(residual.time, 1)
            matrix = np.zeros((residual.samples, 3, 3 * frame.size))
            for a in range(3):
                matrix[:, a, a * frame.size : (a + 1) * frame.size] = slope @ transforms[a]
            whole = Unknown("coefficients", Vector(3 * frame.size), "1", 1.0)
            signal = replace(residual.signals[0], unknown=whole, matrix=matrix)  # type: ignore[type-var]
            residual = replace(residual, signals=(signal,))
            symbols["coefficients"] = z[small:]
        rows.append(residual.symbolic(symbols))
    return {"z": z, "residual": ca.vertcat(*rows), "size": size, "small": small, "scale": scale, "others": others,
            "start": np.zeros(size)}


class _GivenUp(Exception):
    """A rival met the time limit."""


def _limited(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function that stops the rival that calls it once the limit is met."""
    began = time.process_time()

    def call(*arguments: Any) -> Any:
        if time.process_time() - began > RIVAL_LIMIT:
            raise _GivenUp
        return function(*arguments)

    return call


def with_scipy(whole: dict[str, Any]) -> np.ndarray:
    """scipy.optimize.least_squares with the dense Jacobian that CasADi differentiates."""
    z, r = whole["z"], whole["residual"]
    residual = ca.Function("r", [z], [r])
    jacobian = ca.Function("J", [z], [ca.jacobian(r, z)])
    solution = least_squares(_limited(lambda x: np.asarray(residual(x)).ravel()), whole["start"],
                             jac=_limited(lambda x: np.asarray(ca.DM(jacobian(x)).full())), method="trf",
                             xtol=1e-10, ftol=1e-12, gtol=1e-10)
    return np.asarray(solution.x)


def with_ipopt(whole: dict[str, Any]) -> np.ndarray:
    """IPOPT on the uncompressed problem with the Gauss-Newton matrix as its Hessian."""
    z, r = whole["z"], whole["residual"]
    jacobian = ca.jacobian(r, z)
    scale, nothing = ca.MX.sym("s"), ca.MX.sym("l", 0)
    hessian = ca.Function("nlp_hess_l", [z, ca.MX.sym("p", 0), scale, nothing],
                          [scale * ca.triu(ca.mtimes(jacobian.T, jacobian))],
                          ["x", "p", "lam_f", "lam_g"], ["triu_hess_gamma_x_x"])
    solver = ca.nlpsol("whole", "ipopt", {"x": z, "f": 0.5 * ca.sumsqr(r)},
                       {"print_time": False, "hess_lag": hessian,
                        "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-8, "max_cpu_time": RIVAL_LIMIT,
                                  "nlp_scaling_method": "none"}})
    solution = solver(x0=whole["start"])
    if not solver.stats()["success"]:
        raise _GivenUp
    return np.asarray(solution["x"]).ravel()


def with_pyceres(whole: dict[str, Any]) -> np.ndarray:
    """Ceres by pyceres, one cost function for all residuals with the Jacobian that CasADi differentiates.

    Raises:
        ImportError: pyceres is not installed.
    """
    import pyceres  # type: ignore[import-not-found]

    z, r = whole["z"], whole["residual"]
    residual = ca.Function("r", [z], [r])
    jacobian = ca.Function("J", [z], [ca.jacobian(r, z)])

    class Cost(pyceres.CostFunction):  # type: ignore[misc]
        def __init__(self) -> None:
            pyceres.CostFunction.__init__(self)
            self.set_num_residuals(r.shape[0])
            self.set_parameter_block_sizes([whole["size"]])

        def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:
            residuals[:] = np.asarray(residual(parameters[0])).ravel()
            if jacobians is not None and jacobians[0] is not None:
                jacobians[0][:] = jacobian(parameters[0]).full().ravel()
            return True

    x = whole["start"].copy()
    problem = pyceres.Problem()
    problem.add_residual_block(Cost(), None, [x])
    options = pyceres.SolverOptions()
    options.linear_solver_type = pyceres.LinearSolverType.DENSE_NORMAL_CHOLESKY
    options.minimizer_progress_to_stdout = False
    options.num_threads = 1
    options.max_solver_time_in_seconds = RIVAL_LIMIT
    pyceres.solve(options, problem, pyceres.SolverSummary())
    return x


def rivals(positions: int, degree: int) -> list[dict[str, Any]]:
    """Ours and every rival on one campaign, in one process, one after the other."""
    span = 6 * 3600.0
    campaign, _ = simulate(preset("compact", duration=span, gnss_step=span / positions, doppler_sessions=12,
                                  session_duration=60.0, star_tracker_step=1.0, doppler_step=1.0), 2)
    solve_campaign(campaign, degree=degree)
    ours = []
    for _ in range(3):
        began = time.process_time()
        best = solve_campaign(campaign, degree=degree)
        ours.append(time.process_time() - began)
    reference = float(np.median(ours))
    rows = [{"name": "boresight, starting point included", "seconds": reference, "seconds_text": f"{reference:.2f}",
             "ratio_text": "1", "note": f"{best.estimate.iterations} iterations"}]
    model = best.model
    problem = alignment_problem(model)
    # Rivals cannot renew the whitening: they get that of the optimum. They start where ours does, its starting point
    # and its fit of the positions not charged to them.
    whole = uncompressed(model, problem, best.estimate.values)
    columns = offsets(problem.free)
    first = problem.difference(best.estimate.values, problem.start)
    displaced = np.concatenate([first[columns[u.name]] for u in whole["others"]])
    whole["start"][: whole["small"]] = displaced / whole["scale"][: whole["small"]]
    began = time.process_time()
    solve(problem.starting_at(best.estimate.values), Options())
    alone = time.process_time() - began
    rows.append({"name": "boresight, from the optimum", "seconds": alone, "seconds_text": f"{alone:.2f}",
                 "ratio_text": f"{alone / reference:.2f}", "note": "iterations alone"})
    for name, rival in (("scipy.optimize.least_squares", with_scipy), ("IPOPT, Gauss-Newton Hessian", with_ipopt),
                        ("Ceres (pyceres)", with_pyceres)):
        began = time.process_time()
        note = ""
        try:
            x = rival(whole)
            sigma = np.concatenate([best.estimate.sigma_of(u.name) for u in whole["others"]])
            apart = float(np.max(np.abs(x[: whole["small"]] * whole["scale"][: whole["small"]]) / sigma))
            note = f"within {apart:.1g} sigma of ours"
        except ImportError:
            rows.append({"name": name, "seconds": None, "seconds_text": "-", "ratio_text": "-",
                         "note": "not installed"})
            continue
        except _GivenUp:
            note = "given up at the time limit"
        seconds = time.process_time() - began
        more = "over " if note.startswith("given") else ""
        rows.append({"name": name, "seconds": seconds, "seconds_text": f"{more}{seconds:.1f}",
                     "ratio_text": f"{more}{seconds / reference:.0f}", "note": note})
    return rows


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--quick", action="store_true", help="full size and rivals alone, few repetitions")
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--rivals", action="store_true", help="measure the rivals again, keep the other numbers")
    parser.add_argument("--measure", nargs=3, metavar=("FILE", "DEGREE", "REPEAT"), help="used by the benchmark itself")
    options = parser.parse_args(arguments)
    if options.measure:
        print(json.dumps(measured(Path(options.measure[0]), int(options.measure[1]), int(options.measure[2]))))
        return 0
    repeat = 2 if options.quick else options.repeat
    result: dict[str, Any] = {}
    if options.rivals:
        result = json.loads((RESULTS / "alignment_speed.json").read_text(encoding="utf-8"))
        return _finished(result)
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "full.nc"
        campaign, truth = simulate(preset("full"), 1)
        write_campaign(campaign, path)
        print("full size", file=sys.stderr)
        result["full"] = in_process(path, 512, repeat) | quality(campaign, truth, 512)
        write_result("alignment_speed", result)
        del campaign, truth
        result["growth"] = []
        for positions, step, degree in GROWTH[:0] if options.quick else GROWTH:
            print(f"{positions} positions, degree {degree}", file=sys.stderr)
            write_campaign(simulate(preset("full", gnss_step=step), 1)[0], path)
            result["growth"].append(in_process(path, degree, max(1, repeat // 2)))
            write_result("alignment_speed", result)
    return _finished(result)


def _finished(result: dict[str, Any]) -> int:
    """Measure the rivals and write everything."""
    print("rivals", file=sys.stderr)
    result["rival_size"] = {"positions": 10_000, "degree": 64}
    result["rivals"] = rivals(10_000, 64)
    write_result("alignment_speed", result)
    print(write_tables())
    return 0


if __name__ == "__main__":
    sys.exit(main())
