"""Openings of one gripper as those of another: the same fraction of its range at each sample."""

import numpy as np
from jaxtyping import Float

from mimic.arms.gripper import GripperRange

_SLACK, _USED = 0.1, 0.2  # fractions of a range: how far values may be beyond it, and how much of it they use at least


def other_gripper(
    values: Float[np.ndarray, "samples channels"],
    expert: GripperRange | None,
    learner: GripperRange | None,
    name: str = "",
) -> Float[np.ndarray, "samples channels"] | None:
    """The learner's joints in place of the expert's, or its width in place of a width.

    Args:
      values: joints of the expert's gripper, or how wide it is open alone.
      expert, learner: the grippers.
      name: of a single channel in the source; one that ends as a joint of the expert's gripper is this joint.

    Returns:
      As many channels, of which each is the learner's joint of the same number, or its only one. None where the
      grippers are equal or not known, and where values are in another unit, as percents and commands are, which mean
      the same fraction of any gripper's range.
    """
    channels = values.shape[1]
    if expert is None or learner is None or channels not in (1, len(expert.names)):
        return None
    own = [index for index, joint in enumerate(expert.names) if channels == 1 and name.endswith(joint)]
    if own:
        expert = GripperRange((expert.names[own[0]],), expert.closed[own[:1]], expert.opened[own[:1]])
    is_width = channels == 1 and len(expert.names) > 1
    if is_width and expert.closed.any():
        return None  # of joints that are not 0 when closed, one number may be an angle as well as a width
    closed, opened = (np.zeros(1), np.array([expert.travel])) if is_width else (expert.closed, expert.opened)
    fraction = (values - closed) / (opened - closed)
    known = fraction[np.isfinite(fraction).all(axis=1)]
    if not len(known) or known.min() < -_SLACK or known.max() > 1 + _SLACK or np.ptp(known) < _USED:
        return None
    if is_width and known.max() <= 0.5 + _SLACK and len(expert.names) == 2:
        return None  # a width of which half is used, or one of the two fingers
    if is_width:
        return fraction * learner.travel
    at = np.minimum(np.arange(channels), len(learner.names) - 1)
    if channels == len(learner.names) and np.allclose([closed, opened], [learner.closed, learner.opened]):
        return None
    return learner.closed[at] + fraction * (learner.opened - learner.closed)[at]
