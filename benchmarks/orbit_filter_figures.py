"""The book's figures 3.3 and 3.4: errors and posterior sigmas over a day, and a case of divergence.

Run ``python -m benchmarks.orbit_filter_figures``; writes ``docs/figures/orbit-3-3.png`` and ``orbit-3-4.png``. The step
is the book's 5 s, its orbit is read in radians with 0.4 as the argument of perigee.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import chi2

from estimator.solvers.recursive_filters import FilterRun, extended_filter, linear_filter
from problems.alignment.figures import BAND, GREY, INK, STYLE, save
from problems.geo_orbit.book import OUTPUTS, BookCase, BookSystem, Simulated, simulate

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FOLDER = Path(__file__).parents[1] / "docs" / "figures"
COLOURS = {"linear": "#b3261e", "extended": "#d9822b", "iterated": "#0b6e99"}
WORDS = {
    "linear": "linear about the stationary orbit",
    "extended": "extended",
    "iterated": "iterated extended",
}
PANELS = (
    ("a", "distance", 1e-3, "km"),
    ("b", "right ascension", 1e3, "mrad"),
    ("c", "declination", 1e3, "mrad"),
    ("d", "rate of distance", 1.0, "m/s"),
    ("e", "rate of right ascension", 1e6, "µrad/s"),
    ("f", "rate of declination", 1e6, "µrad/s"),
)
SEED = 3
SMOOTH = 121  # steps of 5 s: ten minutes
WINDOW = 720  # steps of 5 s: one hour


def runs_of(system: BookSystem, deviation: float) -> tuple[Simulated, dict[str, FilterRun]]:
    """One realization whose orbit starts ``deviation`` sigma away in every component, and three filters."""
    case = system.case
    simulated = simulate(system, 1, SEED, deviation=deviation, kind="exact")
    start, covariance, z = case.first_state, np.diag(case.prior**2), simulated.measurements
    nominal, matrices = system.stationary_motion()
    return simulated, {
        "linear": linear_filter(system, nominal, matrices, start, covariance, z),
        "extended": extended_filter(system, start, covariance, z),
        "iterated": extended_filter(system, start, covariance, z, iterations=4),
    }


def _lines(
    panel: Any, hours: np.ndarray, simulated: Simulated, runs: dict[str, FilterRun], i: int, factor: float
) -> None:
    """Error (root mean square over ten minutes) and posterior sigma of component ``i`` of each filter."""
    for name, run in runs.items():
        square = np.square(run.state[0, :, i] - simulated.truth[0, :, i])
        weight = np.convolve(np.ones(len(square)), np.ones(SMOOTH), "same")
        error = np.sqrt(np.convolve(square, np.ones(SMOOTH), "same") / weight) * factor
        error[0] = np.sqrt(square[0]) * factor
        panel.semilogy(hours, error, color=COLOURS[name], lw=1.0)
        panel.semilogy(hours, run.sigma[0, :, i] * factor, color=COLOURS[name], lw=1.6, ls=(0, (4, 2)))


def _handles(names: list[str]) -> list[Any]:
    from matplotlib.lines import Line2D

    found = []
    for name in names:
        found += [
            Line2D([], [], color=COLOURS[name], lw=1.2, label=f"error (rms of 10 min), {WORDS[name]}"),
            Line2D([], [], color=COLOURS[name], lw=1.6, ls=(0, (4, 2)), label=f"its own sigma, {WORDS[name]}"),
        ]
    return found


def figure_3_3() -> Figure:
    """Errors and posterior sigmas of the six components of motion over 24 h, one sigma, no burn."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    system = BookSystem(BookCase())
    simulated, runs = runs_of(system, 1.0)
    runs.pop("extended")
    hours = np.arange(system.steps + 1) * system.case.step / 3600.0
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(11.0, 6.6), layout="constrained")
        panels = figure.subplots(2, 3, sharex=True)
        for i, (panel, (letter, name, factor, unit)) in enumerate(zip(panels.ravel(), PANELS, strict=True)):
            _lines(panel, hours, simulated, runs, i, factor)
            panel.set_title(f"{letter}   {name}")
            panel.set_ylabel(f"error and sigma, {unit}")
            panel.set_xlim(0, 24)
            panel.set_xticks(range(0, 25, 4))
            panel.grid(True, which="major", color=BAND, lw=0.7)
            low = min(run.sigma[0, :, i].min() for run in runs.values()) * factor
            top = max(np.abs(run.state[0, :, i] - simulated.truth[0, :, i]).max() for run in runs.values()) * factor
            panel.set_ylim(low / 6, top * 2)
        for panel in panels[1]:
            panel.set_xlabel("time, h")
        figure.legend(handles=_handles(list(runs)), loc="outside lower center", ncols=2)
        figure.suptitle(
            "Figure 3.3: no burn, every component starts one sigma from its expectation, measurements every 5 s",
            x=0.01,
            ha="left",
        )
    return figure


