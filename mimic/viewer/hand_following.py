"""A learner of a live view whose hand does what the expert's does, and an expert whose hand is dragged. No browser."""

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from mimic.arms.arm import build_arm, finite_velocity_limit
from mimic.arms.embodiment import Embodiment
from mimic.arms.pose_limits import continuous_joints
from mimic.base.config import check_choice
from mimic.envs.config import EnvConfig
from mimic.metric.config import MetricConfig
from mimic.retargeting.hand_target import placement
from mimic.retargeting.live_pose import ArmRows, LivePose
from mimic.retargeting.pose import wrap_angles
from mimic.retargeting.teleoperation import HANDS as FOLLOWED
from mimic.retargeting.teleoperation import TeleoperationStatus, Teleoperator
from mimic.retargeting.teleoperation_recording import TeleoperationRecorder

FREE = "free"
HANDS = (FREE, *FOLLOWED)
_RATE = 100.0  # ticks of the teleoperator per second
_STEPS = 4  # of a dragged pose in a frame
_AT_HAND = 1e-4  # rad; a dragged pose that moves less in a frame has arrived, or gets no nearer


@dataclasses.dataclass(frozen=True)
class HandSettings:
    """How the learner's hand follows the expert's; the user can change it while the viewer runs.

    Attributes:
      hand: "free" leaves it to the metric; "exact" and "relative" as of `Teleoperator`.
      is_engaged: whether the clutch is engaged.
      base: of the learner in the expert's base frame, [x, y, z, yaw] [m, rad].
      scale, mirror: as of `Teleoperator`.
    """

    hand: str = FREE
    is_engaged: bool = True
    base: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    scale: float = 1.0
    mirror: bool = False

    def __post_init__(self) -> None:
        check_choice("hand", self.hand, HANDS)
        placement(self.base)
        if not 0 < self.scale < math.inf:
            raise ValueError(f"scale: expected a finite number above 0, got {self.scale}")


class HandFrame(NamedTuple):
    """What is shown of a hand that follows.

    Attributes:
      positions, rotations: goals of the learner's hands in its base frame [m]; none before the first one.
      status: of the teleoperator.
      gripper: opening of the learner's; None where unknown.
    """

    positions: Float[np.ndarray, "hands 3"]
    rotations: Float[np.ndarray, "hands 3 3"]
    status: TeleoperationStatus
    gripper: float | None = None

    @property
    def note(self) -> str:
        """The status in words."""
        state, reason, position, rotation = self.status
        error = "" if math.isnan(position) else f", {position:.1f} mm and {rotation:.1f} deg from its goal"
        gripper = "" if self.gripper is None else f", gripper at {self.gripper:.2f}"
        return f"hand {state}{error}{gripper}" + (f"\n{reason}" if reason else "")


