"""Resamples motions at control steps, smoothed at the scale of a step where they have more samples than steps."""

import numpy as np
from jaxtyping import Float

from mimic.motions.formats.episodes import Motion

_DENSITY = 3  # samples of a step that make it dense: with less, they are interpolated


def angles_and_velocities(
    motion: Motion, time: Float[np.ndarray, " times"], step: float = 0.1
) -> tuple[Float[np.ndarray, "times joints"], Float[np.ndarray, "times joints"]]:
    """Angles and velocities of a motion at any times within it.

    Dense samples are fitted by cubic splines with a knot a step, so that neither jittered time stamps nor the steps of
    encoders appear as velocity. Others are interpolated by cubics, with the motion's velocities, or with central
    differences if it has none.

    Args:
      motion: of two samples or more.
      time: [s], in the motion's own time.
      step: the control step [s].
    """
    from scipy.interpolate import CubicHermiteSpline, make_lsq_spline  # half a second, which only imports need

    knots = _knots(motion.time, step)
    if len(knots):
        ends = motion.time[[0, 0, 0, 0]], motion.time[[-1, -1, -1, -1]]
        all_knots = np.concatenate([ends[0], knots, ends[1]])
        angles = make_lsq_spline(motion.time, motion.qpos, all_knots)
        if motion.qvel is None:
            return angles(time), angles(time, 1)
        return angles(time), make_lsq_spline(motion.time, motion.qvel, all_knots)(time)
    qvel = np.gradient(motion.qpos, motion.time, axis=0) if motion.qvel is None else motion.qvel
    spline = CubicHermiteSpline(motion.time, motion.qpos, qvel)
    return spline(time), spline(time, 1)


def _knots(time: np.ndarray, step: float) -> np.ndarray:
    """Inner knots of a spline, each a step or more after the last and after as many samples as make it dense.

    Empty where the samples are not dense.
    """
    if (len(time) - 1) * step < _DENSITY * (time[-1] - time[0]) * (1 - 1e-6):
        return np.zeros(0)
    knots, last = [], 0
    for knot in np.arange(time[0] + step, time[-1] - step / 2, step):
        index = int(np.searchsorted(time, knot))
        if index - last >= _DENSITY and len(time) - index >= _DENSITY:
            knots.append(knot)
            last = index
    return np.asarray(knots)
