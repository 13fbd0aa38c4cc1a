"""How often ``boresight explain`` is right: hidden effects of known size on campaigns of our own simulator.

    python -m benchmarks.explain_study [--out FILE.jsonl] [--workers 2] [--kinds quiet,one,two,outside] [--seeds 10]
                                       [--sizes 3,5,8,15] [--quiet 300] [--two 100] [--outside 60] [--rivals 3]
    python -m benchmarks.explain_study --report [--out FILE.jsonl] [--page docs/explain_study.md]

Every case is one compact campaign (all channels, about an hour) with its own orbit, mounting, inertia, attitudes and
noise. The size of a hidden effect is stated in sigma: the root of the sum of squares that its signature has on the
samples of the fit, calibration unknowns projected out, which is the non-centrality of its score. Effects whose size
physics fixes are made as visible as asked for by scaling the noise of all sensors. Cases go to a file of JSON lines as
they come, so that an interrupted study goes on where it stopped; ``--report`` makes the tables, the confusion matrix
and ``benchmarks/results/explain_study.json``.

Rivals on the same campaigns: plain modification indices with the nominal chi-square, sparse regression (PySINDy's
STLSQ) on the residuals, and a Gaussian process on the residuals.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
import traceback
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results"
PRESET = "compact"
NOMINAL_LEVEL = 0.01  # of the modification indices, without the search
TESTED = (
    "actuator-axis-nonorthogonality", "actuator-lag", "aerodynamic-torque", "antenna-thermal-deformation",
    "beam-mispointing:1", "carrier-frequency-offset", "constant-body-torque", "doppler-bias",
    "doppler-timetag-offset", "earth-rotation-offset", "flexible-appendage", "gnss-lever-arm", "gnss-timetag-offset",
    "gravity-gradient-torque", "internal-momentum", "pointing-offset-per-session", "propellant-slosh",
    "residual-magnetic-dipole", "second-order-doppler", "solar-radiation-torque", "stellar-aberration",
    "torque-scale-error", "tracker-frame-jump", "tracker-low-frequency-error", "tracker-timetag-offset",
    "viscous-damping",
)
"""Every effect of the library, one instance of those that have several."""
STRANGERS = ("doppler-drift", "body-fixed-lorentz", "tracker-periodic", "range-gate-step", "wheel-kick")
"""Effects that no library holds, declared below."""


@dataclass(frozen=True)
class Case:
    """One campaign of the study."""

    kind: str
    seed: int
    effects: tuple[str, ...] = ()
    size: float = 0.0

    @property
    def key(self) -> str:
        """Names the case in the file of results."""
        return f"{self.kind}|{'+'.join(self.effects)}|{self.size:g}|{self.seed}"


# ---------------------------------------------------------------------------------------------------- cases


def cases(arguments: argparse.Namespace) -> list[Case]:
    """Every case asked for, shuffled by a fixed seed so that a part of the study is a fair sample of it."""
    kinds = set(arguments.kinds.split(","))
    sizes = [float(s) for s in arguments.sizes.split(",")]
    names = [n for n in (arguments.effects.split(",") if arguments.effects else TESTED) if n]
    result: list[Case] = []
    if "quiet" in kinds:
        result += [Case("quiet", 10_000 + k) for k in range(arguments.quiet)]
    if "one" in kinds:
        result += [Case("one", 20_000 + 97 * i + k, (name,), size)
                   for i, name in enumerate(names) for size in sizes for k in range(arguments.seeds)]
    draw = np.random.default_rng(11)
    pairs = []
    while len(pairs) < arguments.two:
        a, b = draw.choice(len(TESTED), 2, replace=False)
        pairs.append((TESTED[a], TESTED[b]))
    if "two" in kinds:
        result += [Case("two", 50_000 + k, pair, 12.0) for k, pair in enumerate(pairs)]
    if "outside" in kinds:
        outside = [*STRANGERS, *("-" + n for n in TESTED if n not in _COPIED)]
        result += [Case("outside", 60_000 + k, (outside[k % len(outside)],), 15.0) for k in range(arguments.outside)]
    order = np.random.default_rng(5).permutation(len(result))
    return [result[i] for i in order]


_COPIED = ("gnss-timetag-offset", "earth-rotation-offset", "doppler-timetag-offset", "stellar-aberration",
           "second-order-doppler", "carrier-frequency-offset", "tracker-timetag-offset", "flexible-appendage",
           "propellant-slosh")
"""Effects that others of the library copy closely: taken out, their place is rightly filled by a name."""


def strangers(layout: Any) -> dict[str, Any]:
    """Declarations of effects that no library holds, for a campaign of this layout."""
    import casadi as ca

    from estimator.effects.declaration import EffectInstance, Parameter
    from estimator.models.rotations import rotate

    def parameter(name: str, unit: str, scale: float) -> Any:
        return Parameter(name, unit, scale, (-1e3 * scale, 1e3 * scale))

    def drift(sample: Any, p: Any) -> Any:
        # A sawtooth of the receiver's oscillator, 11 s long, another phase on each beam.
        beams = sample.beam_direction.shape[0]
        return ca.vertcat(*(p[0] * ca.sin(2 * ca.pi * (sample.time / 11.0 + b / beams)) for b in range(beams)))

    def step(sample: Any, p: Any) -> Any:
        # The shift jumps for a third of each half minute on the last beam alone.
        beams = sample.beam_direction.shape[0]
        on = ca.fmod(sample.time, 30.0) < 10.0
        return ca.vertcat(*(p[0] * on if b == beams - 1 else 0 for b in range(beams)))

    def lorentz(sample: Any, p: Any) -> Any:
        field = rotate(sample.attitude, sample.magnetic_field)
        return p[0] * ca.vertcat(field[1] * field[2], field[0] * field[2], field[0] * field[1]) * 1e9

    def kick(sample: Any, p: Any) -> Any:
        # A torque about z that comes and goes every 37 s.
        return ca.vertcat(0, 0, p[0] * ca.sin(2 * ca.pi * sample.time / 37.0))

    def periodic(sample: Any, p: Any) -> Any:
        angle = 2 * ca.pi * sample.time / 23.0
        return p[0] * ca.vertcat(ca.sin(angle), ca.cos(angle), 0)

    def made(name: str, channel: Any, p: Any, function: Any) -> Any:
        return EffectInstance(name, name, channel, (p,), function, zero="size = 0", reference="none")

    return {
        "doppler-drift": made("doppler-drift", "doppler", parameter("size", "Hz", 1.0), drift),
        "range-gate-step": made("range-gate-step", "doppler", parameter("size", "Hz", 1.0), step),
        "body-fixed-lorentz": made("body-fixed-lorentz", "torque", parameter("size", "N m", 1e-4), lorentz),
        "wheel-kick": made("wheel-kick", "torque", parameter("size", "N m", 1e-4), kick),
        "tracker-periodic": made("tracker-periodic", "star_tracker", parameter("size", "rad", 1e-4), periodic),
    }


# ---------------------------------------------------------------------------------------------------- sizes


def direction(effect: Any, draw: np.random.Generator) -> np.ndarray:
    """Parameters of a random physical shape, of typical size; ordinary ones are scaled later, searched ones are not."""
    values = np.zeros(len(effect.parameters))
    for i, p in enumerate(effect.parameters):
        if p.search is not None:
            share = draw.uniform(0.1, 0.9)
            low, high, _, spacing, _ = p.search  # of a frequency every octave is as likely
            even = spacing in ("linear", "listed")
            values[i] = low + (high - low) * share if even else low * (high / low) ** share
        elif p.nominal is not None:
            values[i] = p.nominal
        else:
            values[i] = p.scale * draw.standard_normal()
            if p.plausible[0] >= 0:
                values[i] = abs(values[i])
    names = [p.name for p in effect.parameters]
    if "coupling_xx" in names:  # K = d d' of one coupling vector
        d = draw.standard_normal(3)
        matrix = np.outer(d, d)
        for i, name in enumerate(names):
            if name.startswith("coupling_"):
                a, b = ("xyz".index(c) for c in name[-2:])
                values[i] = effect.parameters[i].scale * matrix[a, b]
    if "damping_ratio" in names:
        values[names.index("damping_ratio")] = effect.parameters[names.index("damping_ratio")].scale
    return values


def strength(subject: Any, name: str, values: np.ndarray, instance: Any = None) -> float:
    """Sigma of an effect of these values on the samples of the fit, calibration unknowns projected out."""
    problem = subject.problem((), (name,), hold_out=True) if instance is None else \
        _with_stranger(subject, instance)
    unknown = problem.unknown(name)
    effect = instance or next(e for e in subject.library if e.name == name)
    searched = np.array([p.search is not None for p in effect.parameters])
    point = {**problem.start, name: np.where(searched, values, 0.0)}
    problem = problem.prepared(point)
    free = list(problem.free)
    rows, signature = [], []
    step = np.where(searched, 0.0, values)
    for part in problem.linearize(point):
        root = np.sqrt(part.weight)
        blocks, start = {}, 0
        for u in part.columns:
            w = u.manifold.tangent
            blocks[u.name] = (part.jacobian[:, :, start : start + w] * root[:, None, None]).reshape(-1, w)
            start += w
        size = part.whitened.size
        rows.append(np.concatenate([blocks[u.name] * u.scales if u.name in blocks
                                    else np.zeros((size, u.manifold.tangent)) for u in free], axis=1))
        signature.append(blocks[name] @ step if name in blocks else np.zeros(size))
    assert unknown.name == name
    jacobian, column = np.concatenate(rows), np.concatenate(signature)
    gram = jacobian.T @ jacobian
    right = jacobian.T @ column
    eigenvalues, vectors = np.linalg.eigh(gram)
    kept = eigenvalues > 1e-12 * eigenvalues[-1]
    inner = vectors[:, kept].T @ right
    return float(np.sqrt(max(column @ column - inner @ (inner / eigenvalues[kept]), 0.0)))


@contextmanager
def _registered(instance: Any) -> Iterator[None]:
    """The library with a declaration that it does not hold, for the time of the context."""
    from estimator.effects import declaration

    declaration._REGISTRY[instance.name] = declaration.Effect(instance.name, instance.channel, "",
                                                              lambda layout: (instance,))
    try:
        yield
    finally:
        del declaration._REGISTRY[instance.name]


def _with_stranger(subject: Any, instance: Any) -> Any:
    """The problem with a declaration that the registry does not hold, put there for one call."""
    with _registered(instance):
        return subject.problem((), (instance.name,), hold_out=True)


def campaign_of(case: Case) -> tuple[Any, dict[str, Any]] | None:
    """The campaign of a case and what is true in it; None where no plausible size is as visible as asked for."""
    from problems.alignment.investigation import AlignmentSubject
    from problems.alignment.simulator import preset, simulate

    scenario = preset(PRESET)
    draw = np.random.default_rng([case.seed, 77])
    plain, _ = simulate(scenario, case.seed)
    if not case.effects:
        return plain, {}
    subject = AlignmentSubject(plain)
    chosen: dict[Any, np.ndarray] = {}
    noise = 1.0
    told: dict[str, Any] = {}
    for raw in case.effects:
        name = raw.lstrip("-")
        stranger = strangers(subject.everything.layout).get(name)
        effect = stranger or next(e for e in subject.library if e.name == name)
        values = direction(effect, draw)
        sigma = strength(subject, name, values, stranger)
        if not np.isfinite(sigma) or sigma <= 0:
            return None
        factor = case.size / sigma
        fixed = any(p.nominal is not None for p in effect.parameters)
        if fixed:
            noise = max(noise, 1.0 / factor) if len(case.effects) > 1 else 1.0 / factor
        else:
            ordinary = np.array([p.search is None for p in effect.parameters])
            values = np.where(ordinary, values * factor, values)
            if any(not p.plausible[0] <= v <= p.plausible[1]
                   for p, v in zip(effect.parameters, values, strict=True)):
                return None
        told[name] = values.tolist()
        chosen[stranger or name] = values
    if noise != 1.0 and not 1 / 20 < noise < 20:
        return None
    if noise != 1.0:
        for key, values in chosen.items():  # keep the others as visible as asked for
            effect = key if not isinstance(key, str) else next(e for e in subject.library if e.name == key)
            if all(p.nominal is None for p in effect.parameters):
                ordinary = np.array([p.search is None for p in effect.parameters])
                chosen[key] = np.where(ordinary, values * noise, values)
                told[effect.name] = chosen[key].tolist()
                if any(not p.plausible[0] <= v <= p.plausible[1]
                       for p, v in zip(effect.parameters, chosen[key], strict=True)):
                    return None
        scenario = replace(scenario, gnss_noise=scenario.gnss_noise * noise,
                           doppler_noise=scenario.doppler_noise * noise,
                           star_tracker_noise=tuple(s * noise for s in scenario.star_tracker_noise))
    campaign, _ = simulate(scenario, case.seed, {k: list(v) for k, v in chosen.items()})
    return campaign, told


# ---------------------------------------------------------------------------------------------------- one case


def run(case: Case, rivals: bool) -> dict[str, Any]:
    """Do one case; an error is a result too."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    began, cpu = time.perf_counter(), time.process_time()
    result: dict[str, Any] = {"key": case.key, **asdict(case)}
    try:
        from estimator.discrepancy.search import Workflow
        from problems.alignment.investigation import AlignmentSubject

        made = campaign_of(case)
        if made is None:
            return {**result, "verdict": "not visible"}
        campaign, truth = made
        without = tuple(n[1:].split(":")[0] for n in case.effects if n.startswith("-"))
        workflow = Workflow(AlignmentSubject(campaign, 0.2, without))
        findings = workflow.run()
        result |= {
            "truth": truth, "verdict": findings.verdict, "why": findings.why,
            "found": [{"name": f.name, "group": list(f.group), "score": f.score, "p": f.p_value_after_search,
                       "held_out": _ratio(f.held_out_before, f.held_out_after)} for f in findings.findings],
            "rejected": list(findings.rejected), "looks": findings.looks,
            "table": [{"name": s.name, "score": round(s.score, 2), "degrees": s.degrees, "p": s.p_value,
                       "evidence": round(s.evidence, 2)} for s in findings.tables[0][:5]],
            "truth_scores": {n: round(s.score, 2) for n in truth for s in findings.tables[0] if s.name == n},
            "gap_p": findings.before.p_value, "gap_after_p": findings.after.p_value,
        }
        result["truth_ahead"] = _ahead(workflow, campaign, case, result)
        if case.kind == "one":
            result["apart"] = _apart(workflow, case, truth[case.effects[0]])
        result["cpu_seconds"] = time.process_time() - cpu
        if rivals:
            result["rivals"] = rival_answers(workflow)
    except Exception as error:
        result |= {"verdict": "error", "why": f"{type(error).__name__}: {error}",
                   "trace": traceback.format_exc()[-1500:]}
    result["seconds"] = time.perf_counter() - began
    result.setdefault("cpu_seconds", time.process_time() - cpu)
    return result


