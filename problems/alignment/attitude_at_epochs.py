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
        rate: (n, 3) rad/s, tracker axes, from neighbouring samples (for effects alone; noisy).
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
    for k in range(len(epochs)):
        if not covered[k]:
            continue
        window = _window(time, stretch, epochs[k], int(nearest[k]))
        reference = Rotation.from_quat(tracker.quaternion[nearest[k]], scalar_first=True)
        # Rotation vectors of each neighbour against the nearest sample, in tracker axes.
        vectors = (Rotation.from_quat(tracker.quaternion[window], scalar_first=True) * reference.inv()).as_rotvec()
        offsets = time[window] - epochs[k]
        value_weights, slope_weights = _lagrange(offsets)
        rate[k] = -(slope_weights @ vectors)
        if not coincident[k]:
            quaternion[k] = (Rotation.from_rotvec(value_weights @ vectors) * reference).as_quat(scalar_first=True)
            sigma[k] = np.sqrt((value_weights**2) @ tracker.standard_deviation[window] ** 2)
    return AttitudeAtEpochs(quaternion, sigma, rate, covered)


def _window(time: np.ndarray, stretch: np.ndarray, epoch: float, nearest: int) -> np.ndarray:
    first = int(np.searchsorted(stretch, stretch[nearest]))
    last = int(np.searchsorted(stretch, stretch[nearest], side="right"))
    size = min(NEIGHBOURS, last - first)
    start = int(np.clip(np.searchsorted(time, epoch) - size // 2, first, last - size))
    return np.arange(start, start + size)


def _lagrange(offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights of the value and of the slope at zero of the polynomial through samples at ``offsets``."""
    size = len(offsets)
    if size == 1:
        return np.ones(1), np.zeros(1)
    scale = float(np.max(np.abs(offsets))) or 1.0
    vandermonde = np.vander(offsets / scale, size, increasing=True)
    inverse = np.linalg.inv(vandermonde)
    return inverse[0], inverse[1] / scale
