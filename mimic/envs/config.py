"""The config of an environment. The presets in mimic/conf/env, `make` and the command line set its fields."""

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
    """The demonstrations: what the expert does.

    Attributes:
      path: file of demonstrations; where empty, demonstrations are recorded in simulation.
      kind: controller of the recorded demonstrations: "pd" or "reach", see `record_demonstrations`.
      count: number of training demonstrations.
      held_out: number of held-out demonstrations, for evaluation only.
      seed: random seed of the recorded goals.
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
    """Randomization of the learner's dynamics, drawn at the start of each episode; a range of zero width is constant.

    Attributes:
      mass: minimum and maximum factor on the masses and inertias of the learner's bodies.
      damping: minimum and maximum factor on the damping of its joints.
      torque_noise: standard deviation of the noise on each torque, as a fraction of the maximum torque.
    """

    mass: list[float] = dataclasses.field(default_factory=lambda: [1.0, 1.0])
    damping: list[float] = dataclasses.field(default_factory=lambda: [1.0, 1.0])
    torque_noise: float = 0.0

    def __post_init__(self) -> None:
        for name in ("mass", "damping"):
            bounds = list(getattr(self, name))
            if len(bounds) != 2 or not 0 < bounds[0] <= bounds[1] < math.inf:
                raise ValueError(f"randomization.{name}: expected [minimum, maximum] factor above 0, got {bounds}")
        if not 0 <= self.torque_noise < math.inf:
            raise ValueError(f"randomization.torque_noise: expected at least 0, got {self.torque_noise}")


@dataclasses.dataclass(frozen=True)
class EnvConfig:
    """An imitation environment.

    Attributes:
      name: name of the preset.
      expert, learner: the arms.
      limits: "none" (start in the zero pose, paper) or "hardware" (start in the ready pose, the manufacturer's joint
        ranges).
      metric: embodiment distance of the reward.
      demonstrations: motions to imitate.
      horizon: control steps of an episode.
      control_dt: duration of a control step [s]; the torque is constant within it.
      substeps: physics steps in a control step.
      physics: "mjx", the reference, or "fused": the same equations in one fused kernel, many times faster.
      randomization: how the learner's dynamics differ from its model.
      preview: how many control steps ahead the learner also observes the expert; 0 is the paper.
      limit_weight: weight in the reward of joints near or beyond their range and velocity limit; only where `limits`
        is "hardware".
      action_scale: factor on the torque range; at 1 the range is twice the torque that takes a joint from rest to its
        velocity limit in one step, cut at the torque limit.
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
        for name, minimum in (("horizon", 1), ("substeps", 1), ("preview", 0)):
            if getattr(self, name) < minimum:
                raise ValueError(f"{name}: expected at least {minimum}, got {getattr(self, name)}")
        for name in ("control_dt", "action_scale", "speed_bound"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name}: expected a number above 0, got {getattr(self, name)}")
        if not 0 <= self.limit_weight < math.inf:
            raise ValueError(f"limit_weight: expected at least 0, got {self.limit_weight}")

    def build_arms(self) -> ArmPair:
        """Both arms, with the links that the metric compares.

        Raises:
          ValueError: an arm that cannot be loaded.
        """
        return ArmPair(*(build_arm(arm, self.limits, self.metric.links) for arm in (self.expert, self.learner)))