def _ahead(workflow: Any, campaign: Any, case: Case, result: dict[str, Any]) -> float | None:
    """By how much the true effects lower the sum of squares beyond what was named instead of them, on the same data.

    None where the answer is right, or where no name was given. A small number says that these data cannot tell what
    was named from the truth.
    """
    from estimator.discrepancy.search import Workflow
    from problems.alignment.investigation import AlignmentSubject

    if not case.effects or not result["found"] or (case.kind != "outside" and right(result)):
        return None
    named = workflow.fit([f["name"] for f in result["found"]]).cost
    names = [n.lstrip("-") for n in case.effects]
    subject = AlignmentSubject(campaign, 0.2)
    stranger = strangers(subject.everything.layout).get(names[0])
    if stranger is None:
        return float(named - Workflow(subject).fit(names).cost)
    with _registered(stranger):
        subject.__dict__.pop("library", None)
        return float(named - Workflow(subject).fit(names).cost)


def _ratio(before: Any, after: Any) -> dict[str, list[float]]:
    return {c: [round(before[c].ratio, 4), round(after[c].ratio, 4)] for c in before if c in after}


def _apart(workflow: Any, case: Case, values: Sequence[float]) -> float | None:
    """Sigma of a true effect that its best copy by another name of the library leaves over; a property of the
    campaign, not of the answer. None where the library does not see the truth."""
    library = workflow.round(()).library
    name, size = case.effects[0], np.asarray(values, dtype=float)
    own = library.indices(name)
    if not own:
        return None
    effect = library.candidates[own[0]].effect
    searched = [k for k, p in enumerate(effect.parameters) if p.search is not None]
    range_of = np.array([p.search.high - p.search.low if p.search else 1.0 for p in effect.parameters])
    near = min(own, key=lambda i: float(np.sum(((library.candidates[i].setting - size) / range_of)[searched] ** 2)))
    copied = max((library.copied(near, size, i) for i, c in enumerate(library.candidates) if c.name != name), default=0)
    return float(case.size * np.sqrt(max(1.0 - copied, 0.0)))


