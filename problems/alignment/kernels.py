"""The alignment problem's kernels: one sample of each channel, with the effects that are in the model.

Effects are inserted here, by channel, from their one declaration; with none, the kernels are the plain model.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import casadi as ca
import numpy as np

from estimator.driven_motion import Drive, RightSide
from estimator.effects.declaration import ENVIRONMENT, EffectInstance, Sample
from estimator.models import rotations
from estimator.models.inertia import euler_acceleration, matrix_of
from estimator.models.radar import beam_doppler
from estimator.models.star_tracker import attitude_residual, true_attitude
from estimator.propagation import Flow, Product
from estimator.residuals import Kernel
from estimator.unknowns import Manifold, NormalizedInertia, UnitQuaternion, Unknown, Vector

ANTENNA = Unknown("antenna_from_tracker", UnitQuaternion(), "rad", 0.035, frame="antenna",
                  description="antenna axes from star tracker axes")
ACTUATOR = Unknown("actuator_from_tracker", UnitQuaternion(), "rad", 0.035, frame="actuator",
                   description="actuator axes from star tracker axes")
INERTIA = Unknown("normalized_inertia", NormalizedInertia(), "1", 0.1, frame="tracker",
                  description="inertia tensor over its trace, tracker axes")


def inertia_trace_unknown(nominal: float) -> Unknown:
    """The trace of the inertia tensor (kg m2): what turns a commanded torque into an angular acceleration."""
    return Unknown("inertia_trace", Vector(1, ("",)), "kg m2", 0.1 * nominal,
                   description="trace of the inertia tensor")


def effect_unknown(effect: EffectInstance) -> Unknown:
    """The parameters of an effect as one vector unknown.

    Its yardstick of observability is the plausible range, not the typical size: an effect that is known worse than its
    typical size may still turn out large.
    """
    width = tuple(max(p.scale, 0.5 * (p.plausible[1] - p.plausible[0])) for p in effect.parameters)
    return Unknown(effect.name, Vector(len(effect.parameters), tuple(p.name for p in effect.parameters)),
                   effect.parameters[0].unit, width, description=f"parameters of the effect {effect.name}")


def environment_fields(rows: ca.SX) -> dict[str, ca.SX]:
    """The environment's part of a :class:`Sample` from the stacked rows of a table."""
    fields, a = {}, 0
    for name, size in ENVIRONMENT.items():
        fields[name] = rows[a : a + size]
        a += size
    return fields


ENVIRONMENT_ROWS = sum(ENVIRONMENT.values())


def _of_channel(effects: Sequence[EffectInstance], *channels: str) -> tuple[EffectInstance, ...]:
    return tuple(e for e in effects if e.channel in channels)


def _key(effects: Sequence[EffectInstance]) -> str:
    """A C identifier that tells which effects a kernel holds; the cache goes by the source, this is for people."""
    return "_".join(str(len(e.parameters)) for e in effects) or "plain"


@lru_cache(maxsize=64)
def doppler_kernel(beams: int, effects: tuple[EffectInstance, ...]) -> Kernel:
    """One Doppler epoch (``beams`` residuals, Hz): measured minus predicted shift.

    Inputs: ``antenna_from_tracker``; signal ``velocity`` (m/s, Earth-fixed); data ``attitude`` (4), ``earth_angle``,
    ``beam_direction`` (beams, 3), ``shift`` (beams, Hz), ``carrier`` (Hz) and, with effects, ``environment`` and
    ``rate``; noise ``attitude_error`` (3, rad).
    """
    mine = _of_channel(effects, "star_tracker", "doppler")
    data: list[tuple[str, int | tuple[int, int]]] = [
        ("attitude", 4), ("earth_angle", 1), ("beam_direction", (beams, 3)), ("shift", beams), ("carrier", 1)]
    if mine:
        data += [("environment", ENVIRONMENT_ROWS), ("rate", 3)]

    def build(x: dict[str, ca.SX]) -> ca.SX:
        error = ca.SX.zeros(3)
        sample = None
        in_inertial = rotations.rotate(rotations.about_z(x["earth_angle"]), x["velocity"])
        if mine:
            fields = environment_fields(x["environment"])
            fields["earth_fixed_velocity"] = in_inertial
            sample = Sample(**fields, attitude=x["attitude"], rate=x["rate"],
                            antenna_from_tracker=x["antenna_from_tracker"], beam_direction=x["beam_direction"],
                            carrier_frequency=x["carrier"])
            for e in _of_channel(mine, "star_tracker"):
                error += e.function(sample, x[e.name])
        tracker_from_inertial = true_attitude(x["attitude"], error, x["attitude_error"])
        in_tracker = rotations.rotate(tracker_from_inertial, in_inertial)
        in_antenna = rotations.rotate(x["antenna_from_tracker"], in_tracker)
        predicted = beam_doppler(x["beam_direction"], in_antenna, x["carrier"])
        if sample is not None:
            for e in _of_channel(mine, "doppler"):
                predicted += e.function(sample, x[e.name])
        return x["shift"] - predicted

    return Kernel(f"doppler_{beams}_{_key(mine)}", (ANTENNA, *(effect_unknown(e) for e in mine)),
                  (("velocity", Vector(3)),), data, (("attitude_error", 3),), build)


