"""What a learner's hand keeps of its expert's over the expert's range: reach, errors, speed; a table and a plot."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table

from mimic.arms.arm import ArmConfig, ArmPair, build_arm, finite_velocity_limit
from mimic.arms.capsules import Capsules, fit_capsules
from mimic.arms.embodiment import Embodiment
from mimic.control.clearance import clearance
from mimic.metric.capsule_distances import clearance_constants
from mimic.metric.config import MetricConfig
from mimic.metric.distance import Metric
from mimic.metric.kinematics import link_state_table
from mimic.retargeting.base_placement import POSITION_ALONE, best_bases, repeated
from mimic.retargeting.certificate import NO_FLOOR, POSITION, ROTATION, TOUCHING
from mimic.retargeting.hand_speeds import speeds_needed
from mimic.retargeting.hand_target import Placement
from mimic.retargeting.pose import imitate_pose

_POSES, _DRAWN = 1024, 4096  # of the expert: those that are compared, and from which they are chosen
_FRAMES = 16  # of them, that a base is searched with
_KINDS = ("exact", "position alone", "not reached")
_COLOURS = ("tab:green", "tab:orange", "tab:red")
_WORST = 5  # percent of the poses


@dataclasses.dataclass(frozen=True)
class HandReach:
    """The learner's hands at poses of the expert that are uniform in its joint ranges.

    Attributes:
      base: of the learner in the expert's base frame, [x, y, z, yaw] [m, rad].
      hands: of the expert, in its base frame [m].
      position: distance between the hands, of several the maximum [m].
      rotation: angle between them [rad].
      speed: fraction of the expert's full speed at which the learner keeps up; NaN where the position is not reached.
      touches: whether the learner's links touch each other; none where its shapes are not known.
    """

    base: Float[np.ndarray, "4"]
    hands: Float[np.ndarray, "poses hands 3"]
    position: Float[np.ndarray, " poses"]
    rotation: Float[np.ndarray, " poses"]
    speed: Float[np.ndarray, " poses"]
    touches: Bool[np.ndarray, " poses"] | None

    @property
    def kinds(self) -> list[Bool[np.ndarray, " poses"]]:
        """Whether a pose is of each of the kinds: the hand is exact, its position alone is, and neither is."""
        reached = self.position <= POSITION
        exact = reached & (self.rotation <= ROTATION)
        return [exact, reached & ~exact, ~reached]

    @property
    def score(self) -> float:
        """Fraction of exact poses, to which those with the position alone add some."""
        exact, alone, _ = self.kinds
        return float(exact.mean() + POSITION_ALONE * alone.mean())

    def summary(self) -> dict[str, Any]:
        """The figures, for a file; None where no pose has one."""
        exact, alone, missed = self.kinds
        return {
            "base": self.base.tolist(),
            "poses": len(self.position),
            **{kind.replace(" ", "_"): float(are.mean()) for kind, are in zip(_KINDS, self.kinds, strict=True)},
            "position_error_mm": _typical(1e3 * self.position[missed]),
            "rotation_error_deg": _typical(np.degrees(self.rotation[alone])),
            "speed": _typical(self.speed[exact | alone], lowest=True),
            "touching": None if self.touches is None else float(self.touches.mean()),
        }


def hand_reach(expert: ArmConfig, learner: ArmConfig, metric: MetricConfig, base: Any) -> HandReach:
    """Puts the learner's hand where the expert's is, in poses over the range of the expert, within the model's limits.

    Poses in which the expert's links touch each other are left out.

    Args:
      expert, learner: arms with hands.
      metric: chooses among the postures with this hand.
      base: [x, y, z, yaw] of the learner, None for the expert's, or "auto" for the one from which most are exact.
    """
    arms = ArmPair(*(build_arm(dataclasses.replace(arm, home=None), "hardware") for arm in (expert, learner)))
    pair = arms.embodiments
    qpos = _poses(pair[0], _capsules(expert))
    built = metric.build(*pair)
    bases = np.zeros((1, 4)) if base is None or isinstance(base, str) else np.reshape(base, (1, 4))
    if isinstance(base, str):
        frames, limit = qpos[:_FRAMES], finite_velocity_limit(pair[1])
        found = best_bases(*pair, frames, np.zeros_like(frames), built, jump=limit)
        bases = np.concatenate([bases, np.round(found, 3)])
    reached = [_reach(pair, built, qpos, base) for base in bases]
    reach, postures = max(reached, key=lambda result: result[0].score)
    capsules = _capsules(learner)
    touches = None if capsules is None else _clearances(pair[1], capsules, postures) < TOUCHING
    return dataclasses.replace(reach, touches=touches)


def _poses(arm: Embodiment, capsules: Capsules | None) -> Float[np.ndarray, "poses joints"]:
    """Random poses in which the links of an arm do not touch, uniform in its joint ranges."""
    lower, upper = np.asarray(arm.joint_range).T
    qpos = np.random.default_rng(0).uniform(lower, upper, (_DRAWN, arm.num_joints)).astype(np.float32)
    if capsules is not None:
        order = np.argsort(_clearances(arm, capsules, qpos) < TOUCHING, kind="stable")  # those that do come last
        qpos = qpos[order]
    return qpos[:_POSES]


def _capsules(arm: ArmConfig) -> Capsules | None:
    """Capsules around the links of an arm; None where it has no shapes."""
    try:
        return fit_capsules(dataclasses.replace(arm, home=None), "hardware")
    except ValueError:
        return None


def _clearances(arm: Embodiment, capsules: Capsules, qpos: np.ndarray) -> Float[np.ndarray, " poses"]:
    return clearance(np.asarray(qpos, np.float32), clearance_constants(arm, capsules, NO_FLOOR))


def _reach(
    pair: tuple[Embodiment, Embodiment], metric: Metric, qpos: np.ndarray, base: np.ndarray
) -> tuple[HandReach, np.ndarray]:
    """The hands from one base, and the learner's postures [rad]; whether these touch is left open."""
    placements = repeated(base[None], len(qpos))
    solution = imitate_pose(*pair, qpos, **metric.arguments, hand="exact", base=placements)
    postures, error = jax.device_get((solution.qpos, solution.hand))
    hand = link_state_table(pair[0], qpos, np.zeros_like(qpos)).hand
    assert hand is not None
    is_exact = (error.position <= POSITION) & (error.rotation <= ROTATION)
    speed = np.where(error.position <= POSITION, _speed(pair, qpos, postures, placements, is_exact), np.nan)
    hands = np.asarray(hand.position) * float(pair[0].chain_length)
    return HandReach(base, hands, error.position, error.rotation, speed, None), postures