# ---------------------------------------------------------------------------------------------------- rivals


def rival_answers(workflow: Any) -> dict[str, Any]:
    """What the three rivals say about the residuals of the plain fit, from the same signatures."""
    from estimator.discrepancy.score import signature

    here = workflow.round(())
    signatures: dict[str, list[np.ndarray]] = defaultdict(list)
    present = {u.name for u in here.problem.unknowns}
    for name, effect in workflow.library.items():
        if name in present and not any(p.search for p in effect.parameters):
            made = signature(here.stacked, here.problem, here.parts, effect, np.zeros(len(effect.parameters)))
            signatures[name].append(made.columns)
    from estimator.discrepancy.score import on_rows

    for made in workflow.searched_signatures():
        signatures[made.effect.name].append(on_rows(made, here.stacked).columns)
    return {"modification_indices": _modification_indices(here.stacked, signatures),
            "sparse_regression": _sparse_regression(here.stacked, signatures),
            "gaussian_process": _gaussian_process(workflow)}


def _modification_indices(stacked: Any, signatures: dict[str, list[np.ndarray]]) -> list[str]:
    """Free the parameter with the largest index while any passes the nominal test (one degree of freedom)."""
    from scipy.stats import chi2

    threshold = float(chi2.isf(NOMINAL_LEVEL, 1))
    columns = {n: np.concatenate([stacked.projected(c) for c in blocks], axis=1) for n, blocks in signatures.items()}
    raw = {n: np.concatenate([np.linalg.norm(c, axis=0) for c in blocks]) for n, blocks in signatures.items()}
    residual = stacked.residual - stacked.basis @ (stacked.basis.T @ stacked.residual)
    freed: list[str] = []
    while len(freed) < 6:
        best, winner, chosen = threshold, "", np.zeros(0)
        for name, block in columns.items():
            norms = np.linalg.norm(block, axis=0)
            good = norms > 1e-4 * np.maximum(raw[name], 1e-300)
            if name in freed or not good.any():
                continue
            index = (block[:, good].T @ residual) ** 2 / norms[good] ** 2
            if index.max() > best:
                best, winner, chosen = float(index.max()), name, block[:, good][:, int(np.argmax(index))]
        if not winner:
            break
        freed.append(winner)
        unit = chosen / np.linalg.norm(chosen)
        residual = residual - unit * (unit @ residual)
        columns = {n: block - np.outer(unit, unit @ block) for n, block in columns.items()}
    return freed