def rotation_state(effects: Sequence[EffectInstance]) -> tuple[tuple[str, Manifold], ...]:
    """The parts of the state of a rotation arc: attitude, rate, and the internal states of effects."""
    extra = tuple((f"state:{e.name}", Vector(e.state_size)) for e in effects if e.state_size)
    return (("attitude", UnitQuaternion()), ("rate", Vector(3)), *extra)


def equation_unknowns(commanded: bool, effects: Sequence[EffectInstance], trace_scale: float) -> tuple[Unknown, ...]:
    """Unknowns of the equation of motion beside the effects' own; ``effects`` are those in the equation."""
    shared = [INERTIA]
    if commanded or effects:
        shared.append(inertia_trace_unknown(trace_scale))
    if commanded:
        shared.append(ACTUATOR)
    return tuple(shared)


def equation_of_motion(commanded: bool, mine: tuple[EffectInstance, ...]) -> RightSide:
    """Right side of the equation of motion of a rotation arc with the torque and command effects ``mine``."""
    def derivative(x: dict[str, ca.SX], theta: dict[str, ca.SX], inputs: ca.SX, held: ca.SX, step: ca.SX,
                   fraction: ca.SX) -> ca.SX:
        inertia = matrix_of(theta["normalized_inertia"])
        rate, attitude = x["rate"], x["attitude"]
        pieces = [rotations.body_from_inertial_derivative(attitude, rate)]
        if not (commanded or mine):
            return ca.vertcat(*pieces, euler_acceleration(inertia, rate, ca.SX.zeros(3)))
        trace = theta["inertia_trace"]
        tensor = inertia * trace
        fields = environment_fields(inputs) if mine else {}
        command = held if commanded else ca.SX.zeros(3)
        actuator = theta["actuator_from_tracker"] if commanded else None
        common = {**fields, "attitude": attitude, "rate": rate, "inertia": tensor, "command": command,
                  "actuator_from_tracker": actuator, "step": step, "step_fraction": fraction}
        given = command
        state_rates: dict[str, ca.SX] = {}
        for e in _of_channel(mine, "command"):
            sample = Sample(**common, state=x.get(f"state:{e.name}"))
            given = given + e.function(sample, theta[e.name])
            if e.state_size:
                assert e.state_derivative is not None
                state_rates[e.name] = e.state_derivative(sample, theta[e.name])
        torque = rotations.rotate(rotations.conjugate(actuator), given) if commanded else ca.SX.zeros(3)
        for e in _of_channel(mine, "torque"):
            if not e.state_size:
                torque += e.function(Sample(**common), theta[e.name])
        other = torque - ca.cross(rate, ca.mtimes(tensor, rate))
        for e in _of_channel(mine, "torque"):
            if e.state_size:
                assert e.state_derivative is not None
                sample = Sample(**common, other_torque=other, state=x[f"state:{e.name}"])
                torque += e.function(sample, theta[e.name])
                state_rates[e.name] = e.state_derivative(sample, theta[e.name])
        pieces.append(euler_acceleration(tensor, rate, torque))
        pieces += [state_rates[e.name] for e in mine if e.state_size]
        return ca.vertcat(*pieces)

    return derivative


