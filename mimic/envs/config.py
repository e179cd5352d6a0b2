"""What defines an environment: filled in by the presets in mimic/conf/env, by `make`, and on the command line."""

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from mimic.arms.arm import ArmConfig
from mimic.arms.chain import LINKS
from mimic.arms.embodiment import LIMITS, Embodiment
from mimic.config import check_choice
from mimic.envs.recording import KINDS
from mimic.metric.correspondence import (
    arc_length_correspondence,
    hard_correspondence,
    overlap_correspondence,
    soft_correspondence,
)
from mimic.metric.distance import Correspondence, DistanceWeights, Weights, adaptive_weights

CORRESPONDENCES = ("arc_length", "overlap", "hard", "soft", "chord_overlap")
PHYSICS = ("mjx", "fused")


@dataclasses.dataclass(frozen=True)
class MetricConfig:
    """The distance that is the reward. The defaults were chosen by `benchmarks.similarity`: see docs/similarity.md.

    Attributes:
      translation, rotation, linear_velocity, angular_velocity: weights; per chain length, rad, and their rates.
      adaptive: the paper's distance-dependent weights for translation and rotation instead.
      rotation_measure: "cosine" or "angle".
      links: "kept" (a locked joint removes no link) or "merged" (it makes one chord of two links; paper).
      correspondence: "arc_length" or "overlap" (static), "hard" or "soft" (by distance); "chord_overlap" is the overlap
        of runs before links were kept.
      xi: sharpness of the soft correspondence, below 0.
      reduction: "mean" or "frobenius".
    """

    translation: float = 1.0
    rotation: float = 1.0
    linear_velocity: float = 0.001
    angular_velocity: float = 0.01
    adaptive: bool = False
    rotation_measure: str = "cosine"
    correspondence: str = "arc_length"
    xi: float = -10.0
    reduction: str = "mean"
    links: str = "kept"

    def __post_init__(self) -> None:
        check_choice("links", self.links, LINKS)
        check_choice("correspondence", self.correspondence, CORRESPONDENCES)
        check_choice("rotation_measure", self.rotation_measure, ("cosine", "angle"))
        check_choice("reduction", self.reduction, ("mean", "frobenius"))
        if not -math.inf < self.xi < 0:
            raise ValueError(f"xi: expected a finite number below 0 (soft minimum), got {self.xi}")
        for name in ("translation", "rotation", "linear_velocity", "angular_velocity"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name}: expected a finite weight of at least 0, got {getattr(self, name)}")

    def make_weights(self) -> Weights:
        """The weights as the metric takes them."""
        velocities = {"linear_velocity": self.linear_velocity, "angular_velocity": self.angular_velocity}
        if self.adaptive:
            return lambda distances: dataclasses.replace(adaptive_weights(distances), **velocities)
        return DistanceWeights(self.translation, self.rotation, **velocities)

    def make_correspondence(self, expert: Embodiment, learner: Embodiment) -> Correspondence:
        """W, or the function that makes it of the link distances."""
        made: dict[str, Callable[[], Correspondence]] = {
            "arc_length": lambda: arc_length_correspondence(expert, learner),
            "overlap": lambda: overlap_correspondence(expert, learner),
            "chord_overlap": lambda: overlap_correspondence(expert, learner, lengths="chord"),
            "hard": lambda: hard_correspondence,
            "soft": lambda: partial(soft_correspondence, xi=self.xi),
        }
        return made[self.correspondence]()

    def shares(self, expert: Embodiment, learner: Embodiment) -> Float[np.ndarray, "expert learner"]:
        """How much each expert link counts for a learner link: columns sum to 1; alike where W depends on the state."""
        correspondence = self.make_correspondence(expert, learner)
        shape = expert.num_links, learner.num_links
        matrix = np.ones(shape) if callable(correspondence) else np.asarray(correspondence)
        return matrix / matrix.sum(axis=0)


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


@dataclasses.dataclass(frozen=True)
class RecordingConfig:
    """A recording of demonstrations to a file.

    Attributes:
      env: the environment whose expert is recorded, in its time steps.
      kind, count, seed: see `DemonstrationConfig`; those of the environment where None.
      limits: see `EnvConfig`; those of the environment where None.
      source: file of motions to read instead of recording: see `import_demonstrations`.
      joints: what that file calls the expert's joints, base to tip; by the expert's own names where empty.
      out: the file, which ends in .npz; must not exist.
      plot: picture of what was recorded; `out` with .png instead where empty. Must not exist.
    """

    env: EnvConfig = dataclasses.field(default_factory=EnvConfig)
    kind: str | None = None
    count: int | None = None
    seed: int | None = None
    limits: str | None = None
    source: str = ""
    joints: list[str] = dataclasses.field(default_factory=list)
    out: str = ""
    plot: str = ""

    def resolve(self) -> EnvConfig:
        """The environment with what is given here.

        Raises:
          ValueError: a value that it cannot have.
        """
        wanted = {name: getattr(self, name) for name in ("kind", "count", "seed")}
        demonstrations = dataclasses.replace(self.env.demonstrations, **_given(wanted))
        return dataclasses.replace(self.env, demonstrations=demonstrations, **_given({"limits": self.limits}))


@dataclasses.dataclass(frozen=True)
class InspectConfig:
    """A look at a learner before it is trained.

    Attributes:
      learner: the arm in question.
      expert: what it shall imitate.
      limits: see `EnvConfig`.
      bound: whether to say how near the learner can come, which takes a minute.
      out: new folder for a picture of both arms with their correspondence, one of poses of the expert with the
        learner's nearest ones (where `bound`), and for what was found as JSON.
    """

    learner: ArmConfig = dataclasses.field(default_factory=ArmConfig)
    expert: ArmConfig = dataclasses.field(default_factory=ArmConfig)
    limits: str = "none"
    bound: bool = True
    out: str = ""

    def __post_init__(self) -> None:
        check_choice("limits", self.limits, LIMITS)


@dataclasses.dataclass(frozen=True)
class RetargetConfig:
    """A retargeting of demonstrations.

    Attributes:
      demonstrations: file of the expert's.
      learner: name of the environment whose arms and metric count.
      mapper: run directory of a pose mapper of that environment, which is used instead of the optimiser.
      limits: see `EnvConfig`.
      out: file of the learner's; must not exist.
      seed: of the random poses that minima are searched from.
    """

    demonstrations: str = ""
    learner: str = "panda4dof"
    mapper: str = ""
    limits: str = "none"
    out: str = ""
    seed: int = 0


def _given(values: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}