def _sparse_regression(stacked: Any, signatures: dict[str, list[np.ndarray]]) -> list[str]:
    """PySINDy's sequentially thresholded least squares of the residuals on all signatures, calibration kept fixed."""
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from pysindy.optimizers import STLSQ

        names, blocks = [], []
        for name, candidates in signatures.items():
            # One block per effect: of a searched effect the setting that fits the residuals best.
            fits = [float(np.sum((np.linalg.qr(c)[0].T @ stacked.residual) ** 2)) for c in candidates]
            block = candidates[int(np.argmax(fits))]
            norms = np.linalg.norm(block, axis=0)
            keep = norms > 0
            names += [name] * int(keep.sum())
            blocks.append(block[:, keep] / norms[keep])
        library = np.concatenate(blocks, axis=1)
        # Columns of unit length: a coefficient is in sigmas; the threshold is the level of one look.
        model = STLSQ(threshold=3.0, alpha=1e-3, max_iter=40)
        model.fit(library, -stacked.residual[:, None])
    found = np.flatnonzero(np.abs(np.asarray(model.coef_)).ravel() > 0)
    return list(dict.fromkeys(names[i] for i in found))


def _gaussian_process(workflow: Any) -> dict[str, float]:
    """Held-out miss over noise, per channel, before and after a Gaussian process on the residuals of each arc."""
    import warnings

    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    from estimator.residuals import KernelResidual

    estimate = workflow.fit(()).estimate
    sums: dict[str, np.ndarray] = defaultdict(lambda: np.zeros(3))
    for residual, part in zip(estimate.problem.residuals, estimate.parts, strict=True):
        if not isinstance(residual, KernelResidual) or residual.accepted is None:
            continue
        for label in range(len(residual.arc_names)):
            inside = residual.arc == label
            train, test = np.flatnonzero(inside & residual.accepted), np.flatnonzero(inside & ~residual.accepted)
            if len(train) < 10 or not len(test):
                continue
            thin = train[:: max(1, len(train) // 150)]
            length = float(np.ptp(residual.time[inside])) or 1.0
            for component in range(part.whitened.shape[1]):
                kernel = ConstantKernel(1.0) * RBF(0.3 * length, (0.02 * length, 10 * length)) + WhiteKernel(1.0)
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", ConvergenceWarning)
                    fitted = GaussianProcessRegressor(kernel, random_state=0).fit(
                        residual.time[thin, None], part.whitened[thin, component])
                left = part.whitened[test, component] - fitted.predict(residual.time[test, None])
                sums[residual.channel] += [float(np.sum(part.whitened[test, component] ** 2)), float(left @ left),
                                           len(test)]
    return {f"{c} {word}": float(np.sqrt(v[i] / v[2])) for c, v in sums.items()
            for i, word in enumerate(("before", "after"))}


# ---------------------------------------------------------------------------------------------------- the study


def results_of(path: Path) -> dict[str, dict[str, Any]]:
    """Cases done so far, by key; a line cut short by an interruption is left out."""
    done: dict[str, dict[str, Any]] = {}
    if path.exists():
        for line in path.read_text().splitlines():
            try:
                entry = json.loads(line)
            except json.JSONDecodeError:
                continue
            if entry["verdict"] != "error":
                done[entry["key"]] = entry
    return done


def study(arguments: argparse.Namespace) -> None:
    """Run what is not done yet, most at once as there are workers."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from problems.console import jsonable

    done = results_of(arguments.out)
    everything = cases(arguments)
    todo: Iterator[Case] = iter([c for c in everything if c.key not in done][: arguments.most])
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    console = Console(stderr=True)
    deadline = time.monotonic() + arguments.minutes * 60
    with Progress(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
                  console=console, disable=not console.is_terminal) as bar, \
            ProcessPoolExecutor(arguments.workers, mp_context=get_context("spawn"), max_tasks_per_child=40) as pool, \
            arguments.out.open("a") as file:
        task = bar.add_task("campaigns", total=len(everything), completed=len(done))
        running = set()
        while True:
            while len(running) < arguments.workers and time.monotonic() < deadline:
                case = next(todo, None)
                if case is None:
                    break
                running.add(pool.submit(run, case, arguments.rivals > 0 and case.seed % arguments.rivals == 0))
            if not running:
                break
            finished, running = wait(running, return_when=FIRST_COMPLETED)
            for future in finished:
                entry = future.result()
                file.write(json.dumps(jsonable(entry)) + "\n")
                file.flush()
                bar.advance(task)
                names = [f["name"] if len(f["group"]) == 1 else "|".join(f["group"]) for f in entry.get("found", [])]
                console.print(f"{entry['key']:<58} {entry['verdict']:<11} {', '.join(names)} "
                              f"({entry.get('cpu_seconds', 0):.0f} s)", highlight=False)


# ---------------------------------------------------------------------------------------------------- the tables


def upper_bound(count: int, total: int) -> float:
    """Upper 95 % bound of a probability of which ``count`` of ``total`` were seen (Clopper and Pearson, one side)."""
    from scipy.stats import beta

    return 1.0 if count >= total else float(beta.ppf(0.95, count + 1, total - count))


def right(entry: dict[str, Any]) -> bool:
    """Whether exactly the truth was found: each true effect in the group of one finding, and no other finding."""
    groups = [set(f["group"]) for f in entry["found"]]
    truths = list(entry["truth"])
    return len(groups) == len(truths) and all(any(t in g for g in groups) for t in truths) and \
        all(any(t in g for t in truths) for g in groups)


IDENTIFIABLE = 3.03
"""Sigma that the best copy of an effect by another name must leave over: half its square is a log odds of 100 to 1."""
LOOK_ALIKE = 20.0
"""Lead in the sum of squares (4.5 sigma) up to which data do not tell the truth from what was named instead."""


def _look_alike(entry: dict[str, Any]) -> bool:
    """Whether the truth explains the data no better than what was named instead of it."""
    ahead = entry.get("truth_ahead")
    return ahead is not None and ahead < LOOK_ALIKE


def summary(entries: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """The numbers of the study."""
    by_kind: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for e in entries:
        if e["verdict"] not in ("error", "not visible"):
            by_kind[e["kind"]].append(e)
    result: dict[str, Any] = {}
    quiet = by_kind["quiet"]
    if quiet:
        named = sum(bool(e["found"]) for e in quiet)
        any_alarm = sum(e["verdict"] != "quiet" for e in quiet)
        result["quiet"] = {"campaigns": len(quiet), "false_names": named, "rate": named / len(quiet),
                           "upper_95": upper_bound(named, len(quiet)), "not_quiet": any_alarm,
                           "not_quiet_upper_95": upper_bound(any_alarm, len(quiet))}
    one: dict[str, Any] = {}
    for size in sorted({e["size"] for e in by_kind["one"]}):
        chosen = [e for e in by_kind["one"] if e["size"] == size]
        hits = [e for e in chosen if right(e)]
        sizes = [len(f["group"]) for e in hits for f in e["found"]]
        clear = [e for e in hits if (e.get("apart") or 0.0) >= IDENTIFIABLE]
        alone = [len(f["group"]) for e in clear for f in e["found"]]
        wrong = [e for e in chosen if any(not set(f["group"]) & set(e["truth"]) for f in e["found"])]
        one[f"{size:g} sigma"] = {
            "campaigns": len(chosen), "right": len(hits) / len(chosen), "single_right":
                sum(all(len(f["group"]) == 1 for f in e["found"]) for e in hits) / len(chosen),
            "wrong_name": len(wrong) / len(chosen),
            "wrong_by_a_look_alike": sum(map(_look_alike, wrong)) / len(chosen),
            "nothing": sum(not e["found"] for e in chosen) / len(chosen),
            "median_group": float(np.median(sizes)) if sizes else None,
            "identifiable": sum((e.get("apart") or 0.0) >= IDENTIFIABLE for e in chosen),
            "median_group_identifiable": float(np.median(alone)) if alone else None,
            "by_effect": {n: _share([right(e) for e in chosen if e["effects"][0] == n])
                          for n in sorted({e["effects"][0] for e in chosen})},
        }
    result["one"] = one
    if two := by_kind["two"]:
        result["two"] = {"campaigns": len(two), "both_right": sum(right(e) for e in two) / len(two),
                         "wrong_by_a_look_alike": sum(map(_look_alike, two)) / len(two)}
    if outside := by_kind["outside"]:
        told = [e for e in outside if not _look_alike(e)]
        named = [e for e in told if e["verdict"] == "named"]
        result["outside"] = {"campaigns": len(outside), "copied_by_the_library": len(outside) - len(told),
                             "unknown": sum(e["verdict"] == "unknown" for e in told) / max(len(told), 1),
                             "wrong_single_name": len(named) / max(len(told), 1)}
    rivals: dict[str, Any] = {}
    for rival in ("modification_indices", "sparse_regression"):
        seen = [e for kind in ("quiet", "one") for e in by_kind[kind] if "rivals" in e]
        if not seen:
            continue
        nothing = [e for e in seen if e["kind"] == "quiet"]
        rivals[rival] = {"false_names": _share([bool(e["rivals"][rival]) for e in nothing])}
        for size in sorted({e["size"] for e in seen if e["kind"] == "one"}):
            chosen = [e for e in seen if e["kind"] == "one" and e["size"] == size]
            rivals[rival][f"right at {size:g} sigma"] = _share([e["rivals"][rival] == [*e["truth"]] for e in chosen])
            rivals[rival][f"first right at {size:g} sigma"] = _share(
                [e["rivals"][rival][:1] == [*e["truth"]] for e in chosen])
    process = [e["rivals"]["gaussian_process"] for e in by_kind["one"] if "rivals" in e]
    if process:
        channels = sorted({k.rsplit(" ", 1)[0] for p in process for k in p})
        rivals["gaussian_process"] = {"names": 0, **{
            f"{c} held-out {word}": float(np.mean([p[f"{c} {word}"] for p in process if f"{c} {word}" in p]))
            for c in channels for word in ("before", "after")}}
    result["rivals"] = rivals
    times = [e["cpu_seconds"] for kind in by_kind.values() for e in kind]
    if times:
        result["cpu_seconds"] = {"median": float(np.median(times)), "largest": float(np.max(times))}
    return result


def _share(flags: Sequence[bool]) -> dict[str, Any]:
    return {"count": int(sum(flags)), "of": len(flags)}


def confusion(entries: Iterable[dict[str, Any]], path: Path, size: float) -> None:
    """A picture: true effect against what was named, share of the campaigns at one size."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    chosen = [e for e in entries if e["kind"] in ("one", "quiet") and e["verdict"] not in ("error", "not visible")
              and (e["kind"] == "quiet" or e["size"] == size)]
    truths = [*sorted({e["effects"][0] for e in chosen if e["effects"]}), "(quiet)"]
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    totals: Counter[str] = Counter()
    for e in chosen:
        truth = e["effects"][0] if e["effects"] else "(quiet)"
        totals[truth] += 1
        if not e["found"]:
            counts[truth]["(unknown)" if e["verdict"] == "unknown" else "(quiet)"] += 1
        for f in e["found"]:
            names = [truth] if truth in f["group"] else f["group"][:1]
            counts[truth][names[0]] += 1
    columns = [*truths, "(unknown)"]
    columns += sorted({n for c in counts.values() for n in c} - set(columns))
    matrix = np.array([[counts[t][c] / max(totals[t], 1) for c in columns] for t in truths])
    figure, axes = plt.subplots(figsize=(0.34 * len(columns) + 4, 0.3 * len(truths) + 3.2))
    image = axes.imshow(matrix, cmap="Blues", vmin=0, vmax=1)
    axes.set_xticks(range(len(columns)), columns, rotation=90, fontsize=7)
    axes.set_yticks(range(len(truths)), [f"{t} ({totals[t]})" for t in truths], fontsize=7)
    for (i, j), value in np.ndenumerate(matrix):
        if value > 0.004:
            axes.text(j, i, f"{100 * value:.0f}", ha="center", va="center", fontsize=6,
                      color="white" if value > 0.5 else "black")
    axes.set_xlabel("named, alone or in a group with the truth, per cent of the campaigns")
    axes.set_ylabel("true (campaigns)")
    axes.set_title(f"Hidden effects of {size:g} sigma")
    figure.colorbar(image, shrink=0.6)
    figure.tight_layout()
    figure.savefig(path, dpi=140)
    plt.close(figure)


def _percent(value: float | None) -> str:
    return "" if value is None else f"{100 * value:.1f} %"


def page(result: dict[str, Any]) -> str:
    """The documentation page of the study, every number from ``result``."""
    lines = [
        "# How often `boresight explain` is right", "",
        "Written by `python -m benchmarks.explain_study --report`. Hidden effects of known size in compact campaigns",
        "(about an hour, all channels) of our own simulator, each with its own orbit, mounting, inertia, attitudes and",
        "noise. Sizes are in sigma: the root of the sum of squares that the effect's signature has on the samples of",
        "the fit, calibration unknowns projected out. The cases are drawn in random order from the whole plan, so a",
        "part of it is a fair sample. *Right*: the true name alone or in its group, and no other name. *Look-alike*:",
        "what was named explains the same data as well as the truth does (the truth lowers the sum of squares by less",
        f"than {LOOK_ALIKE:g} beyond it).", "",
        "| question | campaigns | answer |", "|---|---|---|"]

    def row(question: str, campaigns: object, answer: str) -> None:
        lines.append(f"| {question} | {campaigns} | {answer} |")

    if quiet := result.get("quiet"):
        row("nothing hidden: a name is given", quiet["campaigns"], f"{quiet['false_names']} times, "
            f"{_percent(quiet['rate'])}, upper 95 % bound {_percent(quiet['upper_95'])}")
        row("nothing hidden: anything but `quiet`", quiet["campaigns"], f"{quiet['not_quiet']} times, upper 95 % bound "
            f"{_percent(quiet['not_quiet_upper_95'])}")
    for size, one in result.get("one", {}).items():
        row(f"one effect of {size}: right", one["campaigns"], f"{_percent(one['right'])}; alone "
            f"{_percent(one['single_right'])}; median group {one['median_group'] or 0:g}")
        if one["identifiable"]:
            row(f"one effect of {size}: no other name copies it to below {IDENTIFIABLE:g} sigma", one["identifiable"],
                f"median group {one['median_group_identifiable'] or 0:g}")
        row(f"one effect of {size}: another name, of these look-alikes", one["campaigns"],
            f"{_percent(one['wrong_name'])}, {_percent(one['wrong_by_a_look_alike'])}")
        row(f"one effect of {size}: no name", one["campaigns"], _percent(one["nothing"]))
    if two := result.get("two"):
        row("two effects of 12 sigma: both right", two["campaigns"],
            f"{_percent(two['both_right'])}; a look-alike in the place of one {_percent(two['wrong_by_a_look_alike'])}")
    if outside := result.get("outside"):
        told = outside["campaigns"] - outside["copied_by_the_library"]
        row("15 sigma of what the library does not hold, and does not copy: `unknown`",
            f"{told} of {outside['campaigns']}",
            f"{_percent(outside['unknown'])}; a wrong single name {_percent(outside['wrong_single_name'])}")
    if times := result.get("cpu_seconds"):
        lines += ["", f"Processor time of a case: median {times['median']:.1f} s, largest {times['largest']:.0f} s."]
    if rivals := {k: v for k, v in result.get("rivals", {}).items() if v}:
        lines += ["", "Rivals on the same campaigns:", "", "| rival | measure | value |", "|---|---|---|"]
        for rival, values in rivals.items():
            for key, value in values.items():
                shown = f"{value['count']} of {value['of']}" if isinstance(value, dict) else f"{value:.3g}"
                lines.append(f"| {rival.replace('_', ' ')} | {key.replace('_', ' ')} | {shown} |")
    lines += ["", *(f"![Hidden effects of {size}: what was named](../benchmarks/results/explain_confusion_"
                    f"{size.replace(' ', '_')}.png)" for size in result.get("one", {}))]
    by_effect = {size: one["by_effect"] for size, one in result.get("one", {}).items()}
    if by_effect:
        sizes = list(by_effect)
        lines += ["", "Right by effect:", "", "| effect | " + " | ".join(sizes) + " |", "|---" * (len(sizes) + 1) + "|"]
        for name in sorted({n for b in by_effect.values() for n in b}):
            cells = [f"{b[name]['count']} of {b[name]['of']}" if name in b else "" for b in by_effect.values()]
            lines.append(f"| `{name}` | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def report(arguments: argparse.Namespace) -> None:
    """Tables to standard output, numbers and pictures to the results."""
    from estimator.models.files import written_atomically

    entries = list(results_of(arguments.out).values())
    result = summary(entries)
    result["not_visible"] = sorted({e["key"] for e in entries if e["verdict"] == "not visible"})
    target = arguments.results / "explain_study.json"
    arguments.results.mkdir(parents=True, exist_ok=True)
    with written_atomically(target) as temporary:
        temporary.write_text(json.dumps(result, indent=1) + "\n")
    if arguments.page:
        with written_atomically(arguments.page) as temporary:
            temporary.write_text(page(result))
    for size in sorted({e["size"] for e in entries if e["kind"] == "one"}):
        confusion(entries, arguments.results / f"explain_confusion_{size:g}_sigma.png", size)
    print(json.dumps({k: v for k, v in result.items() if k != "not_visible"}, indent=1))
    for e in entries:
        bad = (e["kind"] == "quiet" and e["verdict"] != "quiet") or \
            (e["kind"] in ("one", "two") and "found" in e and e["size"] >= 8 and not right(e)) or \
            (e["kind"] == "outside" and e["verdict"] != "unknown" and not _look_alike(e))
        if bad and e["verdict"] != "not visible":
            found = [f["group"] for f in e.get("found", [])]
            head = [(s["name"], s["score"], s["evidence"]) for s in e.get("table", [])[:3]]
            print(e["key"], e["verdict"], found, head)


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of the study."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=RESULTS / "explain_study.jsonl")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--kinds", default="quiet,one,two,outside")
    parser.add_argument("--effects", default="", help="only these, separated by commas")
    parser.add_argument("--sizes", default="3,5,8,15")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--quiet", type=int, default=300)
    parser.add_argument("--two", type=int, default=100)
    parser.add_argument("--outside", type=int, default=60)
    parser.add_argument("--most", type=int, default=None, help="stop after this many new campaigns")
    parser.add_argument("--minutes", type=float, default=1e6, help="start no campaign after this long")
    parser.add_argument("--rivals", type=int, default=0, help="show the rivals every so-manieth campaign; 0 for none")
    parser.add_argument("--report", action="store_true", help="tables and pictures of what is done")
    parser.add_argument("--page", type=Path, default=None, help="documentation page to write with the report")
    chosen = parser.parse_args(arguments)
    if not chosen.report:
        study(chosen)
    report(chosen)


if __name__ == "__main__":
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    sys.exit(main())