def _speed(
    pair: tuple[Embodiment, Embodiment], qpos: np.ndarray, postures: np.ndarray, base: Placement, is_exact: np.ndarray
) -> Float[np.ndarray, " poses"]:
    """Fraction of the expert's speed, at most 1, at which no joint of the learner exceeds its velocity limit.

    The expert moves in a random direction, with a joint at its limit. The learner's hand has its velocity, or its
    linear velocity alone where the rotation is not exact, with least squares of its joints' speeds in their limits.
    """
    direction = np.random.default_rng(1).uniform(-1, 1, qpos.shape)
    direction /= np.abs(direction).max(axis=1, keepdims=True)
    of_expert, of_learner = (finite_velocity_limit(arm) for arm in pair)
    needed = speeds_needed(*pair, qpos, direction * of_expert, postures, base, of_learner, is_exact.astype(float))
    return 1 / np.maximum(needed, 1)


def _typical(values: np.ndarray, *, lowest: bool = False) -> list[float] | None:
    """Median, and the value that the worst 5 % of the poses exceed, or stay below."""
    percent = 50, _WORST if lowest else 100 - _WORST
    return np.percentile(values, percent).tolist() if len(values) else None


def reach_table(reach: HandReach, pair: tuple[Embodiment, Embodiment]) -> Table:
    """The figures as a table."""
    expert, learner = (arm.name for arm in pair)
    found = reach.summary()
    title = f"hand of {learner} at that of {expert}, in {found['poses']} poses over its range"
    table = Table("", "poses", "", "median", "worst 5 %", title=title, title_justify="left")
    rows = (
        ("exact (1 mm, 0.5 deg)", "exact", "", None, ""),
        ("position alone", "position_alone", "rotation error", "rotation_error_deg", "{:.1f} deg"),
        ("not reached", "not_reached", "position error", "position_error_mm", "{:.0f} mm"),
    )
    for label, kind, what, key, form in rows:
        errors = (found[key] if key else None) or ["", ""]
        table.add_row(label, f"{found[kind]:.1%}", what, *(form.format(x) if x != "" else "-" for x in errors))
    speed = [f"{x:.0%}" for x in found["speed"]] if found["speed"] else ["-", "-"]
    table.add_row("where reached", f"{found['exact'] + found['position_alone']:.1%}", "of full speed kept", *speed)
    return table


def reach_lines(reach: HandReach, pair: tuple[Embodiment, Embodiment], *, is_searched: bool) -> Iterator[str]:
    """Lines about what the table leaves open."""
    expert, learner = pair
    placed = ", ".join(f"{x:g}" for x in reach.base)
    found = "the best that was found" if is_searched else "base=auto searches for another"
    yield f"base of {learner.name} in that of {expert.name}: [{placed}] [m, rad]; {found}"
    if learner.num_joints < 6 * len(learner.hand_joint):
        yield (
            f"joints: {learner.name} has {learner.num_joints}, and a hand's pose takes 6: its position comes first, "
            "then its rotation"
        )
    if reach.touches is not None and reach.touches.any():
        yield f"links of {learner.name} touch each other in {reach.touches.mean():.1%} of these poses"


def plot_reach(axes: tuple[Axes, Axes], reach: HandReach, pair: tuple[Embodiment, Embodiment]) -> None:
    """Draws the expert's hands from above and from the side, coloured by what the learner keeps of them."""
    points = reach.hands.reshape(len(reach.hands), -1, 3)
    for axis, (across, up), label in zip(axes, ((0, 1), (0, 2)), ("from above", "from the side"), strict=True):
        for kind, are, colour in zip(_KINDS, reach.kinds, _COLOURS, strict=True):
            shown = points[are].reshape(-1, 3).T
            axis.scatter(
                shown[across], shown[up], s=14, alpha=0.6, lw=0, color=colour, label=f"{kind}: {are.mean():.0%}"
            )
        for arm, (x, y), marker in zip(pair, ((0, 0), reach.base[[across, up]]), ("s", "D"), strict=True):
            axis.plot(x, y, marker, color="black", mfc="none", ms=9, label=f"base of {arm.name}", ls="")
        axis.set(aspect="equal", xlabel="x [m]", ylabel=f"{'xyz'[up]} [m]")
        axis.set_title(f"hand of {pair[0].name}, {label}")
        axis.grid(alpha=0.3)
    figure = axes[0].get_figure()
    assert isinstance(figure, Figure)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False)
