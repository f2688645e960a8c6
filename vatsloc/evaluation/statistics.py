"""What a set of target registration errors amounts to: statistics, strata of depth, and a paired test."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import wilcoxon

from registration.volume import Array

# Fewer pairs than this cannot reach p < 0.05 in a two-sided signed-rank test: 2 / 2**5 = 0.0625.
FEWEST_PAIRS = 6


@dataclass(frozen=True)
class TreStatistics:
    """Target registration error over n landmarks, mm; NaN throughout when n is 0. sd is the sample's (n - 1)."""

    mean: float
    sd: float
    median: float
    p95: float
    max: float
    n: int


@dataclass(frozen=True)
class Stratum:
    """Errors of the landmarks whose depth below the pleura is in [from_mm, to_mm)."""

    from_mm: float
    to_mm: float
    errors: TreStatistics


def distances(predicted: Array, truth: Array) -> Array:
    """Euclidean error of each landmark in mm, (n,); NaN where either of the points (n, 3) is missing."""
    return np.linalg.norm(np.asarray(predicted, dtype=float) - np.asarray(truth, dtype=float), axis=-1)


def summarize(errors_mm: Array) -> TreStatistics:
    """Statistics of errors (n,) in mm; landmarks without an error (NaN) are left out of them and of n."""
    e = np.asarray(errors_mm, dtype=float)
    e = e[np.isfinite(e)]
    if e.size == 0:
        return TreStatistics(np.nan, np.nan, np.nan, np.nan, np.nan, 0)
    sd = float(e.std(ddof=1)) if e.size > 1 else np.nan
    return TreStatistics(
        float(e.mean()), sd, float(np.median(e)), float(np.percentile(e, 95)), float(e.max()), int(e.size)
    )


DEPTHS_MM = (0.0, 10.0, 20.0, 30.0)
"""Between these depths errors are told apart."""


def by_depth(errors_mm: Array, depth_mm: Array) -> list[Stratum]:
    """Errors by depth below the pleura; the first stratum also holds landmarks outside, the last everything deeper."""
    bounds = np.array([-np.inf, *DEPTHS_MM[1:], np.inf])
    band = np.where(np.isfinite(depth_mm), np.digitize(depth_mm, bounds[1:-1]), -1)
    named = [*DEPTHS_MM, np.inf]
    return [Stratum(named[m], named[m + 1], summarize(np.asarray(errors_mm)[band == m])) for m in range(len(DEPTHS_MM))]


def signed_rank_p(before_mm: Array, after_mm: Array) -> float | None:
    """Two-sided p of Wilcoxon's signed-rank test over one case's landmarks (n,); None below six pairs.

    Landmarks of several patients are not independent, so the test is never pooled over cases.
    Ref: Wilcoxon 1945; Alvarez 2021, section 8.1.
    """
    both = np.isfinite(before_mm) & np.isfinite(after_mm)
    if both.sum() < FEWEST_PAIRS:
        return None
    difference = np.asarray(before_mm)[both] - np.asarray(after_mm)[both]
    if not difference.any():
        return 1.0
    return float(wilcoxon(difference).pvalue)
