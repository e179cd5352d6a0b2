"""What defines an environment: filled in by the presets in mimic/conf/env, by `make`, and on the command line."""

import dataclasses
import math

from mimic.arms.arm import ArmConfig, ArmPair, build_arm
from mimic.arms.embodiment import LIMITS
from mimic.config import check_choice
from mimic.envs.recording import KINDS
from mimic.metric.config import MetricConfig

PHYSICS = ("mjx", "fused")


@dataclasses.dataclass(frozen=True)
class DemonstrationConfig:
    """What the expert does.

    Attributes:
      path: a file of demonstrations; they are recorded where it is empty.
      kind: of the recorded ones: "pd" or "reach", see `record_demonstrations`.
      count: demonstrations to train on.
      held_out: demonstrations to test on, never trained on.
      seed: of the recorded goals.
    """

    path: str = ""
    kind: str = "pd"
    count: int = 124
    held_out: int = 32
    seed: int = 0

    def __post_init__(self) -> None:
        check_choice("demonstrations.kind", self.kind, KINDS)
        if self.count < 1 or self.held_out < 1:
            raise ValueError(
                f"demonstrations: expected count and held_out of at least 1, got {self.count}, {self.held_out}"
            )
        if self.seed < 0:
            raise ValueError(f"demonstrations.seed: expected at least 0, got {self.seed}")


@dataclasses.dataclass(frozen=True)
class RandomizationConfig:
    """How the learner differs from its model, drawn anew for each episode; nothing is random where both bounds agree.

    Attributes:
      mass: least and largest factor of the masses and inertias of the learner's bodies.
      damping: least and largest factor of the damping of its joints.
      torque_noise: standard deviation of a noise on each torque, as a share of the largest torque.
    """

    mass: list[float] = dataclasses.field(default_factory=lambda: [1.0, 1.0])
    damping: list[float] = dataclasses.field(default_factory=lambda: [1.0, 1.0])
    torque_noise: float = 0.0

    def __post_init__(self) -> None:
        for name in ("mass", "damping"):
            bounds = list(getattr(self, name))
            if len(bounds) != 2 or not 0 < bounds[0] <= bounds[1] < math.inf:
                raise ValueError(f"randomization.{name}: expected [least, largest] factor above 0, got {bounds}")
        if not 0 <= self.torque_noise < math.inf:
            raise ValueError(f"randomization.torque_noise: expected at least 0, got {self.torque_noise}")


@dataclasses.dataclass(frozen=True)
class EnvConfig:
    """An imitation environment.

    Attributes:
      name: of the preset.
      expert, learner: the arms.
      limits: "none" (zero pose, paper) or "hardware" (ready pose, the maker's joint ranges).
      metric: the reward.
      demonstrations: what is imitated.
      horizon: steps of an episode.
      control_dt: time that a torque is held [s].
      substeps: physics steps in a control step.
      physics: "mjx", the reference, or "fused": the same equations as one small program, many times faster.
      randomization: how the learner differs from its model.
      preview: expert steps that the learner sees beyond the present one; 0 is the paper.
      limit_weight: in the reward, of joints near or beyond their range and rated speed; only where `limits` is
        "hardware".
      action_scale: of the torque range; 1 is twice the torque that takes a joint to its rated speed in one step.
      speed_bound: joint speed [rad/s] at which an episode ends as a runaway.
    """

    name: str = ""
    expert: ArmConfig = dataclasses.field(default_factory=ArmConfig)
    learner: ArmConfig = dataclasses.field(default_factory=ArmConfig)
    limits: str = "none"
    metric: MetricConfig = dataclasses.field(default_factory=MetricConfig)
    demonstrations: DemonstrationConfig = dataclasses.field(default_factory=DemonstrationConfig)
    horizon: int = 50
    control_dt: float = 0.1
    substeps: int = 10
    physics: str = "mjx"
    randomization: RandomizationConfig = dataclasses.field(default_factory=RandomizationConfig)
    preview: int = 1
    limit_weight: float = 1.0
    action_scale: float = 1.0
    speed_bound: float = 30.0

    def __post_init__(self) -> None:
        check_choice("limits", self.limits, LIMITS)
        check_choice("physics", self.physics, PHYSICS)
        for name, least in (("horizon", 1), ("substeps", 1), ("preview", 0)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}: expected at least {least}, got {getattr(self, name)}")
        for name in ("control_dt", "action_scale", "speed_bound"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name}: expected a number above 0, got {getattr(self, name)}")
        if not 0 <= self.limit_weight < math.inf:
            raise ValueError(f"limit_weight: expected at least 0, got {self.limit_weight}")

    def build_arms(self) -> ArmPair:
        """The arms, with the links that the metric asks for.

        Raises:
          ValueError: an arm that cannot be built.
        """
        return ArmPair(*(build_arm(arm, self.limits, self.metric.links) for arm in (self.expert, self.learner)))
