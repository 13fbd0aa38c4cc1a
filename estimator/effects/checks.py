"""The rules of an effect, checked by numbers: for the library's own tests and for a user's new effect."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import casadi as ca
import numpy as np

from estimator.effects.declaration import ENVIRONMENT, Effect, EffectInstance, Layout, Sample
from estimator.models.rotations import exponential, multiply

AGREEMENT = 1e-6  # of an analytic derivative with a finite difference, against the largest entry of its column


def contribution_size(instance: EffectInstance, layout: Layout) -> int:
    """Number of rows that the contribution of this channel has."""
    return layout.beams if instance.channel == "doppler" else 3


def sample_shapes(layout: Layout, state_size: int) -> dict[str, tuple[int, int]]:
    """Rows and columns of the fields of a :class:`Sample`."""
    shapes = {name: (size, 1) for name, size in ENVIRONMENT.items()}
    return shapes | {"attitude": (4, 1), "rate": (3, 1), "inertia": (3, 3), "actuator_from_tracker": (4, 1),
                     "command": (3, 1), "other_torque": (3, 1), "state": (state_size, 1), "step": (1, 1),
                     "step_fraction": (1, 1), "antenna_from_tracker": (4, 1), "beam_direction": (layout.beams, 3),
                     "carrier_frequency": (1, 1), "inside_arc": (1, 1)}


def random_sample(rng: np.random.Generator, layout: Layout, state_size: int, session: int | None = None
                  ) -> dict[str, np.ndarray]:
    """Numbers of a plausible instant in low Earth orbit, inside the Doppler session of that index if one is given."""

    def unit(size: int) -> np.ndarray:
        vector = rng.standard_normal(size)
        return vector / np.linalg.norm(vector)

    beams = unit(3 * layout.beams).reshape(layout.beams, 3)
    if layout.beam_directions:
        beams = np.array(layout.beam_directions)
    spread = rng.standard_normal((3, 3))
    first, last = layout.span if session is None else layout.sessions[session]
    velocity = 7500.0 * unit(3)  # m/s
    return {
        "time": np.array(rng.uniform(first, last)), "position": 7e6 * unit(3), "velocity": velocity,
        "acceleration": 8.1 * unit(3), "earth_fixed_velocity": velocity + 400.0 * unit(3),
        "earth_angle": np.array(rng.uniform(0, 6.28)), "orbit_phase": np.array(rng.uniform(-3.1, 3.1)),
        "magnetic_field": 3e-5 * unit(3), "sun": unit(3), "sunlit": np.array(1.0), "density": np.array(4e-14),
        "earth_velocity": 3e4 * unit(3), "attitude": unit(4), "rate": 0.02 * unit(3),
        "inertia": 800.0 * np.eye(3) + 20.0 * (spread + spread.T), "actuator_from_tracker": unit(4),
        "command": 0.6 * unit(3), "other_torque": 0.1 * unit(3), "state": 1e-2 * rng.standard_normal(state_size),
        "step": np.array(0.25), "step_fraction": np.array(rng.choice([0.0, 0.5, 1.0])),
        "antenna_from_tracker": unit(4), "beam_direction": beams / np.linalg.norm(beams, axis=1, keepdims=True),
        "carrier_frequency": np.array(9.6e9), "inside_arc": np.array(1.0),
    }


def random_parameters(rng: np.random.Generator, instance: EffectInstance) -> np.ndarray:
    """Ordinary parameters of about their typical size, searched ones inside their plausible range."""
    return np.array([rng.uniform(*p.plausible) if p.search else p.scale * rng.uniform(0.2, 1.0) for p in
                     instance.parameters])


def at_zero(instance: EffectInstance, rng: np.random.Generator) -> np.ndarray:
    """Parameters of the model without the effect: ordinary ones zero, searched ones inside their range."""
    return np.array([rng.uniform(*p.plausible) if p.search else 0.0 for p in instance.parameters])


@dataclass(frozen=True)
class Numeric:
    """An instance as numeric functions.

    Attributes:
        contribution: from the dict of a sample and the parameters to the contribution (rows,).
        along_parameters: to the Jacobian (rows, parameters) that CasADi derives.
        along_attitude: to the Jacobian (rows, 3) along a small rotation of the attitude on its left.
        state_derivative: to the derivative of the states (state_size,), where there are any.
    """

    contribution: Callable[[dict[str, np.ndarray], np.ndarray], np.ndarray]
    along_parameters: Callable[[dict[str, np.ndarray], np.ndarray], np.ndarray]
    along_attitude: Callable[[dict[str, np.ndarray], np.ndarray], np.ndarray]
    state_derivative: Callable[[dict[str, np.ndarray], np.ndarray], np.ndarray] | None


def numeric(instance: EffectInstance, layout: Layout) -> Numeric:
    """The functions of an instance, and their derivatives as CasADi gives them."""
    symbols = {name: ca.SX.sym(name, *shape) for name, shape in sample_shapes(layout, instance.state_size).items()}
    p = ca.SX.sym("p", len(instance.parameters))
    turn = ca.SX.sym("turn", 3)
    turned = Sample(**{**symbols, "attitude": multiply(exponential(turn), symbols["attitude"])})
    value = ca.densify(ca.SX(instance.function(turned, p)))
    outputs = [value, ca.densify(ca.jacobian(value, p)), ca.densify(ca.jacobian(value, turn))]
    if instance.state_derivative is not None:
        outputs.append(ca.densify(ca.SX(instance.state_derivative(turned, p))))
    plain = [ca.substitute(o, turn, ca.SX.zeros(3)) for o in outputs]
    function = ca.Function("effect", [*symbols.values(), p], plain)

    def output(index: int) -> Callable[[dict[str, np.ndarray], np.ndarray], np.ndarray]:
        def call(sample: dict[str, np.ndarray], parameters: np.ndarray) -> np.ndarray:
            result: Any = function(*(sample[name] for name in symbols), parameters)[index]
            array = np.array(result)
            return array[:, 0] if index in (0, 3) else array

        return call

    return Numeric(output(0), output(1), output(2), output(3) if instance.state_derivative is not None else None)


def finite_difference(function: Callable[[np.ndarray], np.ndarray], point: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Jacobian (rows, columns) by central differences of fourth order."""
    columns = []
    for i, step in enumerate(steps):
        shift = np.zeros(len(point))
        shift[i] = step
        near = function(point + shift) - function(point - shift)
        far = function(point + 2 * shift) - function(point - 2 * shift)
        columns.append((8 * near - far) / (12 * step))
    return np.stack(columns, axis=1)


