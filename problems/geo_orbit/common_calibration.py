"""One calibration for all arcs of a kept satellite: delays, scale, clock and sunlight do not change at a manoeuvre.

Each arc has a state and manoeuvres of its own, and these are eliminated arc by arc: what is left of an arc's normal
equations is what it tells of the common numbers, and this is the knowledge that all other arcs are fitted with.
Gauss-Newton steps of one arc after another, each with what the others tell at their latest point, end at the joint
optimum.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from problems.geo_orbit.manoeuvres import Fit, Prior

_ROUNDS = 2


def told(fit: Fit, names: Sequence[str]) -> Prior:
    """What the data of a fit alone tell of some unknowns, all others being free, at first order about its point.

    Args:
        fit: its priors count where they concern other unknowns.
        names: unknowns; those that the fit does not have are passed over.
    """
    kept = tuple(u.name for u in fit.unknowns if u.name in names)
    common = np.zeros(fit.jacobian.shape[1], dtype=bool)
    for n in kept:
        common[fit.columns(n)] = True
    own = np.any(fit.prior[:, ~common] != 0.0, axis=1)
    order = np.concatenate([np.flatnonzero(~common), np.flatnonzero(common)])
    rows = np.vstack([fit.jacobian, fit.prior[own]])[:, order]
    right = np.concatenate([fit.residual, fit.off[own]])
    upper = np.asarray(np.linalg.qr(np.column_stack([rows, right]), mode="r"))
    k, width = int((~common).sum()), int(common.sum())
    root = upper[k : k + width, k : k + width] / fit.scales[common]
    now = np.concatenate([np.atleast_1d(fit.values[n]) for n in kept])
    # Directions that the arc tells nothing of have no mean: the nearest one will do.
    mean = now - np.linalg.lstsq(root, upper[k : k + width, -1], rcond=1e-12)[0]
    return Prior(kept, mean, root)


def fitted_together(fits: Sequence[Fit], names: Sequence[str],
                    fit_again: Callable[[int, Fit, Sequence[Prior]], Fit]) -> tuple[list[Fit], list[list[Prior]]]:
    """Fit arcs with common numbers.

    Args:
        fits: of the arcs, the one that tells most first.
        names: of the common unknowns.
        fit_again: fits an arc, by number, from its last fit with further knowledge.

    Returns:
        The fits, and for each the knowledge that comes from all others.
    """
    latest = list(fits)
    tells: list[Prior | None] = [None] * len(fits)
    for _ in range(_ROUNDS):
        for i in range(len(fits)):
            others = [p for j, p in enumerate(tells) if j != i and p is not None]
            latest[i] = fit_again(i, latest[i], others)
            tells[i] = told(latest[i], names)
    return latest, [[p for j, p in enumerate(tells) if j != i and p is not None] for i in range(len(fits))]
