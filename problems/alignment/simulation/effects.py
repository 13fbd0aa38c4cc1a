"""Named effects inside the simulator: their declared functions, evaluated with numbers where they act.

An effect is given by its name and the values of its parameters. The contribution is the function of the declaration
itself; everything around it (where it enters, with which attitude, rate, orbit) is the simulator's own.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from estimator.effects.declaration import ENVIRONMENT, EffectInstance, Layout, Sample
from estimator.models.errors import NotFiniteError, RequestError
from estimator.models.loops import Mapped
from problems.alignment.simulation.orbit import Orbit

EffectValues = float | Sequence[float] | Mapping[str, float] | None
"""One number, one for each parameter in order, one for each parameter by name, or None for the nominal values."""

EffectChoice = Mapping[str, EffectValues] | Mapping[str | EffectInstance, EffectValues]
"""Effects with their values: names of the library, or declarations that no library holds."""

_STEP = 5.0  # [s] of the environment's grid; the field along an orbit bends over hundreds of seconds
_VANISHING_STEP = 1e-6  # [s] short against every time constant, long against rounding
_SHADOW_STEP = 0.25  # [s] of the grid for the edge of the shadow


@dataclass(frozen=True)
class ActiveEffect:
    """One instance with the values of its parameters, as a compiled-down numeric function.

    Attributes:
        instance: the declaration on this campaign.
        values: (parameters,) in SI units, order of the declaration.
        used: fields of the sample that the functions depend on, in the order of the function's inputs.
        function: from those fields to the contribution and the derivative of the internal states.
    """

    instance: EffectInstance
    values: np.ndarray
    used: tuple[str, ...]
    function: ca.Function

    @property
    def vanishes(self) -> bool:
        """Whether every ordinary parameter is zero, which is the world without the effect."""
        ordinary = [v for p, v in zip(self.instance.parameters, self.values, strict=True) if p.search is None]
        return bool(ordinary) and not any(ordinary)

    def parameters(self) -> dict[str, float]:
        """Values by name of the parameter."""
        return {p.name: float(v) for p, v in zip(self.instance.parameters, self.values, strict=True)}


def parse_effects(text: str) -> dict[str, EffectValues]:
    """Effects written as ``name=value:value,name=value`` to a mapping.

    Names are separated by commas, the values of one effect by colons, in the order of its parameters and in SI
    units; ``name`` alone stands for the values that physics demands (the scale 1 of the gravity gradient). A beam
    is chosen by its number in the name: ``beam-mispointing:1=7e-5:-5e-5``.

    Raises:
        RequestError: a value is no number, or a name comes twice.
    """
    effects: dict[str, EffectValues] = {}
    for part in filter(None, (p.strip() for p in text.split(","))):
        name, equals, values = (x.strip() for x in part.partition("="))
        if name in effects:
            raise RequestError("the effect is given twice", where="effects", value=name, remedy="give it once")
        if not equals:
            effects[name] = None
            continue
        try:
            effects[name] = tuple(float(v) for v in values.replace(";", ":").split(":"))
        except ValueError as error:
            raise RequestError("a value is no number", where=f"effects: {name}", value=values,
                               remedy="write name=value or name=value:value:value") from error
    return effects


def activate(effects: EffectChoice, layout: Layout) -> tuple[ActiveEffect, ...]:
    """The effects asked for, on a campaign of this layout.

    Args:
        effects: keys are names of the library ("gravity-gradient-torque", "beam-mispointing:1"), or declarations that
            no library holds; values see :data:`EffectValues`.
        layout: of the campaign.

    Raises:
        RequestError: no effect of that name, a name that stands for several, or a wrong number of values.
        NotFiniteError: a value is NaN or infinite.
    """
    active = []
    for key, values in effects.items():
        instance = key if isinstance(key, EffectInstance) else _find(key, layout)
        active.append(_active(instance, _vector(instance, values), layout))
    return tuple(active)


def _find(name: str, layout: Layout) -> EffectInstance:
    from estimator.effects.library import select

    found = select([name], layout)
    if len(found) != 1:
        raise RequestError("the name does not say which one", where="effects", value=name,
                           limit=", ".join(i.name for i in found), remedy="choose one of these")
    return found[0]


def _vector(instance: EffectInstance, values: EffectValues) -> np.ndarray:
    names = [p.name for p in instance.parameters]
    expected = ", ".join(f"{p.name} [{p.unit}]" for p in instance.parameters)
    if values is None:
        if any(p.nominal is None for p in instance.parameters):
            raise RequestError("the effect needs values", where=f"effects: {instance.name}", limit=expected,
                               remedy="give one for each parameter")
        numbers = [float(p.nominal) for p in instance.parameters if p.nominal is not None]
    elif isinstance(values, Mapping):
        if unknown := sorted(set(values) - set(names)):
            raise RequestError("the effect has no such parameter", where=f"effects: {instance.name}", value=unknown,
                               limit=expected)
        numbers = [float(values.get(n, 0.0)) for n in names]
    else:
        numbers = [float(v) for v in np.atleast_1d(np.asarray(values, dtype=float))]
    if len(numbers) != len(names):
        raise RequestError("wrong number of values", where=f"effects: {instance.name}", value=len(numbers),
                           limit=f"{len(names)}: {expected}", remedy="give one for each parameter")
    if not all(math.isfinite(v) for v in numbers):
        raise NotFiniteError("a value is not finite", where=f"effects: {instance.name}", value=numbers)
    return np.array(numbers)


def _active(instance: EffectInstance, values: np.ndarray, layout: Layout) -> ActiveEffect:
    shapes = _shapes(layout, instance.state_size)
    symbols = {name: ca.MX.sym(name, *shape) for name, shape in shapes.items()}
    p = ca.DM(values)
    outputs = [_continuous(instance.function, symbols, p)]
    if instance.state_size and instance.state_derivative is not None:
        outputs.append(_continuous(instance.state_derivative, symbols, p))
    whole = ca.veccat(*outputs)
    used = tuple(n for n, s in symbols.items() if n == "time" or ca.depends_on(whole, s))
    function = ca.Function("contribution", [symbols[n] for n in used], outputs, list(used),
                           ["contribution", "state_derivative"][: len(outputs)])
    with contextlib.suppress(RuntimeError):  # A lookup table inside keeps it as it is.
        function = function.expand()
    return ActiveEffect(instance, values, used, function)


def _continuous(function: Callable[[Sample, Any], Any], symbols: Mapping[str, Any], p: Any) -> Any:
    """A function of the declaration in continuous time.

    Some state-carrying effects are written for one Runge-Kutta step of known length. What the step adds, its stages
    weighted as the method weights them, over a step of vanishing length is the equation itself, which the adaptive
    integrator takes.
    """
    expression = ca.MX(function(Sample(**symbols), p))
    if not ca.depends_on(expression, ca.vertcat(symbols["step"], symbols["step_fraction"])):
        return ca.densify(expression)
    stages = ((0.0, 1.0 / 6.0), (0.5, 2.0 / 3.0), (1.0, 1.0 / 6.0))
    at = [Sample(**{**symbols, "step": ca.DM(_VANISHING_STEP), "step_fraction": ca.DM(c)}) for c, _ in stages]
    weighted = [w * ca.MX(function(sample, p)) for sample, (_, w) in zip(at, stages, strict=True)]
    return ca.densify(weighted[0] + weighted[1] + weighted[2])


def _shapes(layout: Layout, states: int) -> dict[str, tuple[int, int]]:
    shapes = {name: (size, 1) for name, size in ENVIRONMENT.items()}
    shapes |= {"attitude": (4, 1), "rate": (3, 1), "inertia": (3, 3), "actuator_from_tracker": (4, 1),
               "command": (3, 1), "other_torque": (3, 1), "state": (max(states, 1), 1),
               "antenna_from_tracker": (4, 1), "beam_direction": (max(layout.beams, 1), 3),
               "carrier_frequency": (1, 1), "inside_arc": (1, 1), "step": (1, 1), "step_fraction": (1, 1)}
    declared = {f.name for f in dataclasses.fields(Sample)}
    if missing := declared - set(shapes):
        raise NotImplementedError(f"the simulator does not provide these fields of a sample: {sorted(missing)}")
    return shapes


class Environment:
    """What an effect may ask of time and orbit, on the true orbit.

    Position, velocity and what follows from them are the simulator's own; the magnetic field, the Sun, the shadow,
    the atmosphere and the Earth's motion come from the common functions.

    Args:
        orbit: the true orbit.
        epoch: UTC, ISO 8601.
        spans: (start, stop) of each rotation arc, s after the epoch.
        duration: s, of the campaign.
    """

    def __init__(self, orbit: Orbit, epoch: str, spans: Sequence[tuple[float, float]], duration: float):
        self.orbit = orbit
        self.epoch = epoch
        self.spans = tuple(spans)
        self.duration = duration
        self._along: dict[tuple[str, ...], list[tuple[np.ndarray, np.ndarray]]] = {}

    @functools.cached_property
    def _heaven(self) -> CubicSpline:
        """Velocity of the Earth and place of the Sun from the Earth (6) over the campaign."""
        from estimator.models.environment import earth_and_sun

        margin = 400.0  # [s]
        knots = np.linspace(-margin, self.duration + margin, max(math.ceil(self.duration / 600.0), 8))
        return CubicSpline(knots, np.concatenate(earth_and_sun(self.epoch, knots), axis=1))

    def fields(self, names: Sequence[str], time: np.ndarray) -> dict[str, np.ndarray]:
        """Arrays (n, size) of the fields at ``time`` (n,)."""
        position, velocity = self.orbit.inertial(time)
        every: dict[str, Callable[[], np.ndarray]] = {
            "time": lambda: time,
            "position": lambda: position,
            "velocity": lambda: velocity,
            "acceleration": lambda: self.orbit.acceleration(position),
            "earth_fixed_velocity": lambda: self.orbit.relative_velocity(position, velocity),
            "earth_angle": lambda: self.orbit.earth_angle(time),
            "orbit_phase": lambda: argument_of_latitude(position, velocity),
            "magnetic_field": lambda: self._magnetic_field(time),
            "sun": lambda: self._sun(time, position)[0],
            "sunlit": lambda: self._sunlit(time, position),
            "density": lambda: self._density(position),
            "earth_velocity": lambda: self._heaven(time)[:, :3],
        }
        return {name: every[name]().reshape(len(time), ENVIRONMENT[name]) for name in names}

    def _magnetic_field(self, time: np.ndarray) -> np.ndarray:
        """In inertial axes; on a grid where the samples are denser than that."""
        from estimator.models.environment import geomagnetic_field

        count = math.ceil((time[-1] - time[0]) / _STEP) + 1 if len(time) else 0
        dense = 4 <= count < len(time)
        grid = np.linspace(time.min(), time.max(), count) if dense else time
        position, _ = self.orbit.inertial(grid)
        fixed = geomagnetic_field(self.epoch, grid, self.orbit.to_earth_fixed(grid, position))
        if dense:
            fixed = CubicSpline(grid, fixed)(time)
        return self.orbit.from_earth_fixed(time, fixed)

    def _sun(self, time: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Unit vectors to the Sun (n, 3) and its distance (n,) m."""
        towards = self._heaven(time)[:, 3:] - position
        distance = np.linalg.norm(towards, axis=1)
        return towards / distance[:, None], distance

    def _sunlit(self, time: np.ndarray, position: np.ndarray) -> np.ndarray:
        from estimator.models.environment import sunlit

        return sunlit(position, *self._sun(time, position))

    def _density(self, position: np.ndarray) -> np.ndarray:
        from estimator.models.environment import density

        return density(position)

    def along_arc(self, names: Sequence[str], start: float, stop: float) -> Callable[[float], np.ndarray]:
        """A function from one time to the stacked fields (in the order of ``names``) for the rotation's equation."""
        if not names:
            nothing = np.zeros(0)
            return lambda _time: nothing
        smooth = tuple(n for n in names if n != "sunlit")
        if smooth not in self._along:
            self._along[smooth] = self._cubics(smooth)
        cubic = _PiecewiseCubic(*self._along[smooth][self.spans.index((start, stop))])
        if "sunlit" not in names:
            return cubic
        # The edge of the shadow is sharper than a cubic over seconds can follow: a straight line over a short step.
        fine = np.linspace(start, stop, math.ceil((stop - start) / _SHADOW_STEP) + 1)
        light = self.fields(["sunlit"], fine)["sunlit"][:, 0]
        place = sum(ENVIRONMENT[n] for n in names[: list(names).index("sunlit")])
        return lambda time: np.insert(cubic(time), place, np.interp(time, fine, light))

    def _cubics(self, names: Sequence[str]) -> list[tuple[np.ndarray, np.ndarray]]:
        """For each rotation arc, uniform knots (n) and cubic coefficients (n - 1, 4, width), highest power first."""
        grids = [np.linspace(a, b, max(math.ceil((b - a) / _STEP) + 1, 4)) for a, b in self.spans]
        if not names:
            return [(grid, np.zeros((len(grid) - 1, 4, 0))) for grid in grids]
        table = self.fields(names, np.concatenate(grids))  # all arcs in one call: the field's model is slow to start
        if "orbit_phase" in names:
            table["orbit_phase"] = np.unwrap(table["orbit_phase"], axis=0)
        values = np.split(np.concatenate([table[n] for n in names], axis=1), np.cumsum([len(g) for g in grids])[:-1])
        return [(grid, np.ascontiguousarray(np.swapaxes(CubicSpline(grid, value).c, 0, 1)))
                for grid, value in zip(grids, values, strict=True)]


