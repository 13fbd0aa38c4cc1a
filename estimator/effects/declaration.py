"""How a physical effect is declared: once, and used unchanged in simulation, fit, score test, covariance and docs.

An :class:`Effect` says its name, the channel that it changes, the parameters it adds (unit, typical size, plausible
range), when it is zero, and a reference. Given the :class:`Layout` of a campaign (how many beams, which sessions) it
yields one or more :class:`EffectInstance`, each with one pure CasADi function ``(Sample, parameters) -> contribution``.
With all parameters zero the contribution is zero, which is the model without the effect.

Contributions by channel:

========================  =========================================================================================
``torque``                N m on the body, tracker axes, added to the right side of Euler's equation
``command``               N m, actuator axes, added to the commanded torque before it acts
``star_tracker``          rotation vector (rad, tracker axes): measured ``tracker_from_inertial`` is
                          ``exponential(contribution) o true``
``doppler``               Hz per beam, added to the predicted shift
``gnss``                  m, Earth-fixed, added to the predicted position
========================  =========================================================================================

An effect of the torque or command channel may carry internal states (a flexible mode, a lag): ``state_size`` and
``state_derivative`` say how they move; they start at zero at the start of each rotation arc. The engine advances them
with the attitude by classical fourth-order Runge-Kutta steps inside which the command is constant.

An effect with one instance and no states is declared and registered in one call of :func:`declare`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from estimator.models.rotations import Matrix

Channel = Literal["torque", "command", "star_tracker", "doppler", "gnss"]


class Search(NamedTuple):
    """Values to try first of a parameter whose zero carries no direction (a jump's time, a mode's frequency).

    Attributes:
        low, high: ends of the range, in the parameter's unit.
        number: of values, both ends among them.
        spacing: in what measure the steps are even; "square-root" for a frequency, whose neighbours differ by a ratio
            at the slow end and by the inverse of an arc's length at the fast one; "listed" where the values are given.
        listed: the values, rising, of the spacing of that name.
    """

    low: float
    high: float
    number: int
    spacing: Literal["linear", "logarithmic", "square-root", "listed"]
    listed: tuple[float, ...] = ()

    @staticmethod
    def of(values: Sequence[float]) -> Search:
        """A search over these values, rising."""
        return Search(values[0], values[-1], len(values), "listed", tuple(values))

    def _measure(self) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
        """From a value to the measure in which the steps are even, and back."""
        if self.spacing != "listed":
            return _SPACINGS[self.spacing]
        places = np.arange(len(self.listed))
        return lambda v: np.interp(v, self.listed, places), lambda m: np.interp(m, places, self.listed)

    def at(self, share: float | np.ndarray) -> Any:
        """The value that lies a share (0 to 1) of the range above its low end."""
        measure, back = self._measure()
        return back(measure(self.low) + share * (measure(self.high) - measure(self.low)))

    def values(self) -> np.ndarray:
        """All values to try (number,)."""
        return np.asarray(self.at(np.linspace(0.0, 1.0, self.number)))

    def middle(self) -> float:
        """The middle of the range."""
        return float(self.at(0.5))

    def moved(self, value: float, steps: float) -> float:
        """A value moved by so many steps between neighbours."""
        measure, back = self._measure()
        step = (measure(self.high) - measure(self.low)) / max(self.number - 1, 1)
        return float(back(measure(value) + steps * step))


_SPACINGS: dict[str, tuple[Callable[[Any], Any], Callable[[Any], Any]]] = {
    "linear": (np.asarray, np.asarray), "logarithmic": (np.log, np.exp), "square-root": (np.sqrt, np.square)}


@dataclass(frozen=True)
class Parameter:
    """One added number.

    Attributes:
        name: short and physical ("dipole_x").
        unit: SI unit as text; "1" for a pure number.
        scale: typical size, used as the unit of the solver and of the prior in observability verdicts.
        plausible: smallest and largest value that an engineer would believe.
        nominal: the value that the physics demands where it is known (1 for the scale of the gravity gradient),
            else None; an estimate that disagrees with it refutes the effect's name.
        search: values to try first where the contribution is nonlinear in this parameter and its zero carries no
            direction; None for an ordinary parameter. A searched parameter has no zero: the effect vanishes when all
            the ordinary ones are zero.
    """

    name: str
    unit: str
    scale: float
    plausible: tuple[float, float]
    nominal: float | None = None
    search: Search | None = None


@dataclass(frozen=True)
class Layout:
    """What an effect may need to know about a campaign before it can say its parameters.

    Attributes:
        beams: number of radar beams.
        sessions: (start, stop) of each Doppler session, s after the epoch.
        span: first and last time of all data, s after the epoch.
        orbital_period: s.
        tracker_span: first and last time of star tracker data, s.
        tracker_stretches: (start, stop) of each stretch of star tracker data, s, in order; empty where not known.
        beam_directions: (beams) unit vectors in antenna axes, their mean where they vary; empty where not known.
        tracker_boresight: line of sight of the star tracker, unit vector in tracker axes.
    """

    beams: int
    sessions: tuple[tuple[float, float], ...]
    span: tuple[float, float]
    orbital_period: float
    tracker_span: tuple[float, float]
    beam_directions: tuple[tuple[float, float, float], ...] = ()
    tracker_boresight: tuple[float, float, float] = (0.0, 0.0, 1.0)
    tracker_stretches: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class Sample:
    """What a contribution may depend on, at one instant; CasADi symbols in a model, numbers in a simulation.

    Vectors are (3,), SI units. ``inertial`` is GCRF, ``tracker`` the star tracker's axes.

    Attributes:
        time: s after the campaign's epoch.
        position, velocity, acceleration: of the spacecraft, inertial.
        earth_fixed_velocity: velocity relative to the rotating Earth, coordinates in inertial axes.
        earth_angle: angle of the Earth's rotation about +z, rad.
        attitude: ``tracker_from_inertial`` quaternion (4).
        rate: angular velocity of the body against inertial, tracker axes, rad/s.
        orbit_phase: angle along the orbit from the ascending node, rad.
        magnetic_field: T, inertial.
        sun: unit vector to the Sun, inertial.
        sunlit: 1 in sunlight, 0 in the Earth's shadow.
        density: of the atmosphere, kg/m3.
        earth_velocity: velocity of the Earth about the solar system's barycentre, inertial.
        inertia: (3, 3) kg m2, tracker axes (torque and command channels).
        actuator_from_tracker: quaternion (4) (torque and command channels).
        command: commanded torque, N m, actuator axes (torque and command channels).
        other_torque: N m, tracker axes: all torques of stateless effects and the command, and minus the gyroscopic
            term, so that a coupled mode can form the rigid angular acceleration (state-carrying torque effects).
        state: the effect's own internal states (state_size).
        step: length of the Runge-Kutta step in progress, s (state-carrying effects).
        step_fraction: place of this evaluation inside that step, 0 at its start, 1 at its end (state-carrying effects).
        antenna_from_tracker: quaternion (4) (doppler channel).
        beam_direction: (beams, 3) unit vectors, antenna axes (doppler channel).
        carrier_frequency: Hz (doppler channel).
        inside_arc: 1 where the attitude is known, 0 elsewhere (gnss channel).
    """

    time: Matrix = None
    position: Matrix = None
    velocity: Matrix = None
    acceleration: Matrix = None
    earth_fixed_velocity: Matrix = None
    earth_angle: Matrix = None
    attitude: Matrix = None
    rate: Matrix = None
    orbit_phase: Matrix = None
    magnetic_field: Matrix = None
    sun: Matrix = None
    sunlit: Matrix = None
    density: Matrix = None
    earth_velocity: Matrix = None
    inertia: Matrix = None
    actuator_from_tracker: Matrix = None
    command: Matrix = None
    other_torque: Matrix = None
    state: Matrix = None
    step: Matrix = None
    step_fraction: Matrix = None
    antenna_from_tracker: Matrix = None
    beam_direction: Matrix = None
    carrier_frequency: Matrix = None
    inside_arc: Matrix = None


ENVIRONMENT: dict[str, int] = {
    "time": 1,
    "position": 3,
    "velocity": 3,
    "acceleration": 3,
    "earth_fixed_velocity": 3,
    "earth_angle": 1,
    "orbit_phase": 1,
    "magnetic_field": 3,
    "sun": 3,
    "sunlit": 1,
    "density": 1,
    "earth_velocity": 3,
}
"""The fields of :class:`Sample` that depend on time and orbit alone, in the order of the rows of environment tables
(26 rows), with their sizes."""


@dataclass(frozen=True)
class EffectInstance:
    """One effect on one campaign: its parameters and its pure function.

    Attributes:
        name: the effect's name, with ":which" where the effect has several instances ("beam-mispointing:1").
        family: the name of the effect that it is an instance of.
        channel: see the module.
        parameters: the added numbers, in the order of the vector ``p``.
        function: ``(sample, p) -> contribution``.
        state_size: number of internal states.
        state_derivative: ``(sample, p) -> derivative`` of the internal states (state_size).
        resolution: longest Runge-Kutta step (s) that still follows the internal states.
        zero: the condition under which the contribution is zero, in words.
        reference: where the formula comes from.
    """

    name: str
    family: str
    channel: Channel
    parameters: tuple[Parameter, ...]
    function: Callable[[Sample, Any], Any]
    zero: str
    reference: str
    state_size: int = 0
    state_derivative: Callable[[Sample, Any], Any] | None = None
    resolution: float = float("inf")


@dataclass(frozen=True)
class Effect:
    """A named effect of the library; a new one is one new file that makes one of these and registers it.

    Attributes:
        name: the fixed name of the API, the command line and the reports.
        channel: the residual or equation that it changes.
        summary: one sentence for the generated documentation page.
        instances: from the layout of a campaign to the instances that exist on it (usually one); the same objects for
            the same layout, because compiled kernels are kept by them.
        formula: the contribution as text, for the documentation page.
    """

    name: str
    channel: Channel
    summary: str
    instances: Callable[[Layout], tuple[EffectInstance, ...]]
    formula: str = ""


_REGISTRY: dict[str, Effect] = {}


def register(effect: Effect) -> Effect:
    """Put an effect into the registry; its name must be new.

    Raises:
        ValueError: an effect of that name is registered already.
    """
    if effect.name in _REGISTRY and _REGISTRY[effect.name] != effect:
        raise ValueError(f"an effect named {effect.name!r} is registered already; choose another name")
    _REGISTRY[effect.name] = effect
    return effect


def registry() -> dict[str, Effect]:
    """The registered effects by name, in alphabetical order (a copy)."""
    return dict(sorted(_REGISTRY.items()))


def axes(name: str, unit: str, scale: float, largest: float, labels: tuple[str, ...] = ("x", "y", "z")
         ) -> tuple[Parameter, ...]:
    """One :class:`Parameter` per axis, ``name_x`` and so on, plausible between ``-largest`` and ``largest``."""
    return tuple(Parameter(f"{name}_{label}", unit, scale, (-largest, largest)) for label in labels)


def declare(name: str, channel: Channel, parameters: tuple[Parameter, ...], function: Callable[[Sample, Any], Any], *,
            summary: str, formula: str, zero: str, reference: str, state_size: int = 0,
            state_derivative: Callable[[Sample, Any], Any] | None = None,
            resolution: float = float("inf")) -> Effect:
    """Declare and register an effect that has one instance, the same on every campaign.

    Args:
        name, channel, parameters, function, zero, reference, state_size, state_derivative, resolution: see
            :class:`EffectInstance`.
        summary, formula: see :class:`Effect`.

    Raises:
        ValueError: an effect of that name is registered already.
    """
    instance = EffectInstance(name, name, channel, parameters, function, zero, reference, state_size, state_derivative,
                              resolution)

    def instances(layout: Layout) -> tuple[EffectInstance, ...]:
        return (instance,)

    return register(Effect(name, channel, summary, instances, formula))
