"""How far the parameters of an effect are known, a time of change among them.

The samples do not see when something steps between two of them: the sum of squares is flat there, and its derivative,
from which a covariance comes, says next to nothing. How far the time may go before the sum of squares rises by one
does.
"""

from __future__ import annotations

import numpy as np

from estimator.effects.declaration import EffectInstance
from estimator.estimate import Estimate

HALVINGS = 8  # of the step in which the sum of squares rises by one


def sigma_of(estimate: Estimate, effect: EffectInstance) -> np.ndarray:
    """Standard deviation of each parameter of an estimated effect, in its unit; infinite where nothing determines it.

    A searched parameter of an effect without internal states (the time of a jump) gets at least half the interval over
    which the sum of squares, all else as estimated, rises by less than one.
    """
    sigma = np.array(estimate.sigma_of(effect.name), dtype=float)
    if effect.state_size:
        return sigma
    for index, parameter in enumerate(effect.parameters):
        if parameter.search is not None:
            width = _interval(estimate, effect.name, index, parameter.plausible)
            sigma[index] = max(sigma[index], width) if np.isfinite(sigma[index]) else width
    return sigma


def _interval(estimate: Estimate, name: str, index: int, plausible: tuple[float, float]) -> float:
    """Half the interval of one parameter in which the sum of squares stays within one of its minimum."""
    touched = [r for r in estimate.problem.residuals if any(u.name == name for u in r.unknowns)]
    at = np.asarray(estimate.values[name], dtype=float)

    def cost(value: float) -> float:
        moved = at.copy()
        moved[index] = value
        return sum(r.linearize({**estimate.values, name: moved}, ()).cost for r in touched)

    least = cost(float(at[index]))
    ends = []
    for end in plausible:
        reach = end - at[index]
        inside, step = 0.0, 2.0**-20
        while step < 1.0 and cost(float(at[index] + step * reach)) < least + 1.0:
            inside, step = step, 2 * step
        outside = min(step, 1.0)
        for _ in range(HALVINGS):
            middle = 0.5 * (inside + outside)
            if cost(float(at[index] + middle * reach)) < least + 1.0:
                inside = middle
            else:
                outside = middle
        ends.append(abs(outside * reach))
    return 0.5 * (ends[0] + ends[1])
