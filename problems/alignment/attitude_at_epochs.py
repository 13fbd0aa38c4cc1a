"""The measured attitude at the epochs of the radar: the tracker's own sample where there is one, else interpolation.

Interpolation is a Lagrange polynomial of up to six neighbouring samples in the rotation vector against the nearest of
them. The weights of the polynomial carry the noise over, so an interpolated attitude has its own standard deviation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.models.errors import MissingDataError
from problems.alignment.campaign import TrackerSeries

COINCIDENT = 1e-6  # s, times closer than this are one epoch
NEIGHBOURS = 6
LONGEST_GAP_STEPS = 3.5  # gaps longer than this many median steps are not interpolated across


@dataclass(frozen=True)
class AttitudeAtEpochs:
    """Measured attitude at given epochs.

    Attributes:
        quaternion: (n, 4) ``tracker_from_inertial``.
        standard_deviation: (n, 3) rad about the tracker axes.
        rate: (n, 3) rad/s, tracker axes, from neighbouring samples (noisy; where no smoothed curve exists).
        covered: (n,) False where the tracker has no data near the epoch.
    """

    quaternion: np.ndarray
    standard_deviation: np.ndarray
    rate: np.ndarray
    covered: np.ndarray


def attitude_at_epochs(tracker: TrackerSeries, epochs: np.ndarray) -> AttitudeAtEpochs:
    """Attitude at ``epochs`` (n,) s from the tracker's samples.

    Raises:
        MissingDataError: no epoch at all lies inside the tracker's data.
    """
    time, count = tracker.time, len(tracker.time)
    step = float(np.median(np.diff(time))) if count > 1 else 0.0
    right = np.clip(np.searchsorted(time, epochs), 1, max(count - 1, 1))
    left = right - 1
    if count == 1:
        left = right = np.zeros(len(epochs), dtype=int)
    nearest = np.where(np.abs(epochs - time[left]) <= np.abs(time[right] - epochs), left, right)
    coincident = np.abs(time[nearest] - epochs) <= COINCIDENT
    epochs = np.asarray(epochs, dtype=float)
    between = (epochs >= time[left]) & (epochs <= time[right]) & (time[right] - time[left] <= LONGEST_GAP_STEPS * step)
    covered = coincident | between
    if not covered.any():
        raise MissingDataError("no star tracker attitude at any Doppler epoch", where="star_tracker/time",
                               value=f"{time[0]:.3f} s to {time[-1]:.3f} s",
                               limit=f"Doppler from {epochs[0]:.3f} s to {epochs[-1]:.3f} s",
                               remedy="check that both series count seconds after the same epoch")
    stretch = np.concatenate([[0], np.cumsum(np.diff(time) > LONGEST_GAP_STEPS * step)])
    quaternion = tracker.quaternion[nearest].copy()
    sigma = tracker.standard_deviation[nearest].copy()
    rate = np.zeros((len(epochs), 3))
    first = np.searchsorted(stretch, stretch[nearest])
    last = np.searchsorted(stretch, stretch[nearest], side="right")
    sizes = np.minimum(NEIGHBOURS, last - first)
    for size in np.unique(sizes[covered]):
        chosen = np.flatnonzero(covered & (sizes == size))
        begin = np.searchsorted(time, epochs[chosen]) - size // 2
        begin = np.clip(begin, first[chosen], last[chosen] - size)
        window = begin[:, None] + np.arange(size)
        reference = Rotation.from_quat(tracker.quaternion[np.repeat(nearest[chosen], size)], scalar_first=True)
        # Rotation vectors of each neighbour against the nearest sample, in tracker axes.
        neighbours = Rotation.from_quat(tracker.quaternion[window.ravel()], scalar_first=True)
        vectors = (neighbours * reference.inv()).as_rotvec().reshape(len(chosen), size, 3)
        value_weights, slope_weights = _lagrange(time[window] - epochs[chosen][:, None])
        rate[chosen] = -np.einsum("nk,nki->ni", slope_weights, vectors)
        between_samples = ~coincident[chosen]
        moved = chosen[between_samples]
        if len(moved):
            weights = value_weights[between_samples]
            turn = Rotation.from_rotvec(np.einsum("nk,nki->ni", weights, vectors[between_samples]))
            base = Rotation.from_quat(tracker.quaternion[nearest[moved]], scalar_first=True)
            quaternion[moved] = (turn * base).as_quat(scalar_first=True)
            variances = tracker.standard_deviation[window[between_samples]] ** 2
            sigma[moved] = np.sqrt(np.einsum("nk,nki->ni", weights**2, variances))
    return AttitudeAtEpochs(quaternion, sigma, rate, covered)


def _lagrange(offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights (n, k) of the value and of the slope at zero of the polynomials through samples at ``offsets`` (n, k)."""
    size = offsets.shape[1]
    if size == 1:
        return np.ones_like(offsets), np.zeros_like(offsets)
    scale = np.max(np.abs(offsets), axis=1, keepdims=True)
    vandermonde = (offsets / scale)[:, :, None] ** np.arange(size)
    inverse = np.linalg.inv(vandermonde)
    return inverse[:, 0, :], inverse[:, 1, :] / scale
