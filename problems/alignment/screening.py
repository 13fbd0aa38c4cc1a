"""Gross outliers, found without a model of the motion: samples that no smooth curve through their neighbours explains.

Each stretch of each channel is fitted by a least-squares spline of degree five with a knot every few samples; the fit
is iterated with Tukey's biweight, and a sample further from it than ``THRESHOLD`` standard deviations (the declared
one, or the robust spread of the stretch where that is larger) is rejected. An effect that the model misses is smooth
and survives; a bit flip does not. Rejected samples are counted per channel and reported, never silently dropped.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_lsq_spline

from problems.alignment.campaign import Campaign

THRESHOLD = 7.0  # standard deviations
SAMPLES_PER_KNOT = 8
FEWEST = 40  # samples of a stretch that can be screened without a model
NEIGHBOURS = 7  # samples of a running median of residuals
LONGEST_GAP_STEPS = 3.5
DEGREE = 5


@dataclass(frozen=True)
class Screening:
    """Samples kept per channel.

    Attributes:
        gnss, doppler, star_tracker: boolean masks (n,), True for samples that are kept.
    """

    gnss: np.ndarray
    doppler: np.ndarray
    star_tracker: np.ndarray

    def rejected(self) -> dict[str, int]:
        """Number of rejected samples per channel, only where there are any."""
        counts = {"gnss": self.gnss, "doppler": self.doppler, "star_tracker": self.star_tracker}
        return {name: int(np.sum(~mask)) for name, mask in counts.items() if not mask.all()}

    def sentence(self) -> str:
        """The counts as words, empty where nothing was rejected."""
        return "; ".join(f"{n} gross outliers left out of {name.replace('_', ' ')}"
                         for name, n in self.rejected().items())


def smooth_outliers(time: np.ndarray, values: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Mask (n,) of the samples that no smooth curve through their neighbours explains.

    Args:
        time: (n,) s, increasing.
        values: (n, d) of a quantity that is smooth within stretches without gaps.
        sigma: (n, d) declared standard deviations.
    """
    outlier = np.zeros(len(time), dtype=bool)
    if len(time) < FEWEST:
        return outlier
    step = np.diff(time)
    cuts = np.flatnonzero(step > LONGEST_GAP_STEPS * np.median(step)) + 1
    for stretch in np.split(np.arange(len(time)), cuts):
        if len(stretch) >= FEWEST:
            outlier[stretch] = _stretch_outliers(time[stretch], values[stretch], sigma[stretch])
    return outlier


def _unsuspicious(time: np.ndarray, values: np.ndarray, sigma: np.ndarray) -> bool:
    """Whether sixth differences of evenly spaced samples show at a glance that there is no outlier.

    A smooth quantity leaves nothing but noise in them, amplified by sqrt(924); an outlier of A appears as 20 A.
    """
    step = np.diff(time)
    if np.ptp(step) > 1e-3 * step[0]:
        return False
    largest = np.max(np.abs(np.diff(values / np.median(sigma, axis=0), n=6, axis=0)))
    return bool(largest < 6.0 * np.sqrt(924.0))


def _stretch_outliers(time: np.ndarray, values: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    if _unsuspicious(time, values, sigma):
        return np.zeros(len(time), dtype=bool)
    inner = time[SAMPLES_PER_KNOT:-SAMPLES_PER_KNOT:SAMPLES_PER_KNOT]
    knots = np.concatenate([np.repeat(time[0], DEGREE + 1), inner, np.repeat(time[-1], DEGREE + 1)])
    scale = np.median(sigma, axis=0)
    scaled = values / scale
    spread = np.median(sigma / scale, axis=1)
    weight = np.ones(len(time))
    distance = np.zeros(len(time))
    for _ in range(12):
        spline = make_lsq_spline(time, scaled, knots, DEGREE, w=np.maximum(weight, 1e-4))
        distance = np.max(np.abs(scaled - spline(time)), axis=1) / spread
        bulk = max(1.0, float(np.median(distance)) / 0.9)
        renewed = np.maximum(1 - (distance / (THRESHOLD * bulk)) ** 2, 0.0) ** 2
        if float(np.max(np.abs(renewed - weight))) < 1e-3:
            break
        weight = renewed
    return distance > THRESHOLD * max(1.0, float(np.median(distance)) / 0.9)


def continuous_signs(quaternion: np.ndarray) -> np.ndarray:
    """The quaternions (n, 4) with signs flipped so that neighbours lie on one side."""
    flips = np.cumsum(np.einsum("ni,ni->n", quaternion[1:], quaternion[:-1]) < 0) % 2
    signed = quaternion.copy()
    signed[1:][flips == 1] *= -1
    return signed


def screen(campaign: Campaign) -> Screening:
    """Find the gross outliers of a campaign."""
    gnss, tracker, doppler = campaign.gnss, campaign.star_tracker, campaign.doppler
    accuracy = np.broadcast_to(gnss.standard_deviation, gnss.position.shape)
    keep_gnss = ~smooth_outliers(gnss.time, gnss.position, accuracy)
    # A small rotation phi changes the quaternion by phi/2, whatever its axis; the noisiest axis sets the scale.
    sigma = 0.5 * np.max(np.broadcast_to(tracker.standard_deviation, (len(tracker.time), 3)), axis=1)
    keep_tracker = ~smooth_outliers(tracker.time, continuous_signs(tracker.quaternion), np.tile(sigma[:, None], (1, 4)))
    keep_doppler = np.zeros(0, dtype=bool)
    if doppler is not None:
        shape = doppler.frequency_shift.shape
        keep_doppler = ~smooth_outliers(doppler.time, doppler.frequency_shift,
                                        np.broadcast_to(doppler.standard_deviation, shape))
    return Screening(keep_gnss, keep_doppler, keep_tracker)


def isolated_outliers(whitened: np.ndarray, series: np.ndarray) -> np.ndarray:
    """Mask (n,) of the samples whose residual stands apart from those of their neighbours.

    What a model misses is smooth in time and is followed by the running median that is taken off; a sample counts only
    if it is further from that than ``THRESHOLD`` standard deviations, or robust spreads of its arc if these are larger.
    So short stretches, which :func:`screen` must leave alone, are screened with the help of a fitted model.

    Args:
        whitened: (n, m) whitened residuals in order of time.
        series: (n,) index of the arc of each sample.
    """
    outlier = np.zeros(len(whitened), dtype=bool)
    for label in np.unique(series):
        inside = np.flatnonzero(series == label)
        rows = whitened[inside]
        if len(rows) < NEIGHBOURS:
            continue
        half = NEIGHBOURS // 2
        windows = np.clip(np.arange(len(rows)) - half, 0, len(rows) - NEIGHBOURS)[:, None] + np.arange(NEIGHBOURS)
        apart = np.abs(rows - np.median(rows[windows], axis=1))
        spread = np.maximum(1.4826 * np.median(apart, axis=0), 1.0)
        outlier[inside] = np.any(apart > THRESHOLD * spread, axis=1)
    return outlier
