"""How a measured value changes over time: slope and its confidence."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

_BLOCKS = 12  # means of successive samples: these are nearly independent, single samples are not
_CONFIDENCE = 0.95
_WARM_UP = 0.2  # fraction of the time in which caches fill; not part of the trend


class Trend(NamedTuple):
    """Change per unit of time, with its interval of 95 % confidence; NaN where there are too few samples."""

    slope: float
    low: float
    high: float

    @property
    def is_flat(self) -> bool:
        """Whether the slope is within noise of 0."""
        return self.low <= 0 <= self.high


def trend(times: Sequence[float], values: Sequence[float]) -> Trend:
    """Linear regression over the means of blocks, without the warm-up.

    Args:
      times: ascending.
      values: one at each time.
    """
    x, y = np.asarray(times, float), np.asarray(values, float)
    late = x >= x[0] + _WARM_UP * (x[-1] - x[0]) if len(x) else np.zeros(0, bool)
    blocks = min(_BLOCKS, int(late.sum()))
    if blocks < 3:
        return Trend(math.nan, math.nan, math.nan)
    x, y = (np.array([part.mean() for part in np.array_split(all_[late], blocks)]) for all_ in (x, y))
    if np.ptp(y) == 0:
        return Trend(0.0, 0.0, 0.0)
    fit = stats.linregress(x, y)
    margin = fit.stderr * stats.t.ppf(0.5 + _CONFIDENCE / 2, blocks - 2)
    return Trend(float(fit.slope), float(fit.slope - margin), float(fit.slope + margin))