def _declaration_problems(instance: EffectInstance) -> list[str]:
    problems = []
    names = [p.name for p in instance.parameters]
    if not names or len(set(names)) != len(names):
        problems.append("parameters are missing or two have the same name")
    if not instance.zero or not instance.reference:
        problems.append("the zero condition or the reference is missing")
    if (instance.state_size > 0) != (instance.state_derivative is not None):
        problems.append("internal states and their derivative must be declared together")
    for p in instance.parameters:
        low, high = p.plausible
        if not p.unit or not p.scale > 0 or not low < high:
            problems.append(f"{p.name}: unit, positive scale and a plausible range are needed")
        if p.search is None and not low <= 0 <= high:
            problems.append(f"{p.name}: zero is not in the plausible range")
        if p.search is None and max(abs(low), abs(high)) < p.scale:
            problems.append(f"{p.name}: the typical size is not plausible")
        if p.nominal is not None and not low <= p.nominal <= high:
            problems.append(f"{p.name}: the nominal value is not plausible")
        if p.search is not None and not low <= p.search.low <= p.search.high <= high:
            problems.append(f"{p.name}: the searched values are not plausible")
    return problems


def problems_of(effect: Effect, layout: Layout, seed: int = 0, samples: int = 12) -> list[str]:
    """What is wrong with an effect, in sentences; empty where it keeps the rules.

    Checked on random instants: declaration complete; the right number of rows; exactly zero without the effect, and
    finite; each ordinary parameter has a derivative there; derivatives along parameters and attitude agree with
    finite differences.
    """
    rng = np.random.default_rng(seed)
    problems: list[str] = []
    for instance in effect.instances(layout):
        found = _declaration_problems(instance)
        functions = numeric(instance, layout)
        rows = contribution_size(instance, layout)
        ordinary = np.array([p.search is None for p in instance.parameters])
        steps = np.array([1e-3 * p.scale if p.search is None else 1e-4 * (p.plausible[1] - p.plausible[0])
                          for p in instance.parameters])
        steps = np.minimum(steps, 1e-3)  # a time or a frequency must not leave the neighbourhood
        seen = np.zeros(len(instance.parameters))
        places = [None, None, *range(len(layout.sessions))]
        for k in range(max(samples, len(places))):
            sample = random_sample(rng, layout, instance.state_size, places[k % len(places)])
            zero = at_zero(instance, rng)
            value = functions.contribution(sample, zero)
            if value.shape != (rows,):
                found.append(f"the contribution has {value.shape[0]} rows, the channel {instance.channel} has {rows}")
                break
            if not np.all(value == 0):
                found.append(f"without the effect the contribution is {value}, not zero")
            derivative = functions.along_parameters(sample, zero)
            if not np.all(np.isfinite(derivative)):
                found.append("the derivative without the effect is not finite")
            seen = np.maximum(seen, np.max(np.abs(derivative), axis=0))
            point = random_parameters(rng, instance)
            for at in (zero, point):
                exact = functions.along_parameters(sample, at)
                near = finite_difference(partial(functions.contribution, sample), at, steps)
                # rounding of the difference: the contribution's own size over the step
                floor = 1e-13 * np.max(np.abs(functions.contribution(sample, at))) / steps + 1e-30
                if np.any(np.abs(exact - near) > AGREEMENT * np.max(np.abs(exact), axis=0) + 30 * floor):
                    found.append(f"the derivative along the parameters disagrees with differences at {at}")
            exact = functions.along_attitude(sample, point)
            near = finite_difference(partial(_at_turned_attitude, functions, sample, point), np.zeros(3),
                                     np.full(3, 1e-3))
            if np.any(np.abs(exact - near) > AGREEMENT * np.max(np.abs(exact)) + 1e-9 * np.max(np.abs(near)) + 1e-30
                      + 1e-10 * np.max(np.abs(functions.contribution(sample, point)))):
                found.append("the derivative along the attitude disagrees with differences")
        for p, size, free in zip(instance.parameters, seen, ordinary, strict=True):
            if free and size == 0:
                found.append(f"{p.name}: the contribution has no derivative along it at zero on any sample")
        problems.extend(f"{instance.name}: {text}" for text in dict.fromkeys(found))
    return problems


def _at_turned_attitude(functions: Numeric, sample: dict[str, np.ndarray], p: np.ndarray, turn: np.ndarray
                        ) -> np.ndarray:
    attitude = np.array(ca.DM(multiply(exponential(ca.DM(turn)), ca.DM(sample["attitude"]))))[:, 0]
    return functions.contribution({**sample, "attitude": attitude}, p)