class _PiecewiseCubic:
    """Cubics on uniform knots at one time: a tenth of the time of the general class of SciPy."""

    def __init__(self, grid: np.ndarray, coefficients: np.ndarray):
        self.start, self.step, self.last = float(grid[0]), float(grid[1] - grid[0]), len(grid) - 2
        self.coefficients = coefficients

    def __call__(self, time: float) -> np.ndarray:
        piece = min(max(int((time - self.start) / self.step), 0), self.last)
        x = time - self.start - piece * self.step
        return np.array([x * x * x, x * x, x, 1.0]) @ self.coefficients[piece]


def argument_of_latitude(position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Angle along the orbit from the ascending node (n,) rad in (-pi, pi]."""
    normal = np.cross(position, velocity)
    node = np.stack([-normal[:, 1], normal[:, 0], np.zeros(len(normal))], axis=1)
    across = np.cross(normal, node)
    return np.arctan2(np.sum(position * across, axis=1) / np.linalg.norm(normal, axis=1),
                      np.sum(position * node, axis=1))


def contributions(
    effects: Sequence[ActiveEffect],
    environment: Environment,
    time: np.ndarray,
    width: int,
    constant: Mapping[str, np.ndarray],
    sampled: Mapping[str, np.ndarray],
) -> np.ndarray:
    """Sum of the contributions (n, width) of effects of one measurement channel.

    Args:
        effects: of that channel.
        environment: of the campaign.
        time: (n,) s after the epoch.
        width: of one contribution.
        constant: fields that are the same for all samples.
        sampled: fields given sample by sample (attitude, rate, inside_arc).
    """
    total = np.zeros((len(time), width))
    for effect in effects:
        shared = tuple(n for n in effect.used if n in constant)
        mapped = Mapped(effect.function, shared=shared)
        for first in range(0, len(time), 50_000):
            part = slice(first, min(first + 50_000, len(time)))
            fields = environment.fields([n for n in effect.used if n in ENVIRONMENT], time[part])
            for name in effect.used:
                if name in constant:
                    fields[name] = constant[name]
                elif name in sampled:
                    fields[name] = sampled[name][part]
            total[part] += mapped(part.stop - first, **fields)[0].reshape(-1, width)
    return total


class TorqueEffects:
    """All effects that act on the rotation of the body, in one right side.

    Order: effects on the command change the commanded torque; stateless torques are added; then effects with
    internal states see the sum of all these minus the gyroscopic term as ``other_torque``.

    Args:
        effects: those of the channels torque and command; others are passed over.
        environment: of the campaign.
        inertia: (3, 3) kg m2.
        actuator_from_tracker: quaternion (4).
    """

    def __init__(self, effects: Sequence[ActiveEffect], environment: Environment | None, inertia: np.ndarray,
                 actuator_from_tracker: np.ndarray):
        mine = [e for e in effects if e.instance.channel in ("command", "torque") and not e.vanishes]
        self.command = [e for e in mine if e.instance.channel == "command"]
        self.free = [e for e in mine if e.instance.channel == "torque" and e.instance.state_size == 0]
        self.coupled = [e for e in mine if e.instance.channel == "torque" and e.instance.state_size > 0]
        self.states = sum(e.instance.state_size for e in mine)
        self.environment = environment
        self.inertia = inertia
        self.tracker_from_actuator = Rotation.from_quat(actuator_from_tracker, scalar_first=True).as_matrix().T
        self.constant = {"inertia": ca.DM(inertia), "actuator_from_tracker": ca.DM(actuator_from_tracker)}
        self.names = [n for n in ENVIRONMENT if n != "time" and any(n in e.used for e in mine)]
        self.function = self._function()

    def _function(self) -> ca.Function:
        """(time, fields, state, command) to the derivative of the state, see the module ``rotation``."""
        time, command = ca.MX.sym("time"), ca.MX.sym("command", 3)
        stacked = ca.MX.sym("fields", sum(ENVIRONMENT[n] for n in self.names))
        state = ca.MX.sym("state", 12 + self.states)
        fields: dict[str, Any] = {"time": time, "command": command, **self.constant}
        first = 0
        for name in self.names:
            fields[name] = stacked[first : first + ENVIRONMENT[name]]
            first += ENVIRONMENT[name]
        inertial_from_tracker = ca.reshape(state[:9], 3, 3).T
        inertia = ca.DM(self.inertia)
        rate = ca.DM(np.linalg.inv(self.inertia)) @ (inertial_from_tracker.T @ state[9:12])
        fields |= {"rate": rate, "attitude": _quaternion(inertial_from_tracker.T)}
        first, slopes = 12, []

        def value(effect: ActiveEffect) -> Any:
            nonlocal first
            size = effect.instance.state_size
            fields["state"] = state[first : first + size]
            first += size
            answers = effect.function.call([fields[n] for n in effect.used])
            slopes.extend(answers[1:])
            return answers[0]

        acting = command
        for effect in self.command:
            acting = acting + value(effect)
        torque = ca.DM(self.tracker_from_actuator) @ acting
        for effect in self.free:
            torque = torque + value(effect)
        fields["other_torque"] = torque - ca.cross(rate, inertia @ rate)
        for effect in self.coupled:
            torque = torque + value(effect)
        turning = inertial_from_tracker @ ca.skew(rate)
        derivative = ca.vertcat(ca.vec(turning.T), inertial_from_tracker @ torque, *slopes)
        function = ca.Function("rotation", [time, stacked, state, command], [ca.densify(derivative)])
        with contextlib.suppress(RuntimeError):  # A lookup table inside keeps it as it is.
            function = function.expand()
        return function

    def right_side(self, start: float, stop: float) -> Callable[[float, np.ndarray, np.ndarray], np.ndarray]:
        """(time, state, command) to the derivative of the state in the arc from ``start`` to ``stop``."""
        at: Callable[[float], np.ndarray] = lambda _time: np.zeros(0)  # noqa: E731
        if self.environment is not None:
            at = self.environment.along_arc(self.names, start, stop)
        buffer: Any
        buffer, trigger = self.function.buffer()
        inputs = [np.zeros(self.function.numel_in(i)) for i in range(4)]
        output = np.zeros(self.function.numel_out(0))
        for i, array in enumerate(inputs):
            buffer.set_arg(i, array.data)
        buffer.set_res(0, output.data)

        def right_side(time: float, state: np.ndarray, command: np.ndarray) -> np.ndarray:
            inputs[0][0] = time
            inputs[1][:] = at(time)
            inputs[2][:] = state
            inputs[3][:] = command
            trigger()
            return output.copy()  # the integrator keeps what it is given

        right_side.buffer = buffer  # type: ignore[attr-defined]  # keeps alive what the trigger reads
        return right_side

    def command_map(self) -> np.ndarray:
        """Lasting map (3, 3) from command (actuator axes) to torque (tracker axes), with stateless command effects."""
        acting = np.eye(3)
        for effect in self.command:
            if effect.instance.state_size:
                continue

            def change(command: np.ndarray, effect: ActiveEffect = effect) -> np.ndarray:
                fields = {n: ca.DM.zeros(*effect.function.size_in(n)) for n in effect.used}
                fields |= {n: v for n, v in self.constant.items() if n in fields}
                if "command" in fields:
                    fields["command"] = ca.DM(command)
                return np.asarray(effect.function.call([fields[n] for n in effect.used])[0]).ravel()

            nothing = change(np.zeros(3))
            acting = acting + np.stack([change(column) - nothing for column in np.eye(3)], axis=1)
        return np.asarray(self.tracker_from_actuator @ acting)


def _quaternion(m: Any) -> Any:
    """Unit quaternion (4) ``x_from_y``, scalar first, of the symbolic matrix x_from_y (3, 3), by its largest component.

    The sign is free.
    """
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    squares = [1.0 + trace] + [1.0 + 2.0 * m[i, i] - trace for i in range(3)]
    a, b, c = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    d, e, f = m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
    rows = [(squares[0], a, b, c), (a, squares[1], d, e), (b, d, squares[2], f), (c, e, f, squares[3])]
    largest, best = ca.vertcat(*rows[0]), squares[0]
    for row, square in zip(rows[1:], squares[1:], strict=True):
        larger = square > best
        largest = ca.if_else(larger, ca.vertcat(*row), largest)
        best = ca.fmax(square, best)
    return largest / ca.norm_2(largest)
