"""Study of the slew problem: random slews, references, closed forms, replanning, rivals.

Run ``python -m benchmarks.slew_ocp [--count 1000] [--reference 50] [--rivals 20] [--no-laws] [--out FILE]``; it prints
tables and writes JSON. Times are process times of this process and wall times, single-threaded.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from estimator.models.errors import InfeasibleError
from guidance import kinematics as kin
from guidance.eigenaxis_slew import is_rest_to_rest, s_curve_duration, turn
from guidance.rodrigues_slew import rodrigues_slew
from guidance.slew import solve_slew
from guidance.slew_bounds import lower_bound
from guidance.slew_envelope import envelope_of
from guidance.slew_optimum import _solve, _uniform_start, optimal_slew, prepare
from guidance.slew_request import Boundary, Limits, SlewRequest
from guidance.slew_verification import verify

DEGREE = math.pi / 180


def limits(looser: float) -> Limits:
    """2.5 deg/s, 0.2 deg/s2, 0.1 deg/s3 and the last one ``looser`` times."""
    return Limits(2.5 * DEGREE, 0.2 * DEGREE, 0.1 * DEGREE * looser)


def random_slew(random: np.random.Generator, looser: float, *, angle: tuple[float, float] = (2, 150),
                rate: float = 0.6, acceleration: float = 0.0) -> SlewRequest:
    """A slew with the angle (deg) between the given ones, rates (deg/s) and accelerations (deg/s2) up to the given."""

    def direction() -> np.ndarray:
        v = random.normal(size=3)
        return v / np.linalg.norm(v)

    def end(q: np.ndarray) -> Boundary:
        return Boundary(q, direction() * random.uniform(0, rate) * DEGREE,
                        direction() * random.uniform(0, acceleration) * DEGREE)

    q = random.normal(size=4)
    q /= np.linalg.norm(q)
    turned = kin.product(q, kin.exponential(direction() * random.uniform(*angle) * DEGREE))
    return SlewRequest(limits(looser), end(q), end(turned))


def hard_slew(random: np.random.Generator, kind: str, looser: float) -> SlewRequest:
    """A slew of a hard kind: accelerations at both ends, opposite rates, half a turn, rest to rest, or a usual one."""
    if kind == "accelerations":
        return random_slew(random, looser, acceleration=0.15)
    if kind == "opposite rates":
        request = random_slew(random, looser, angle=(0, 1))
        rate = request.start.rate / np.linalg.norm(request.start.rate) * random.uniform(0.2, 0.6) * DEGREE
        still = np.zeros(3)
        return replace(request, start=Boundary(request.start.quaternion, rate, still),
                       stop=Boundary(request.stop.quaternion, -rate, still))
    if kind == "half a turn":
        return random_slew(random, looser, angle=(178, 180))
    if kind == "rest to rest":
        return random_slew(random, looser, rate=0.0)
    return random_slew(random, looser)


def reference(request: SlewRequest, count: int = 400) -> float:
    """Least duration on ``count`` even intervals from the polynomial law, both ways round; NaN if neither converges."""
    used, envelope = envelope_of(request)
    best = math.nan
    for long_way in (False, True):
        bound = lower_bound(request, used, long_way=long_way)
        if bound > best:
            continue
        start = _uniform_start(request, used, long_way, max(bound, 1e-3), count)
        if start is None:
            continue
        answer = _solve(request, used, envelope, long_way, *start, options={"ipopt.max_iter": 400})
        if answer.success and not answer.duration >= best:
            best = answer.duration
    return best


def percentiles(values: list[float]) -> dict[str, float]:
    """Median, 95th percentile, least and largest."""
    v = np.array(values)
    return {"median": float(np.median(v)), "p95": float(np.percentile(v, 95)), "least": float(v.min()),
            "largest": float(v.max())}


def random_study(count: int, solver: str = "ipopt") -> dict[str, Any]:
    """Solve ``count`` random slews, half of them with the jerk limit four times looser."""
    random = np.random.default_rng(20250621)
    wall, own, excess, attitude, over5, failures, replans, warm = [], [], [], [], [], [], [], []
    load = [os.getloadavg()[0]]
    for i in range(count):
        request = replace(random_slew(random, 4.0 if i % 2 else 1.0), solver=solver)
        t0, w0 = time.process_time(), time.perf_counter()
        try:
            optimum = optimal_slew(request)
        except InfeasibleError as error:
            failures.append(f"{i}: {error}")
            continue
        own.append(time.process_time() - t0)
        wall.append(time.perf_counter() - w0)
        v = verify(optimum.profile, request)
        excess.append(max(v.rate / request.limits.rate, v.acceleration / request.limits.acceleration,
                          v.jerk / request.limits.jerk) - 1)
        attitude.append(math.degrees(v.terminal_error) * 3600)
        if i % 20 == 0:
            law = rodrigues_slew(request, 5, request.limits, lower_bound(request, request.limits), accurate=False)
            if law is not None:
                over5.append(law.duration / optimum.duration - 1)
            nudge = kin.exponential(random.normal(size=3) * 0.05 * DEGREE)
            near = replace(request, stop=replace(request.stop, quaternion=kin.product(request.stop.quaternion, nudge)))
            t0 = time.process_time()
            optimal_slew(near)
            t1 = time.process_time()
            optimal_slew(near, near=optimum)
            warm.append(time.process_time() - t1)
            replans.append(warm[-1] / (t1 - t0))
    load.append(os.getloadavg()[0])
    return {"count": count, "load_average_of_the_machine": load, "processors": os.cpu_count(),
            "solver": solver, "solved": len(own), "failures": failures, "process_s": percentiles(own),
            "wall_s": percentiles(wall), "largest_excess": float(max(excess)),
            "largest_terminal_error_arcsec": float(max(attitude)),
            "mrp5_over_optimum": percentiles(over5), "replan_over_cold": percentiles(replans),
            "replan_process_s": percentiles(warm)}


def reference_study(count: int) -> list[dict[str, Any]]:
    """Durations against 400 even intervals, and against the S-curve from rest to rest."""
    random = np.random.default_rng(7)
    kinds = ("usual", "accelerations", "opposite rates", "half a turn", "rest to rest")
    rows = []
    for i in range(count):
        kind, looser = kinds[i % len(kinds)], 4.0 if (i // len(kinds)) % 2 else 1.0
        request = hard_slew(random, kind, looser)
        optimum = optimal_slew(request)
        row: dict[str, Any] = {"kind": kind, "looser": looser, "duration_s": optimum.duration,
                               "angle_deg": float(np.degrees(np.linalg.norm(turn(request)))),
                               "over_reference": optimum.duration / reference(request) - 1}
        if is_rest_to_rest(request):
            row["over_s_curve"] = optimum.duration / s_curve_duration(math.radians(row["angle_deg"]),
                                                                      request.limits) - 1
        rows.append(row)
        print(f"{kind:16s} x{looser:.0f} {row['angle_deg']:7.2f} deg  T {optimum.duration:9.4f} s  over the reference "
              f"{row['over_reference']:+.2e}" + (f"  over the S-curve {row['over_s_curve']:+.2e}"
                                                 if "over_s_curve" in row else ""), flush=True)
    return rows


def scan_to_scan_study(count: int) -> dict[str, Any]:
    """The optimum against the polynomials on slews between scans: a few degrees, pitch rates of about 1 deg/s."""
    random = np.random.default_rng(3)
    ratios: dict[int, list[float]] = {5: [], 7: []}
    for _ in range(count):
        request = random_slew(random, 1.0, angle=(4, 30), rate=0.0)
        forward, back = np.array([0.0, 0.0, 0.06]) * DEGREE, np.array([0.0, 0.0, -1.0]) * DEGREE
        first, last = (forward, back) if random.random() < 0.5 else (back, forward)
        request = replace(request, start=replace(request.start, rate=first), stop=replace(request.stop, rate=last))
        optimum = optimal_slew(request)
        for degree, found in ratios.items():
            law = rodrigues_slew(request, degree, request.limits, lower_bound(request, request.limits))
            if law is not None:
                found.append(1 - optimum.duration / law.duration)
    return {f"shorter_than_mrp{d}": percentiles(v) | {"compared": len(v)} for d, v in ratios.items()}


def usage(motion: kin.Motion, of: Limits) -> dict[str, Any]:
    """Which limit a law comes nearest to, and the share of its samples at 99 % or more of any limit."""
    used = {"rate": kin.norm(motion.rate) / of.rate, "acceleration": kin.norm(motion.acceleration) / of.acceleration,
            "jerk": kin.norm(motion.jerk) / of.jerk}
    return {"binding": max(used, key=lambda name: float(np.max(used[name]))),
            "share_at_a_limit": float(np.mean(np.max(np.array(list(used.values())), axis=0) > 0.99))}


def closed_form_study() -> list[dict[str, Any]]:
    """Every closed form and the optimum on the same requests, with what tells them apart.

    The share of the time spent at a limit is the number: the quickest slew is at one of its limits all the time. From
    rest to rest the duration of a polynomial about the eigenaxis also follows from the peaks of its derivatives.
    """
    still, z = np.zeros(3), np.array([0.0, 0.0, 1.0])
    axis = np.array([2.0, -1.0, 2.0]) / 3

    def request(degrees: float, first: float = 0.0, last: float = 0.0, looser: float = 1.0) -> SlewRequest:
        return SlewRequest(limits(looser), Boundary(np.array([1.0, 0, 0, 0]), first * DEGREE * z, still),
                           Boundary(kin.exponential(degrees * DEGREE * axis), last * DEGREE * z, still))

    cases = {"rest to rest, 6 deg": request(6), "rest to rest, 30 deg": request(30),
             "rest to rest, 120 deg": request(120), "rest to rest, 120 deg, jerk x4": request(120, looser=4.0),
             "forward to reverse scan, 6 deg, 0.06 to -1 deg/s": request(6, 0.06, -1.0),
             "reverse to forward scan, 12 deg, -1 to 0.06 deg/s": request(12, -1.0, 0.06),
             "moving ends, 90 deg, 0.6 and -0.6 deg/s": request(90, 0.6, -0.6),
             "half a turn, 179 deg, 0.3 deg/s": request(179, 0.3, 0.3)}
    rows = []
    for name, asked in cases.items():
        answer = solve_slew(asked)
        assert answer.optimum is not None
        grid = np.linspace(0, 1, 4001)[1:-1]
        row: dict[str, Any] = {"case": name, "optimum_s": answer.duration, "lower_bound_s": answer.lower_bound,
                               "optimum": usage(answer.motion(grid * answer.duration), asked.limits), "laws": {}}
        print(f"{name}: optimum {answer.duration:.3f} s, at a limit {row['optimum']['share_at_a_limit']:.0%}")
        for law_name, law in answer.closed_forms.items():
            if law is None:
                continue
            found = usage(law.motion(grid * law.duration), asked.limits)
            row["laws"][law_name] = {"duration_s": law.duration, "over_optimum": law.duration / answer.duration - 1,
                                     **found}
            print(f"   {law_name:12s} {law.duration:9.3f} s  {law.duration / answer.duration - 1:+8.2%}  binding "
                  f"{found['binding']:12s} at a limit {found['share_at_a_limit']:.0%}", flush=True)
        rows.append(row)
    return rows


def rockit_seconds(request: SlewRequest, intervals: int) -> tuple[float, float]:
    """Solve time and duration of the same problem in rockit (multiple shooting, Runge-Kutta, IPOPT, expanded)."""
    import casadi as ca
    import rockit

    law = rodrigues_slew(request, 7, request.limits, lower_bound(request, request.limits), accurate=False)
    assert law is not None
    unit = 20.0  # s
    ocp = rockit.Ocp(T=rockit.FreeTime(law.duration / unit))
    q, w, a, j = ocp.state(4), ocp.state(3), ocp.state(3), ocp.control(3)
    omega = ca.vertcat(0, w)
    product = ca.vertcat(-ca.dot(q[1:], omega[1:]), q[0] * omega[1:] + ca.cross(q[1:], omega[1:]))
    ocp.set_der(q, product / 2)
    ocp.set_der(w, a)
    ocp.set_der(a, j)
    s, e, lim = request.start, request.stop, request.limits
    ocp.subject_to(ocp.at_t0(q) == s.quaternion)
    for state, first, last, power in ((w, s.rate, e.rate, 1), (a, s.acceleration, e.acceleration, 2)):
        ocp.subject_to(ocp.at_t0(state) == first * unit**power)
        ocp.subject_to(ocp.at_tf(state) == last * unit**power)
    m = law.motion(np.linspace(0, law.duration, intervals + 1))
    attitudes = kin.sign_continuous(m.quaternion)
    final = ocp.at_tf(q)
    target = attitudes[-1]
    error = ca.vertcat(target[0] * final[1:] - final[0] * target[1:] - ca.cross(target[1:], final[1:]))
    ocp.subject_to(error == 0)
    ocp.subject_to(ca.sumsqr(w) / (lim.rate * unit) ** 2 <= 1)
    ocp.subject_to(ca.sumsqr(a) / (lim.acceleration * unit**2) ** 2 <= 1)
    ocp.subject_to(ca.sumsqr(j) / (lim.jerk * unit**3) ** 2 <= 1, include_last=False)
    ocp.add_objective(ocp.T)
    ocp.set_initial(q, attitudes.T)
    ocp.set_initial(w, m.rate.T * unit)
    ocp.set_initial(a, m.acceleration.T * unit**2)
    ocp.solver("ipopt", {"expand": True, "print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"})
    ocp.method(rockit.MultipleShooting(N=intervals, intg="rk"))
    ocp._transcribe()
    begun = time.process_time()
    solution = ocp.solve()
    seconds = time.process_time() - begun
    return seconds, float(solution.value(ocp.T)) * unit


def dymos_seconds(request: SlewRequest, segments: int) -> tuple[float, float]:
    """Solve time and duration of the same problem in dymos (Radau, degree 3, SciPy SLSQP), from the polynomial law."""
    import dymos as dm
    import openmdao.api as om

    lim = request.limits
    law = rodrigues_slew(request, 7, lim, lower_bound(request, lim), accurate=False)
    assert law is not None

    class Body(om.ExplicitComponent):
        """Kinematics of the slew at many nodes."""

        def initialize(self) -> None:
            self.options.declare("num_nodes", types=int)

        def setup(self) -> None:
            n = self.options["num_nodes"]
            for name, width in (("q", 4), ("w", 3), ("a", 3), ("j", 3)):
                self.add_input(name, shape=(n, width))
            self.add_output("qdot", shape=(n, 4))
            for name in ("w2", "a2", "j2"):
                self.add_output(name, shape=(n,))
            self.declare_partials("*", "*", method="cs")
            self.declare_coloring(wrt="*", method="cs", show_summary=False, show_sparsity=False)

        def compute(self, inputs: Any, outputs: Any) -> None:
            q, w = inputs["q"], inputs["w"]
            outputs["qdot"] = 0.5 * np.concatenate(
                [-np.sum(q[:, 1:] * w, axis=1, keepdims=True), q[:, :1] * w + np.cross(q[:, 1:], w)], axis=1)
            for name, source, limit in (("w2", w, lim.rate), ("a2", inputs["a"], lim.acceleration),
                                        ("j2", inputs["j"], lim.jerk)):
                outputs[name] = np.sum(source * source, axis=1) / limit**2

    problem = om.Problem(reports=False)
    problem.driver = om.ScipyOptimizeDriver(optimizer="SLSQP", maxiter=150, tol=1e-6, disp=False)
    problem.driver.declare_coloring(show_summary=False, show_sparsity=False)
    phase = dm.Phase(ode_class=Body, transcription=dm.Radau(num_segments=segments, order=3))
    trajectory = problem.model.add_subsystem("trajectory", dm.Trajectory())
    trajectory.add_phase("phase", phase)
    phase.set_time_options(fix_initial=True, duration_bounds=(1, 300), duration_ref=20)
    phase.add_state("q", fix_initial=True, rate_source="qdot", targets=["q"], shape=(4,))
    phase.add_state("w", fix_initial=True, fix_final=True, rate_source="a", targets=["w"], shape=(3,), ref=lim.rate)
    phase.add_state("a", fix_initial=True, fix_final=True, rate_source="j", targets=["a"], shape=(3,),
                    ref=lim.acceleration)
    phase.add_control("j", targets=["j"], shape=(3,), ref=lim.jerk)
    m = law.motion(np.array([0.0, law.duration]))
    attitudes = kin.sign_continuous(law.motion(np.linspace(0, law.duration, 200)).quaternion)
    phase.add_boundary_constraint("q", loc="final", indices=[1, 2, 3], equals=attitudes[-1, 1:])
    for name in ("w2", "a2", "j2"):
        phase.add_path_constraint(name, upper=1.0)
    phase.add_objective("time", loc="final", ref=20)
    problem.setup()
    phase.set_time_val(0.0, law.duration)
    grid = np.linspace(0, law.duration, 200)
    m = law.motion(grid)
    for name, values in (("q", attitudes), ("w", m.rate), ("a", m.acceleration)):
        phase.set_state_val(name, values, time_vals=grid)
    phase.set_control_val("j", m.jerk, time_vals=grid)
    problem.run_model()
    begun = time.process_time()
    dm.run_problem(problem, run_driver=True, simulate=False, make_plots=False)
    seconds = time.process_time() - begun
    if not problem.driver.result.success:
        raise RuntimeError(f"SLSQP did not converge in {seconds:.2f} s")
    return seconds, float(problem.get_val("trajectory.phase.timeseries.time")[-1, 0])


def rival_study(count: int) -> dict[str, Any]:
    """The same slews in rockit and dymos where they are installed, in the same process, one right after the other."""
    random = np.random.default_rng(11)
    requests = [random_slew(random, 1.0) for _ in range(count)]
    for request in requests:  # makes the solvers of every mesh
        optimal_slew(request)
    result: dict[str, Any] = {"slews": count}
    for name, solve, size, most in (("rockit", rockit_seconds, 60, count), ("dymos", dymos_seconds, 10, min(count, 5))):
        try:
            __import__(name)
        except ImportError:
            result[name] = "not installed"
            continue
        own, rival, ratios, durations, failed = [], [], [], [], []
        for request in requests[:most]:
            begun = time.process_time()
            optimum = optimal_slew(request)
            seconds = time.process_time() - begun
            try:
                rival_seconds, rival_duration = solve(request, size)
            except Exception as error:
                failed.append(f"{type(error).__name__}: {error}"[:200])
                continue
            own.append(seconds)
            rival.append(rival_seconds)
            ratios.append(rival_seconds / seconds)
            durations.append(rival_duration / optimum.duration)
        result[name] = {"intervals": size, "asked": most, "compared": len(own), "failed": failed}
        if own:
            result[name] |= {"own_s": percentiles(own), "rival_s": percentiles(rival),
                             "time_over_own": percentiles(ratios), "duration_over_own": percentiles(durations)}
    return result


def main() -> None:
    """Run the studies that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--reference", type=int, default=50)
    parser.add_argument("--scans", type=int, default=20)
    parser.add_argument("--rivals", type=int, default=10)
    parser.add_argument("--laws", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument("--solver", default="ipopt")
    parser.add_argument("--out", type=Path, default=None)
    arguments = parser.parse_args()
    prepare()
    result: dict[str, Any] = {}
    if arguments.count:
        result["random"] = random_study(arguments.count, arguments.solver)
        print(json.dumps(result["random"], indent=1), flush=True)
    if arguments.scans:
        result["scan_to_scan"] = scan_to_scan_study(arguments.scans)
        print(json.dumps(result["scan_to_scan"], indent=1), flush=True)
    if arguments.reference:
        result["reference"] = reference_study(arguments.reference)
        over = [r["over_reference"] for r in result["reference"] if math.isfinite(r["over_reference"])]
        print("over the reference:", json.dumps(percentiles(over)), "compared", len(over), flush=True)
    if arguments.rivals:
        result["rivals"] = rival_study(arguments.rivals)
        print(json.dumps(result["rivals"], indent=1), flush=True)
    if arguments.laws:
        result["closed_forms"] = closed_form_study()
    if arguments.out:
        if arguments.out.exists():  # studies that were not asked for this time stay
            result = json.loads(arguments.out.read_text()) | result
        arguments.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
