"""Which question: how do antenna, star tracker and actuators sit against each other, and how is mass distributed?

``alignment_problem(campaign)`` makes the ONE joint nonlinear least-squares problem of a campaign: the relative
quaternion ``antenna_from_tracker``, the ``normalized_inertia``, the quaternion ``actuator_from_tracker`` with the
``inertia_trace``, the Fourier coefficients of the ``trajectory``, and per rotation arc the attitude and rate at its
start. Residuals: GNSS positions (compressed exactly), Doppler per beam with the tracker's noise in its covariance, and
the star tracker along every rotation arc. What a campaign cannot determine is left out of the problem and named.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from estimator.driven_motion import DrivenSignal
from estimator.effects.declaration import ENVIRONMENT, EffectInstance, Layout
from estimator.linear_block import LinearBlock, choose_degree, compress
from estimator.losses import Loss, Quadratic
from estimator.models.errors import RequestError, TooFewDataError
from estimator.models.fourier_trajectory import FourierFrame
from estimator.models.inertia import entries_of
from estimator.problem import Problem
from estimator.propagation import PropagatedSignal
from estimator.residuals import KernelResidual, Residual
from estimator.stretched_block import (
    FEWEST_SAMPLES,
    StretchedBlock,
    StretchedFrame,
    choose_degrees,
    compress_stretches,
    stretched_frame,
    stretches_of,
)
from estimator.trajectory_residual import TrajectoryResidual, felt_directions, trajectory_unknown
from estimator.unknowns import UnitQuaternion, Unknown, Vector
from problems.alignment.attitude_at_epochs import AttitudeAtEpochs, attitude_at_epochs
from problems.alignment.attitude_curve import AttitudeCurve, attitude_curves
from problems.alignment.campaign import Arc, Campaign
from problems.alignment.kernels import (
    ACTUATOR,
    ANTENNA,
    INERTIA,
    attitude_kernel,
    doppler_kernel,
    effect_unknown,
    position_effect_kernel,
    rotation_drive,
    rotation_flow,
    substeps_of,
)
from problems.alignment.starting_point import StartingPoint, starting_point

LONGEST_STEP = 0.5  # s between nodes of a rotation arc
ROTATION_PER_STEP = 0.02  # rad between nodes: the fourth-order step is then exact to 1e-11 rad over an arc
HELD_OUT_BLOCK = 10  # consecutive positions that are held out together
FEWEST_HELD_OUT_BLOCKS = 10  # in a stretch among several from which positions are held out
EARTH_GRAVITY = 3.986004418e14  # m3/s2
EDGE = 1e-6  # s outside of the positions' data that still counts as inside: rounding of times
FEWEST_ARC_SAMPLES = 4  # star tracker samples that make a rotation arc worth its six unknowns


@dataclass(frozen=True, eq=False)
class AlignmentModel:
    """A campaign with everything about it that does not depend on the effects in the model, computed once.

    Attributes:
        campaign: the flight data.
        loss: robust loss of every sample.
        degree: degree of the Fourier trajectory; None chooses it from the data.
        hold_out: fraction of every arc, its end, that is kept from the fit for proofs; of the positions, as many
            short blocks.
        given_frame: frame of the trajectory to use as it is, chosen on the same positions; None for a new one.
        dropped_positions: number of positions in stretches too short for a trajectory of their own.
    """

    campaign: Campaign
    loss: Loss
    degree: int | None = None
    hold_out: float = 0.0
    given_frame: FourierFrame | StretchedFrame | None = None
    dropped_positions: int = 0
    _tables: dict[bytes, np.ndarray] = field(default_factory=dict, repr=False)

    @cached_property
    def stretches(self) -> tuple[slice, ...]:
        """The stretches of positions, far apart, that have a trajectory each."""
        return stretches_of(self.campaign.gnss.time, orbital_period(self.campaign))

    @cached_property
    def coverage(self) -> StretchedFrame:
        """First and last time of the positions in each stretch (the frame itself may be longer than its data)."""
        return stretched_frame(self.campaign.gnss.time, self.stretches, 0)

    @cached_property
    def frame(self) -> FourierFrame | StretchedFrame:
        """The Fourier frame of the trajectory, or those of its stretches."""
        gnss = self.campaign.gnss
        if self.given_frame is not None:
            return self.given_frame
        if len(self.stretches) > 1:
            if self.degree is not None:
                return stretched_frame(gnss.time, self.stretches, self.degree)
            return choose_degrees(gnss.time, gnss.position, gnss.standard_deviation, self.stretches)[0]
        if self.degree is not None:
            return FourierFrame(float(gnss.time[0]), float(gnss.time[-1]), self.degree)
        return choose_degree(gnss.time, gnss.position, gnss.standard_deviation).frame

    def _compressed(self, weights: np.ndarray) -> LinearBlock | StretchedBlock:
        gnss = self.campaign.gnss
        if isinstance(self.frame, StretchedFrame):
            return compress_stretches(self.frame, gnss.time, gnss.position, weights)
        return compress(self.frame, gnss.time, gnss.position, weights)

    @cached_property
    def position_weights(self) -> np.ndarray:
        """Inverse variance of each position (n, 3), times the robust weight."""
        gnss = self.campaign.gnss
        weights = np.broadcast_to(1.0 / gnss.standard_deviation**2, gnss.position.shape).copy()
        weights[~self.used_positions] = 0.0
        if isinstance(self.loss, Quadratic):
            return weights
        robust = np.ones(len(gnss.time))
        for _ in range(12):
            block = self._compressed(weights * robust[:, None])
            renewed = self.loss.weight(np.sum(block.residuals() ** 2 * weights, axis=1))
            change = float(np.max(np.abs(renewed - robust)))
            robust = renewed
            if change < 1e-3:
                break
        return weights * robust[:, None]

    @cached_property
    def used_positions(self) -> np.ndarray:
        """Mask (n,) of the positions in the fit: all but one block in so many where data are held out.

        A stretch with few blocks, whose trajectory would suffer from the loss of one, keeps all of its positions.
        """
        time = self.campaign.gnss.time
        used = np.ones(len(time), dtype=bool)
        if self.hold_out <= 0:
            return used
        for s in self.stretches:
            if s.stop - s.start < FEWEST_HELD_OUT_BLOCKS * HELD_OUT_BLOCK and len(self.stretches) > 1:
                continue
            part = time[s]
            step = float(np.median(np.diff(part)))
            block = np.floor((part - part[0]) / (HELD_OUT_BLOCK * step) + 1e-9).astype(int)
            used[s] = np.floor((block + 1) * self.hold_out) == np.floor(block * self.hold_out)
        return used

    def used_of_arc(self, time: np.ndarray, start: float, stop: float) -> np.ndarray | None:
        """Mask (n,) of an arc's samples in the fit: all but its end where data are held out, None without."""
        if self.hold_out <= 0:
            return None
        return time <= stop - self.hold_out * (stop - start)

    @cached_property
    def block(self) -> LinearBlock | StretchedBlock:
        """The compressed positions."""
        return self._compressed(self.position_weights)

    def earth_angle(self, time: np.ndarray) -> np.ndarray:
        """Angle of the Earth-fixed frame about +z from inertial (n,), rad."""
        return self.campaign.earth_rotation_angle_at_epoch + self.campaign.earth_rotation_rate * np.asarray(time)

    def velocity(self, time: np.ndarray) -> np.ndarray:
        """Fitted Earth-fixed velocity (n, 3), m/s; where there are no positions, that of the nearest time with them."""
        return self.block.values(self._inside(time), 1)

    def position(self, time: np.ndarray) -> np.ndarray:
        """Fitted Earth-fixed position (n, 3), m; outside the positions as :meth:`velocity`."""
        return self.block.values(self._inside(time), 0)

    def _inside(self, time: np.ndarray) -> np.ndarray:
        return self.coverage.nearest(time)

    @cached_property
    def rotation_arcs(self) -> tuple[tuple[Arc, np.ndarray], ...]:
        """Rotation arcs with the indices of their star tracker samples, those with too few left out."""
        time = self.campaign.star_tracker.time
        found = []
        for kind in ("free_rotation", "torque_pulse"):
            for arc in self.campaign.arcs_of_kind(kind):
                index = np.flatnonzero((time >= arc.start - 1e-9) & (time <= arc.stop + 1e-9))
                if len(index) >= FEWEST_ARC_SAMPLES:
                    found.append((arc, index))
        return tuple(found)

    @cached_property
    def skipped_arcs(self) -> tuple[str, ...]:
        """Names of rotation arcs with too few star tracker samples."""
        used = {a.name for a, _ in self.rotation_arcs}
        return tuple(a.name for a in self.campaign.arcs if a.kind != "doppler" and a.name not in used)

    @cached_property
    def doppler_epochs(self) -> np.ndarray:
        """Indices of the Doppler epochs inside both the tracker's and the positions' data."""
        if self.campaign.doppler is None:
            return np.zeros(0, dtype=int)
        return np.flatnonzero(self._attitude_at_doppler.covered & self._inside_positions)

    @cached_property
    def _inside_positions(self) -> np.ndarray:
        assert self.campaign.doppler is not None
        return self.coverage.inside(self.campaign.doppler.time, EDGE)

    @cached_property
    def left_out(self) -> tuple[str, ...]:
        """What of the data has no part in the estimate, and why, in sentences."""
        found = []
        if self.dropped_positions:
            found.append(f"{self.dropped_positions} positions left out: stretches of fewer than {FEWEST_SAMPLES} "
                         "positions, far from all others, determine no trajectory")
        doppler = self.campaign.doppler
        if doppler is not None:
            no_attitude = ~self._attitude_at_doppler.covered
            count, total = int(no_attitude.sum()), len(doppler.time)
            if count:
                found.append(f"{count} of {total} Doppler epochs left out: no star tracker attitude there")
            outside = ~no_attitude & ~self._inside_positions
            if outside.any():
                first = doppler.time[outside][0]
                found.append(f"{int(outside.sum())} of {total} Doppler epochs left out: outside the "
                             f"{'stretches' if len(self.stretches) > 1 else 'span'} of the positions (the first at "
                             f"{first:.3f} s), where the trajectory would be a guess")
        return tuple(found)

    @cached_property
    def _attitude_at_doppler(self) -> AttitudeAtEpochs:
        assert self.campaign.doppler is not None
        return attitude_at_epochs(self.campaign.star_tracker, self.campaign.doppler.time)

    @cached_property
    def start(self) -> StartingPoint:
        """The starting point from the cheap closed forms."""
        campaign, doppler = self.campaign, self.campaign.doppler
        if doppler is not None and not self._inside_positions.all():
            m = self._inside_positions
            beams = doppler.beam_direction
            campaign = replace(campaign, doppler=replace(
                doppler, time=doppler.time[m], frequency_shift=doppler.frequency_shift[m],
                standard_deviation=np.broadcast_to(doppler.standard_deviation, doppler.frequency_shift.shape)[m],
                beam_direction=beams[m] if beams.ndim == 3 else beams))
        return starting_point(campaign, self.velocity, self.position)

    def tracker_velocity(self, antenna_from_tracker: np.ndarray | None = None) -> np.ndarray:
        """Unit vectors (n, 3) of the Earth-fixed velocity at the used Doppler epochs, tracker axes, from the measured
        attitude; with a mounting (4,) given, antenna axes."""
        from scipy.spatial.transform import Rotation

        assert self.campaign.doppler is not None
        time = self.campaign.doppler.time[self.doppler_epochs]
        angle = self.earth_angle(time)
        velocity = Rotation.from_rotvec(np.column_stack([0 * angle, 0 * angle, angle])).apply(self.velocity(time))
        turned = Rotation.from_quat(self._attitude_at_doppler.quaternion[self.doppler_epochs], scalar_first=True)
        if antenna_from_tracker is not None:
            turned = Rotation.from_quat(antenna_from_tracker, scalar_first=True) * turned
        velocity = turned.apply(velocity)
        return np.asarray(velocity / np.linalg.norm(velocity, axis=1, keepdims=True))

    @cached_property
    def session_of_epoch(self) -> tuple[np.ndarray, tuple[str, ...]]:
        """Index of the Doppler arc of each used epoch, and the arcs' names; stretches without an arc get their own."""
        assert self.campaign.doppler is not None
        time = self.campaign.doppler.time[self.doppler_epochs]
        arcs = self.campaign.arcs_of_kind("doppler")
        label = np.full(len(time), -1)
        for i, arc in enumerate(arcs):
            label[(time >= arc.start - 1e-6) & (time <= arc.stop + 1e-6)] = i
        names = [a.name for a in arcs]
        if (label < 0).any():
            label[label < 0] = len(names)
            names.append("outside the arcs")
        return label, tuple(names)

    @cached_property
    def layout(self) -> Layout:
        """What effects may need to know about the campaign."""
        campaign = self.campaign
        period = orbital_period(campaign)
        doppler = campaign.doppler
        beams = 0 if doppler is None else doppler.frequency_shift.shape[1]
        directions: tuple[tuple[float, float, float], ...] = ()
        if doppler is not None:
            mean = doppler.beam_direction if doppler.beam_direction.ndim == 2 else doppler.beam_direction.mean(axis=0)
            unit = mean / np.linalg.norm(mean, axis=1, keepdims=True)
            directions = tuple((float(d[0]), float(d[1]), float(d[2])) for d in unit)
        time = campaign.star_tracker.time
        return Layout(beams, tuple((a.start, a.stop) for a in campaign.arcs_of_kind("doppler")),
                      (float(min(campaign.gnss.time[0], time[0])), float(max(campaign.gnss.time[-1], time[-1]))),
                      period, (float(time[0]), float(time[-1])), directions,
                      tracker_stretches=_stretches(campaign.arcs, time))

    @cached_property
    def _curves(self) -> list[AttitudeCurve]:
        tracker, torque = self.campaign.star_tracker, self.campaign.torque
        edges = () if torque is None else tuple(np.concatenate([torque.start, torque.stop]).tolist())
        sigma = np.broadcast_to(tracker.standard_deviation, (len(tracker.time), 3))
        curves: list[AttitudeCurve] = []
        for arc in self.campaign.arcs:  # the rotation of one arc says nothing about that of the next
            inside = (tracker.time >= arc.start - 1e-6) & (tracker.time <= arc.stop + 1e-6)
            if np.count_nonzero(inside) >= FEWEST_ARC_SAMPLES:
                curves += attitude_curves(tracker.time[inside], tracker.quaternion[inside], sigma[inside],
                                          [e for e in edges if arc.start < e < arc.stop])
        return curves

    def smooth_rate(self, time: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
        """Angular rate (n, 3), rad/s, tracker axes, from smoothed attitude; ``otherwise`` where there is no curve.

        A rate differenced from single samples carries their noise, which stands in the residual of the same epoch
        too: an effect that depends on the rate would then seem present where there is none.
        """
        rate = np.array(otherwise, dtype=float)
        for curve in self._curves:
            inside = (time >= curve.start - 1e-6) & (time <= curve.stop + 1e-6)
            if inside.any():
                rate[inside] = curve.rate(np.clip(time[inside], curve.start, curve.stop))
        return rate

    def smooth_attitude(self, time: np.ndarray) -> np.ndarray:
        """Smoothed ``tracker_from_inertial`` (n, 4) at the times (n) s; NaN outside the arcs' tracker data."""
        quaternion = np.full((len(time), 4), np.nan)
        for curve in self._curves:
            inside = (time >= curve.start - 1e-6) & (time <= curve.stop + 1e-6)
            if inside.any():
                quaternion[inside] = curve.quaternion(np.clip(time[inside], curve.start, curve.stop))
        return quaternion

    def environment(self, time: np.ndarray) -> np.ndarray:
        """Table (n, rows) of everything about the environment that an effect may depend on, along the orbit.

        Kept, and not to be written to: problems with other effects ask for the same times again and again.
        """
        time = np.asarray(time, dtype=float)
        key = time.tobytes()
        if key not in self._tables:
            self._tables[key] = self._environment(time)
            self._tables[key].flags.writeable = False
        return self._tables[key]

    def _environment(self, time: np.ndarray) -> np.ndarray:
        from scipy.spatial.transform import Rotation

        from estimator.models.environment import environment_table

        angle = self.earth_angle(time)
        inertial_from_fixed = Rotation.from_rotvec(np.column_stack([0 * angle, 0 * angle, angle]))
        fixed = self.position(time)
        spin = np.array([0.0, 0.0, self.campaign.earth_rotation_rate])
        position = inertial_from_fixed.apply(fixed)
        velocity = inertial_from_fixed.apply(self.velocity(time) + np.cross(spin, fixed))
        table = environment_table(self.campaign.epoch, time, position, velocity,
                                  self.campaign.earth_rotation_angle_at_epoch, self.campaign.earth_rotation_rate)
        return np.column_stack([np.asarray(table[name]).reshape(len(time), size)
                                for name, size in ENVIRONMENT.items()])

    def effect_instances(self, names: Iterable[str]) -> tuple[EffectInstance, ...]:
        """The instances of the effects asked for by name; a family name gives all of its instances.

        Raises:
            RequestError: no effect of that name exists on this campaign.
        """
        names = tuple(names)
        if not names:
            return ()
        from estimator.effects.library import load

        registered = load()
        found: list[EffectInstance] = []
        for name in names:
            family = registered.get(name.split(":")[0])
            if family is None:
                raise RequestError(f"no effect is named {name!r}", where="effects",
                                   remedy="choose from " + ", ".join(registered))
            present = family.instances(self.layout)
            chosen = [e for e in present if name in (e.name, e.family)]
            if not chosen:
                raise RequestError(f"the effect {name!r} does not exist on this campaign", where="effects",
                                   remedy="choose from " + (", ".join(e.name for e in present) or "other effects"))
            found += [e for e in chosen if e not in found]
        return tuple(found)


def orbital_period(campaign: Campaign) -> float:
    """Period (s) of a circular orbit at the median distance of the positions from the Earth's centre."""
    radius = float(np.median(np.linalg.norm(campaign.gnss.position, axis=1)))
    return float(2 * np.pi * np.sqrt(radius**3 / EARTH_GRAVITY))


def alignment_model(campaign: Campaign, *, loss: Loss | None = None, degree: int | None = None,
                    hold_out: float = 0.0, frame: FourierFrame | StretchedFrame | None = None) -> AlignmentModel:
    """Prepare a campaign for the joint problem.

    Args:
        campaign: checked flight data.
        loss: robust loss of every sample; default quadratic.
        degree: degree of the Fourier trajectory (of each stretch); None chooses it from the data.
        hold_out: fraction of the data that is kept from the fit for proofs.
        frame: of a model of the same positions, to be used again; ``degree`` then has no say.

    Raises:
        RequestError: a fraction outside 0 to 0.9.
        TooFewDataError: fewer than four positions, all in all or in every stretch.
    """
    if len(campaign.gnss.time) < FEWEST_SAMPLES:
        raise TooFewDataError("too few positions for a trajectory", where="gnss/position",
                              value=len(campaign.gnss.time), limit=f"at least {FEWEST_SAMPLES}")
    if not 0 <= hold_out <= 0.9:
        raise RequestError("the held-out fraction makes no sense", where="hold_out", value=hold_out, limit="0 to 0.9")
    positions = len(campaign.gnss.time)
    campaign = _without_short_stretches(campaign)
    dropped = positions - len(campaign.gnss.time)
    return AlignmentModel(campaign, loss or Quadratic(), degree, hold_out, frame, dropped)


def _without_short_stretches(campaign: Campaign) -> Campaign:
    """The campaign without positions that are too few, far from all others."""
    gnss = campaign.gnss
    stretches = stretches_of(gnss.time, orbital_period(campaign))
    sizes = [s.stop - s.start for s in stretches]
    if min(sizes) >= FEWEST_SAMPLES:
        return campaign
    if max(sizes) < FEWEST_SAMPLES:
        raise TooFewDataError("no stretch of positions is long enough for a trajectory", where="gnss/time",
                              value=f"{len(sizes)} stretches of at most {max(sizes)} positions",
                              limit=f"at least {FEWEST_SAMPLES} positions without a long gap")
    keep = np.concatenate([np.full(n, n >= FEWEST_SAMPLES) for n in sizes])
    shorter = replace(gnss, time=gnss.time[keep], position=gnss.position[keep],
                      standard_deviation=np.broadcast_to(gnss.standard_deviation, gnss.position.shape)[keep])
    return _without_short_stretches(replace(campaign, gnss=shorter))


def alignment_problem(model: AlignmentModel, effects: Sequence[str] = (), *,
                      candidates: Sequence[str] = ()) -> Problem:
    """The joint problem of a prepared campaign.

    Args:
        model: the prepared campaign.
        effects: names of effects whose parameters are estimated with everything else.
        candidates: names of effects that are in the kernels and held at zero, for score tests. Torques among them
            act to first order only (:class:`estimator.driven_motion.DrivenSignal`).

    Raises:
        RequestError: an unknown effect.
    """
    active = model.effect_instances(effects)
    dormant = tuple(e for e in model.effect_instances(candidates) if e not in active)
    # One order whatever is active, so that kernels are shared and found in the cache.
    everything = tuple(sorted((*active, *dormant), key=lambda e: e.name))
    unknowns: dict[str, Unknown] = {}
    residuals: list[Residual] = []
    start: dict[str, np.ndarray] = {}
    starting = model.start

    def need(unknown: Unknown, value: np.ndarray) -> None:
        unknowns.setdefault(unknown.name, unknown)
        start.setdefault(unknown.name, np.asarray(value, dtype=float))

    positions = _positions(model, everything)
    has_doppler = len(model.doppler_epochs) > 0
    if has_doppler:
        need(ANTENNA, starting.antenna_from_tracker)
    if model.rotation_arcs:
        need(INERTIA, _entries(starting.normalized_inertia))
    doppler = _doppler(model, everything, positions) if has_doppler else None
    moving = frozenset(e.name for e in active)
    rotations = [_rotation(model, arc, index, everything, moving) for arc, index in model.rotation_arcs]
    for residual, _ in rotations:
        for unknown in residual.unknowns:
            if unknown.name == "inertia_trace":
                need(unknown, np.array([starting.inertia_trace]))
            elif unknown.name == ACTUATOR.name:
                need(ACTUATOR, starting.actuator_from_tracker)
    for e in everything:
        if any(u.name == e.name for r in [positions, doppler, *(r for r, _ in rotations)] if r for u in r.unknowns):
            need(effect_unknown(e), _effect_start(e))
    for residual, arc in rotations:
        attitude, rate = starting.arc_states[arc.name]
        for unknown, value in zip(_arc_unknowns(arc), (attitude, rate), strict=True):
            need(unknown, value)
        residuals.append(residual)
    need(positions.trajectory, np.zeros(positions.trajectory.manifold.tangent))
    ordered: list[Residual] = [positions, *([doppler] if doppler else []), *residuals]
    held = {e.name for e in dormant if e.name in unknowns}
    commanded = any(u.name == ACTUATOR.name for u in unknowns.values())
    if "inertia_trace" in unknowns and not commanded:
        held.add("inertia_trace")  # without a commanded torque nothing has the unit of a torque
    return Problem(
        unknowns=tuple(unknowns.values()), residuals=tuple(ordered), start=start, held=frozenset(held),
        rebuild=lambda names: alignment_problem(model, names, candidates=candidates),
        effects=tuple(e.name for e in active),
    )


def _entries(normalized: np.ndarray) -> np.ndarray:
    return entries_of(normalized / np.trace(normalized))


def _stretches(arcs: Sequence[Arc], time: np.ndarray) -> tuple[tuple[float, float], ...]:
    """First and last star tracker sample of each arc, in order of time; of arcs that overlap, together."""
    found: list[tuple[float, float]] = []
    for arc in sorted(arcs, key=lambda a: a.start):
        inside = time[(time >= arc.start - 1e-6) & (time <= arc.stop + 1e-6)]
        if len(inside) < 2:
            continue
        start, stop = float(inside[0]), float(inside[-1])
        if found and start <= found[-1][1]:
            found[-1] = (found[-1][0], max(stop, found[-1][1]))
        else:
            found.append((start, stop))
    return tuple(found)


def _effect_start(effect: EffectInstance) -> np.ndarray:
    """Zero, or the middle of the range where the parameter is searched."""
    return np.array([0.0 if p.search is None else p.search.middle() for p in effect.parameters])


def _arc_unknowns(arc: Arc) -> tuple[Unknown, Unknown]:
    return (
        Unknown(f"attitude:{arc.name}", UnitQuaternion(), "rad", 0.1, nuisance=True, frame="tracker",
                description=f"attitude at the start of {arc.name}"),
        Unknown(f"rate:{arc.name}", Vector(3, ("x", "y", "z")), "rad/s", 0.01, nuisance=True,
                description=f"angular rate at the start of {arc.name}, tracker axes"),
    )


def _positions(model: AlignmentModel, effects: tuple[EffectInstance, ...]) -> TrajectoryResidual:
    gnss = model.campaign.gnss
    epochs = []
    if len(model.doppler_epochs):
        assert model.campaign.doppler is not None
        epochs.append((model._inside(model.campaign.doppler.time[model.doppler_epochs]), 1))
    directions = felt_directions(model.block, epochs)
    arcs = np.zeros(len(gnss.time), dtype=bool)
    for arc in model.campaign.arcs:
        arcs |= (gnss.time >= arc.start - 1e-6) & (gnss.time <= arc.stop + 1e-6)
    kernel, data = None, {"inside_arc": arcs.astype(float)}  # where a disagreement is looked for, without effects too
    if any(e.channel == "gnss" for e in effects):
        kernel = position_effect_kernel(tuple(e for e in effects if e.channel == "gnss"))
        tracker = model.campaign.star_tracker
        try:
            attitude = attitude_at_epochs(tracker, gnss.time)
            quaternion, inside = attitude.quaternion, attitude.covered.astype(float)
            rate = model.smooth_rate(gnss.time, attitude.rate)
        except ValueError:
            quaternion = np.tile([1.0, 0.0, 0.0, 0.0], (len(gnss.time), 1))
            rate, inside = np.zeros((len(gnss.time), 3)), np.zeros(len(gnss.time))
        data = {"environment": model.environment(gnss.time), "attitude": quaternion, "rate": rate,
                "inside_arc": inside * arcs}
    trajectory = trajectory_unknown(directions, displaced=kernel is not None)
    return TrajectoryResidual("gnss", "gnss", "m", trajectory, model.block, directions, gnss.time,
                              gnss.position, model.position_weights,
                              np.broadcast_to(gnss.standard_deviation, gnss.position.shape), kernel, data)


def _doppler(model: AlignmentModel, effects: tuple[EffectInstance, ...],
             positions: TrajectoryResidual) -> KernelResidual:
    doppler = model.campaign.doppler
    assert doppler is not None
    index = model.doppler_epochs
    time = doppler.time[index]
    beams = doppler.frequency_shift.shape[1]
    kernel = doppler_kernel(beams, tuple(e for e in effects if e.channel in ("star_tracker", "doppler")))
    attitude = model._attitude_at_doppler
    directions = doppler.beam_direction
    per_epoch = directions[index] if directions.ndim == 3 else np.broadcast_to(directions, (len(index), beams, 3))
    data = {
        "attitude": attitude.quaternion[index],
        "earth_angle": model.earth_angle(time)[:, None],
        "beam_direction": per_epoch,
        "shift": doppler.frequency_shift[index],
        "carrier": np.full((len(index), 1), doppler.carrier_frequency),
    }
    if "environment" in kernel.labels:
        data["environment"] = model.environment(time)
        data["rate"] = model.smooth_rate(time, attitude.rate[index])
    arc, names = model.session_of_epoch
    sigma = np.broadcast_to(doppler.standard_deviation, doppler.frequency_shift.shape)[index]
    return KernelResidual(
        "doppler", "doppler", "Hz", kernel, (positions.signal("velocity", model._inside(time), 1),), data, sigma,
        time, arc, names, noise={"attitude_error": attitude.standard_deviation[index]}, loss=model.loss,
        accepted=_used_in_sessions(model, time, arc),
    )


def _used_in_sessions(model: AlignmentModel, time: np.ndarray, session: np.ndarray) -> np.ndarray | None:
    if model.hold_out <= 0:
        return None
    used = np.ones(len(time), dtype=bool)
    for label in np.unique(session):
        inside = session == label
        mask = model.used_of_arc(time[inside], float(time[inside][0]), float(time[inside][-1]))
        used[inside] = True if mask is None else mask
    return used


def _rotation(model: AlignmentModel, arc: Arc, index: np.ndarray, effects: tuple[EffectInstance, ...],
              in_motion: frozenset[str]) -> tuple[KernelResidual, Arc]:
    tracker, torque = model.campaign.star_tracker, model.campaign.torque
    time = tracker.time[index]
    _, rate = model.start.arc_states[arc.name]
    longest = min(LONGEST_STEP, ROTATION_PER_STEP / max(float(np.linalg.norm(rate)), 1e-9))
    switches = np.zeros(0)
    if torque is not None:
        both = np.concatenate([torque.start, torque.stop])
        switches = both[(both > arc.start) & (both < time[-1])]
    nodes, sample_nodes = _nodes(min(arc.start, float(time[0])), time, switches, longest)
    middle = 0.5 * (nodes[:-1] + nodes[1:])
    command = np.zeros((len(middle), 3))
    if torque is not None:
        for start, stop, value in zip(torque.start, torque.stop, torque.command, strict=True):
            command[(middle > start) & (middle < stop)] += value
    commanded = bool(np.any(command))
    turning = tuple(e for e in effects if e.channel in (("torque", "command") if commanded else ("torque",)))
    moving = tuple(e for e in turning if e.name in in_motion)
    driving = tuple(e for e in turning if e.name not in in_motion)
    trace = float(np.trace(model.campaign.nominal.inertia))
    step = float(np.max(np.diff(nodes), initial=0.0))
    environment = model.environment(nodes) if turning else np.zeros((len(nodes), 0))
    plain = PropagatedSignal(
        "state", rotation_flow(commanded, moving, trace, substeps_of(moving, step)), _arc_unknowns(arc), nodes,
        environment if moving else np.zeros((len(nodes), 0)), command if commanded else np.zeros((len(middle), 0)),
        sample_nodes)
    signal: PropagatedSignal | DrivenSignal = plain
    if driving:
        drives = tuple(rotation_drive(commanded, e, trace, substeps_of((e,), step)) for e in driving)
        searched = tuple(np.array([p.search is not None for p in e.parameters]) for e in driving)
        signal = DrivenSignal(plain, drives, searched, environment)
    kernel = attitude_kernel(moving, tuple(e for e in effects if e.channel == "star_tracker"))
    data = {"measured": tracker.quaternion[index]}
    if "environment" in kernel.labels:
        data["environment"] = model.environment(time)
    sigma = np.broadcast_to(tracker.standard_deviation, (len(tracker.time), 3))[index]
    residual = KernelResidual(f"star_tracker:{arc.name}", "star_tracker", "rad", kernel, (signal,), data, sigma, time,
                              np.zeros(len(time), dtype=int), (arc.name,), loss=model.loss,
                              accepted=model.used_of_arc(time, float(time[0]), float(time[-1])))
    return residual, arc


def _nodes(start: float, samples: np.ndarray, switches: np.ndarray, longest: float) -> tuple[np.ndarray, np.ndarray]:
    """Integration nodes: the start, every sample, every switch of the torque, and no step longer than ``longest``."""
    required = np.unique(np.concatenate([[start], samples, switches]))
    while (close := np.flatnonzero(np.diff(required) <= 1e-9)).size:
        required = np.delete(required, close[:1] + 1 if np.any(np.diff(close) == 1) else close + 1)
    width = np.diff(required)
    steps = np.ceil(width / longest - 1e-9).astype(int)
    within = np.arange(int(steps.sum())) - np.repeat(np.cumsum(steps) - steps, steps) + 1
    nodes = np.repeat(required[:-1], steps) + np.repeat(width / steps, steps) * within
    nodes[np.cumsum(steps) - 1] = required[1:]
    nodes = np.concatenate([required[:1], nodes])
    index = np.searchsorted(nodes, samples - 1e-9)
    return nodes, np.minimum(index, len(nodes) - 1)

