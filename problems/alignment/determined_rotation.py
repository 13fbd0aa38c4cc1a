"""What is determined of a mounting that is not determined altogether: the turns about the axes that the data do see.

Where the data leave a rotation open (one acquisition of a zero-Doppler steered radar leaves the turn about the
velocity), the quaternion as a whole has no sigma. The turns away from the design value about the other axes have, and
so has the squint, the angle by which the beams are turned out of the plane across the velocity.

Two sigmas are given. The one from the declared noise takes the errors of all samples for independent. The one from the
scatter takes the residuals as they are, with whatever correlation they have along a session: the covariance of the sum
of scores is estimated from the scores themselves (the sandwich covariance), over whole sessions where there are
enough of them, else with Bartlett weights over a third of a session (Newey and West, Econometrica 55 (1987) 703). It is
itself uncertain by tens of per cent, and blind to what changes from one campaign to the next.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.estimate import Estimate
from estimator.residuals import KernelResidual
from estimator.unknowns import offsets

ENOUGH_SESSIONS = 6
"""Sessions from which the scatter between whole sessions is taken."""
PART_OF_SESSION = 1 / 3
"""Length of a session over which errors may be correlated, where there are few sessions."""
_PART_OF_WEAK = 0.1  # length of an unknown's part in a weak direction (unit vector) from which it takes part


@dataclass(frozen=True)
class DeterminedTurn:
    """One turn of a mounting away from its design value that the data determine.

    Attributes:
        axis: (3,) unit vector, axes of the frame on the left of ``x_from_y``.
        angle: rad, about ``axis``.
        sigma: rad, from the declared noise, errors independent.
        scatter: rad, standard deviation from the residuals' own scatter; NaN where there are too few.
    """

    axis: np.ndarray
    angle: float
    sigma: float
    scatter: float

    def as_dict(self) -> dict[str, object]:
        """The machine-readable form."""
        return {"axis": self.axis, "angle_rad": self.angle, "sigma_rad": self.sigma, "sigma_scatter_rad": self.scatter}


def undetermined_axes(estimate: Estimate, name: str) -> np.ndarray:
    """Axes (k, 3), orthonormal, of the turns of a rotation unknown that the data do not determine."""
    columns = estimate.columns(name)
    scales = np.concatenate([np.zeros(0), *(u.scales for u in estimate.unknowns)])[columns]
    parts = [w.vector[columns] * scales / scales.max() for w in estimate.weak]
    parts = [p for p in parts if np.linalg.norm(p) > _PART_OF_WEAK]
    if not parts:
        return np.zeros((0, 3))
    _, size, axes = np.linalg.svd(np.array(parts), full_matrices=False)
    return np.asarray(axes[size > _PART_OF_WEAK])


def determined_turns(estimate: Estimate, name: str, design: np.ndarray) -> tuple[DeterminedTurn, ...]:
    """The independent turns away from ``design`` (4,) that the data determine, best determined first.

    Empty where the rotation is determined altogether, or not at all.
    """
    held = undetermined_axes(estimate, name)
    if len(held) in (0, 3):
        return ()
    basis = np.linalg.svd(held)[2][len(held) :]
    columns = estimate.columns(name)
    covariance = basis @ estimate.covariance[columns, columns] @ basis.T
    spread = basis @ scatter_covariance(estimate)[columns, columns] @ basis.T
    variances, vectors = np.linalg.eigh(covariance)
    offset = _offset(estimate.values[name], design)
    turns = []
    for variance, vector in zip(variances, vectors.T, strict=True):
        axis = vector @ basis
        axis = axis if axis[np.argmax(np.abs(axis))] > 0 else -axis
        turns.append(DeterminedTurn(axis, float(axis @ offset), float(np.sqrt(max(variance, 0.0))),
                                    float(np.sqrt(max(vector @ spread @ vector, 0.0)))))
    return tuple(turns)


def squint(estimate: Estimate, name: str, design: np.ndarray, beams: np.ndarray,
           direction: np.ndarray) -> DeterminedTurn | None:
    """The turn of the beams out of the plane across the velocity, mean over all epochs and beams.

    Args:
        estimate: of the problem.
        name: of the rotation ``antenna_from_tracker``.
        design: (4,) its design value.
        beams: (n, b, 3) unit vectors, antenna axes.
        direction: (n, 3) unit vectors of the velocity, antenna axes (with the estimated mounting).

    Returns:
        The axis across the mean beam and the velocity about which the turn is counted, the mean angle (positive where
        the beams look further ahead than by design) with its sigmas; None where the axis is not determined.
    """
    lever = np.mean(np.cross(direction[:, None, :], beams), axis=(0, 1))  # change of the mean angle by each turn
    held = undetermined_axes(estimate, name)
    columns = estimate.columns(name)
    length = float(np.linalg.norm(lever))
    if length < 1e-3 or (len(held) and np.linalg.norm(held @ lever) > _PART_OF_WEAK * length):
        return None
    turned = Rotation.from_quat(estimate.values[name], scalar_first=True)
    back = Rotation.from_quat(design, scalar_first=True) * turned.inv()
    ahead = np.einsum("nbi,ni->nb", beams, direction)
    before = np.einsum("nbi,ni->nb", beams, back.apply(direction))
    variance = lever @ estimate.covariance[columns, columns] @ lever
    spread = lever @ scatter_covariance(estimate)[columns, columns] @ lever
    return DeterminedTurn(lever / length, float(np.mean(ahead - before)), float(np.sqrt(max(variance, 0.0))),
                          float(np.sqrt(max(spread, 0.0))))


def scatter_covariance(estimate: Estimate) -> np.ndarray:
    """Covariance (p, p) of the free unknowns from the scatter of the residuals, correlated along each session.

    Only residuals with samples in time take part (the compressed positions keep their declared noise); see the module
    for the two ways. Unknowns that each session has for itself come out too small.
    """
    free = offsets(estimate.unknowns)
    size = len(estimate.covariance)
    middle = np.zeros((size, size))
    for residual, part in zip(estimate.problem.residuals, estimate.parts, strict=True):
        slopes = np.zeros((*part.whitened.shape, size))
        position = 0
        for unknown in part.columns:
            width = unknown.manifold.tangent
            if unknown.name in free:
                slopes[:, :, free[unknown.name]] = part.jacobian[:, :, position : position + width]
            position += width
        if isinstance(residual, KernelResidual):
            scores = np.einsum("nm,nmp->np", part.whitened, slopes) * part.weight[:, None]
            middle += _sum_of_scores(scores, residual.arc, residual.time)
        else:
            rows = slopes.reshape(-1, size)
            middle += rows.T @ rows
    # estimate.covariance is the inverse of the Gauss-Newton matrix, with no part along what is not determined
    return np.asarray(estimate.covariance @ middle @ estimate.covariance)


def _sum_of_scores(scores: np.ndarray, session: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Estimated covariance of the sum of scores (n, p)."""
    labels = np.unique(session)
    count = len(scores)
    if len(labels) >= ENOUGH_SESSIONS:
        sums = np.array([scores[session == k].sum(axis=0) for k in labels])
        return np.asarray(sums.T @ sums * len(labels) / (len(labels) - 1))
    total = np.zeros((scores.shape[1], scores.shape[1]))
    for k in labels:
        inside = np.flatnonzero(session == k)
        reach = max(PART_OF_SESSION * float(np.ptp(time[inside])), 1e-9)
        weight = np.maximum(1 - np.abs(np.subtract.outer(time[inside], time[inside])) / reach, 0.0)
        total += scores[inside].T @ weight @ scores[inside]
    return total * count / max(count - 3, 1)


def _offset(rotation: np.ndarray, design: np.ndarray) -> np.ndarray:
    """Rotation vector (3,) of ``rotation o conjugate(design)``."""
    turned = Rotation.from_quat(rotation, scalar_first=True)
    return np.asarray((turned * Rotation.from_quat(design, scalar_first=True).inv()).as_rotvec())