class HandFollower:
    """Moves the learner of an environment by a teleoperator, within the limits of its model.

    Args:
      expert: the arm that leads.
      env: environment that defines the learner.
      is_recorded: whether what is driven is kept.

    Attributes:
      recorders: of what was driven, one each time that other joints of the learner are locked.
    """

    def __init__(self, expert: Embodiment, env: EnvConfig, is_recorded: bool = False):
        self._expert, self._env, self._is_recorded = expert, env, is_recorded
        self.recorders: list[TeleoperationRecorder] = []
        self._teleoperator: Teleoperator | None = None
        self._made_of: Any = None  # what the teleoperator is made of
        self._is_engaged, self._left = False, 0.0
        self._continuous = continuous_joints(expert)
        self._expert_qpos: np.ndarray | None = None  # of the last frame [rad]
        self._recorded: Mapping[str, float] | None = None  # locked joints of the last recorder

    def stop(self) -> None:
        """Forgets the motion; the next step begins where the learner is then."""
        self._teleoperator = None

    def step(
        self,
        settings: HandSettings,
        locked: Mapping[str, float],
        qpos: Float[np.ndarray, " learner_joints"],
        expert_qpos: Float[np.ndarray, " joints"],
        dt: float,
        gripper: float | None = None,
    ) -> tuple[Float[np.ndarray, " learner_joints"], HandFrame]:
        """The learner's pose [rad] after a time [s], and what is shown of its hand.

        Args:
          settings: of the teleoperator; others begin anew from `qpos`.
          locked: joints of the learner [rad].
          qpos: the learner's pose [rad].
          expert_qpos: the expert's pose [rad].
          dt: the time [s].
          gripper: opening of the expert's, 0 to 1; None where unknown.

        Raises:
          ValueError: see `Teleoperator`.
        """
        made_of = dataclasses.replace(settings, is_engaged=True), tuple(locked.items())
        if self._teleoperator is None or self._made_of != made_of:
            self._teleoperator, self._made_of = self._make(settings, locked, qpos), made_of
            self._is_engaged, self._left, self._expert_qpos = False, 0.0, None
        operator = self._teleoperator
        if settings.is_engaged != self._is_engaged:
            (operator.engage if settings.is_engaged else operator.disengage)()
            self._is_engaged = settings.is_engaged
        ticks = max(int(self._left + dt * _RATE), 1)
        self._left = max(self._left + dt * _RATE - ticks, 0.0)
        drive = self.recorders[-1].step if self._is_recorded else operator.step
        last, self._expert_qpos = self._expert_qpos, np.array(expert_qpos, float)
        moved = wrap_angles(self._expert_qpos - (self._expert_qpos if last is None else last), self._continuous)
        for rest in np.arange(ticks)[::-1] / ticks:
            command = drive(self._expert_qpos - rest * moved, gripper)
        goal = operator.goal or (np.zeros((0, 3)), np.zeros((0, 3, 3)))
        return command.qpos, HandFrame(*goal, command.status, command.gripper)

    def _make(self, settings: HandSettings, locked: Mapping[str, float], qpos: np.ndarray) -> Teleoperator:
        config = dataclasses.replace(self._env.learner, home=None, locked=dict(locked))
        arm = build_arm(config, "hardware", self._env.metric.links).embodiment
        hand: Any = settings.hand
        operator = Teleoperator(
            self._expert, arm, hand=hand, base=settings.base, scale=settings.scale, mirror=settings.mirror,
            rate=_RATE, velocity=finite_velocity_limit(arm), metric=self._env.metric,
        )  # fmt: skip
        operator.reset(np.clip(qpos, *operator.limits.position.T))
        if self._is_recorded and self._recorded == locked:
            self.recorders[-1].operator = operator
        elif self._is_recorded:
            self.recorders.append(TeleoperationRecorder(operator))
            self._recorded = dict(locked)
        return operator


class HandDrag:
    """Moves an arm so that its first hand goes to where the user drags it; other hands stay.

    Args:
      arm: with hands, before anything is dragged.

    Attributes:
      goal: of the hand in the base frame [m]; None while nothing is dragged.
    """

    def __init__(self, arm: Embodiment):
        self._arm, self._rows = arm, ArmRows(arm)
        self.goal: Float[np.ndarray, "4 4"] | None = None

    @functools.cached_property
    def _pose(self) -> LivePose:
        hands = np.arange(self._rows.hands)
        metric = MetricConfig().build(self._arm, self._arm)
        return LivePose(self._rows, self._rows, np.stack([hands, hands], axis=1), metric)

    def step(self, qpos: Float[np.ndarray, " joints"], dt: float) -> Float[np.ndarray, " joints"]:
        """The pose [rad] after a time [s], within ranges and velocity limits; the drag ends where it gets no nearer."""
        if self.goal is None:
            return qpos
        start, reach = np.asarray(qpos, float), finite_velocity_limit(self._arm) * dt
        lower, upper = np.asarray(self._arm.joint_range).T
        lower, upper = np.maximum(lower, start - reach), np.minimum(upper, start + reach)
        rows, number = self._rows(start[None])[0], self._rows.hands
        hands = rows[self._rows.hand_rows(np.arange(number))]
        hands[0], hands[number : number + 3] = self.goal[:3, 3] / self._rows.unit, self.goal[:3, :3].T
        goal, pose = self._pose.goal(rows, hands), start[None]
        for _ in range(_STEPS):
            pose = self._pose.step(goal, pose, lower, upper)
        if np.abs(pose[0] - start).max() < _AT_HAND:
            self.goal = None
        return pose[0].astype(qpos.dtype)