def figure_3_4() -> Figure:
    """Right ascension in a case of divergence: three sigma, a burn with an error; and when the filter says so."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    case = BookCase(burn=(20000.0, 23600.0))
    system = BookSystem(case)
    simulated, runs = runs_of(system, 3.0)
    hours = np.arange(system.steps + 1) * case.step / 3600.0
    degrees = WINDOW * OUTPUTS
    limit = chi2.ppf(1 - 1e-6, degrees) / degrees
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.6, 6.6), layout="constrained")
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        for panel in (upper, lower):
            panel.axvspan(case.burn[0] / 3600, case.burn[1] / 3600, color=BAND, lw=0)
            panel.grid(True, which="major", color=BAND, lw=0.7)
        _lines(upper, hours, simulated, runs, 1, 1e3)
        upper.set_ylim(1e-3, 1e3)
        upper.set_ylabel("error and sigma, mrad")
        upper.set_title("right ascension")
        upper.annotate(
            "burn",
            (np.mean(case.burn) / 3600, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0, -12),
            textcoords="offset points",
            ha="center",
            color=GREY,
        )
        kilometres = case.radius * 1e-6
        right = upper.secondary_yaxis("right", functions=(lambda y: y * kilometres, lambda y: y / kilometres))
        right.set_ylabel("along the orbit, km")
        right.spines["right"].set_visible(True)
        for name, run in runs.items():
            total = np.concatenate([[0.0], np.cumsum(run.innovation_square[0])])
            mean = (total[WINDOW:] - total[:-WINDOW]) / degrees
            lower.semilogy(hours[WINDOW:], mean, color=COLOURS[name], lw=1.2)
        lower.axhline(limit, color=INK, lw=1.0)
        lower.annotate(
            "above this line the filter is said to diverge",
            (24, limit),
            xytext=(-4, -5),
            textcoords="offset points",
            ha="right",
            va="top",
            color=INK,
        )
        lower.set_ylabel("mean square")
        lower.set_title("innovations of the last hour, in the filter's own sigmas")
        lower.set_ylim(0.2, None)
        lower.set_xlabel("time, h")
        lower.set_xlim(0, 24)
        lower.set_xticks(range(0, 25, 2))
        figure.legend(handles=_handles(list(runs)), loc="outside lower center", ncols=3, fontsize=8)
        figure.suptitle(
            "Figure 3.4: divergence, every component starts three sigma from its expectation, burn with an error",
            x=0.01,
            ha="left",
        )
    return figure


def write_figures() -> list[Path]:
    """Write both figures and return their paths."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, figure in (("orbit-3-3", figure_3_3), ("orbit-3-4", figure_3_4)):
        paths.append(FOLDER / f"{name}.png")
        save(figure(), paths[-1])
    return paths


if __name__ == "__main__":
    for path in write_figures():
        print(path)