def substeps_of(effects: Sequence[EffectInstance], step: float) -> int:
    """Runge-Kutta steps inside a step of ``step`` s that the internal states of the effects need."""
    finest = min((e.resolution for e in effects if e.state_size), default=np.inf)
    return max(1, int(np.ceil(step / finest - 1e-9)))


@lru_cache(maxsize=64)
def rotation_flow(commanded: bool, effects: tuple[EffectInstance, ...], trace_scale: float, substeps: int) -> Flow:
    """The equation of motion of a rotation arc.

    Args:
        commanded: whether the arc has commanded torque (brings in the actuator frame and the inertia's trace).
        effects: effects of the torque and command channels.
        trace_scale: nominal trace of the inertia, kg m2 (scale of the unknown ``inertia_trace``).
        substeps: Runge-Kutta steps per node.
    """
    mine = _of_channel(effects, "torque", "command") if commanded else _of_channel(effects, "torque")
    shared = [*equation_unknowns(commanded, mine, trace_scale), *(effect_unknown(e) for e in mine)]
    return Flow(f"rotation_{'commanded' if commanded else 'free'}_{_key(mine)}", rotation_state(mine),
                ("attitude", "rate"), shared, ENVIRONMENT_ROWS if mine else 0, 3 if commanded else 0,
                equation_of_motion(commanded, mine), substeps)


@lru_cache(maxsize=256)
def rotation_drive(commanded: bool, effect: EffectInstance, trace_scale: float, substeps: int) -> Drive:
    """How a torque or command effect that is not in the equation of motion would drive a rotation arc."""
    state = rotation_state((effect,))
    return Drive(f"drive_{'commanded' if commanded else 'free'}_{_key((effect,))}", state, 2,
                 equation_unknowns(commanded, (effect,), trace_scale), effect_unknown(effect), ENVIRONMENT_ROWS,
                 3 if commanded else 0, equation_of_motion(commanded, (effect,)), substeps)


@lru_cache(maxsize=64)
def attitude_kernel(torque_effects: tuple[EffectInstance, ...], effects: tuple[EffectInstance, ...]) -> Kernel:
    """One star tracker sample of a rotation arc (3 residuals, rad, tracker axes).

    Inputs: signal ``state`` (of :func:`rotation_flow` with ``torque_effects``); data ``measured`` (4) and, with
    effects of the star tracker channel, ``environment``.
    """
    mine = _of_channel(effects, "star_tracker")
    manifold = Product(tuple(m for _, m in rotation_state(torque_effects)))
    data: list[tuple[str, int | tuple[int, int]]] = [("measured", 4)]
    if mine:
        data.append(("environment", ENVIRONMENT_ROWS))

    def build(x: dict[str, ca.SX]) -> ca.SX:
        attitude, rate = x["state"][:4], x["state"][4:7]
        error = ca.SX.zeros(3)
        if mine:
            sample = Sample(**environment_fields(x["environment"]), attitude=attitude, rate=rate)
            for e in mine:
                error += e.function(sample, x[e.name])
        return attitude_residual(x["measured"], attitude, error)

    return Kernel(f"attitude_{manifold.ambient}_{_key(mine)}", tuple(effect_unknown(e) for e in mine),
                  (("state", manifold),), data, (), build)


@lru_cache(maxsize=16)
def position_effect_kernel(effects: tuple[EffectInstance, ...]) -> Kernel:
    """Contribution of the GNSS channel's effects to one position (3, m, Earth-fixed).

    Inputs: data ``environment``, ``attitude`` (4), ``rate`` (3), ``inside_arc``.
    """
    mine = _of_channel(effects, "gnss")

    def build(x: dict[str, ca.SX]) -> ca.SX:
        sample = Sample(**environment_fields(x["environment"]), attitude=x["attitude"], rate=x["rate"],
                        inside_arc=x["inside_arc"])
        total = ca.SX.zeros(3)
        for e in mine:
            total += e.function(sample, x[e.name])
        return total

    return Kernel(f"position_{_key(mine)}", tuple(effect_unknown(e) for e in mine), (),
                  (("environment", ENVIRONMENT_ROWS), ("attitude", 4), ("rate", 3), ("inside_arc", 1)), (), build)
