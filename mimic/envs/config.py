"""The config of an environment. The presets in mimic/conf/env, `make` and the command line set its fields."""

import dataclasses
from typing import ClassVar, Literal

from mimic.arms.arm import Arm, ArmConfig, ArmPair, build_arm, errors_of
from mimic.arms.embodiment import LIMITS
from mimic.base import registry
from mimic.base.config import check_choice
from mimic.base.ranges import check_ranges, number
from mimic.control.joint_control import MODES
from mimic.metric.config import MetricConfig
from mimic.motions.experts import KINDS, MIXED
from mimic.physics.world import AUTO, PHYSICS, WorldConfig

Kind = Literal["one_arm", "inner_loop", "sampled_arms"]
REWARD_TERMS = ("self_collision",)  # built in, see mimic/envs/terms.py
registry.reserve("reward_term", REWARD_TERMS)
_RECORDING_TIMESTEP = 0.01  # s, of the physics of an expert in an environment with an inner loop
_MAX_RECORDED_STEPS = 10**8  # an hour on two cores


@dataclasses.dataclass(frozen=True)
class DemonstrationConfig:
    """The demonstrations: what the expert does.

    There are three sets: those for training, those for validation, on which settings may be chosen, and those of
    `python -m mimic.evaluate split=test`, which are drawn from other seeds.

    Attributes:
      path: file of demonstrations; where empty, demonstrations are recorded in simulation.
      source: registered function that makes the demonstrations, in place of a recording; only where `path` is empty.
      kind: what drives the expert of recorded demonstrations: "computed_torque", "pid" (paper), "reach", "splines",
        "steps", or "mixed", each of these in turn; see `record_demonstrations`.
      count: number of training demonstrations.
      held_out: number of held-out demonstrations, for validation. As many of those for training are evaluated too.
      seed: random seed of the recorded goals.
    """

    path: str = ""
    source: str = ""
    kind: str = MIXED
    # A core records some hundred in a second.
    count: int = number(600, at_least=1, at_most=100_000)
    held_out: int = number(80, at_least=1, at_most=100_000)
    seed: int = number(0, at_least=0, at_most=2**63 - 1)

    def __post_init__(self) -> None:
        check_choice("kind", self.kind, (*KINDS, MIXED))
        if self.path and self.source:
            raise ValueError("demonstrations: expected path or source, got both")
        if (self.path or self.source) and self.kind != MIXED:
            raise ValueError(f"demonstrations.kind: expected none with a path or source, got {self.kind}")
        check_ranges(self, "demonstrations.")


@dataclasses.dataclass(frozen=True)
class RewardConfig:
    """What is added to the reward, see `mimic.register`.

    Attributes:
      terms: weights of reward terms, by name: "self_collision", which is built in, or what `mimic.register` adds. A
        step that ends a runaway counts each term as minus the weight's magnitude for all remaining steps; so terms
        should be in [-1, 1].
    """

    terms: dict[str, float] = number(dict, at_least=-1e6, at_most=1e6, by_name=True)

    def __post_init__(self) -> None:
        check_ranges(self, "reward.")


@dataclasses.dataclass(frozen=True)
class ObservationConfig:
    """What is added to the observation, see `mimic.register`.

    Attributes:
      terms: names of observation terms that `mimic.register` adds, in the order of their numbers, after the link
        states.
    """

    terms: list[str] = dataclasses.field(default_factory=list)

    def __post_init__(self) -> None:
        repeated = sorted({name for name in self.terms if self.terms.count(name) > 1})
        if repeated:
            raise ValueError(f"observation.terms: expected each term once, got {repeated[0]!r:.80} twice")


@dataclasses.dataclass(frozen=True)
class ArmsConfig:
    """What the learner of each episode is drawn from: three kinds of arms, each with its fraction of their sum.

    Attributes:
      locked_fraction: of the environment's learner with joints locked at home, none of them included.
      most_locked: maximum number of joints that are locked.
      unseen: sets of locked joints that training leaves out, as in "2" or "1+4"; the report shows them apart.
      perturbed_fraction: of `models`, each drawn with another size, other masses, rotors, damping and velocity limits.
      models: arms to draw perturbed ones from: names or files, see `ArmConfig.model`.
      random_fraction: of random arms, see `random_arm` in mimic/arms/sampler.py.
      evaluated: arms that the report shows too, as names or files. They should not be in `models`.
      armature, damping: minimum of each joint of `models` and `evaluated`, see `ArmConfig`; the default is the Panda's.
    """

    locked_fraction: float = number(0.0, at_least=0.0, at_most=1e6)
    most_locked: int = number(2, at_least=0, at_most=7)
    unseen: list[str] = dataclasses.field(default_factory=list)
    perturbed_fraction: float = number(0.0, at_least=0.0, at_most=1e6)
    models: list[str] = dataclasses.field(default_factory=list)
    random_fraction: float = number(0.0, at_least=0.0, at_most=1e6)
    evaluated: list[str] = dataclasses.field(default_factory=list)
    armature: float = number(0.1, at_least=0.0, at_most=1e4)
    damping: float = number(1.0, at_least=0.0, at_most=1e4)

    def __post_init__(self) -> None:
        check_ranges(self, "arms.")
        if not self.locked_fraction + self.perturbed_fraction + self.random_fraction > 0:
            raise ValueError(
                "arms: expected locked_fraction, perturbed_fraction or random_fraction above 0, as in env=any_arm, got "
                "none"
            )
        for text in self.unseen:
            if not all(number.isdecimal() and int(number) > 0 for number in text.split("+")):
                raise ValueError(f"arms.unseen: expected numbers of joints from 1, as in 2 or 1+4, got {text!r:.80}")
        if bool(self.models) != (self.perturbed_fraction > 0):
            raise ValueError("arms: expected models and a perturbed_fraction above 0, or neither of them")
        if not self.locked_fraction and self.unseen:
            raise ValueError("arms.unseen: expected with a locked_fraction above 0, got none")

    @property
    def unseen_sets(self) -> list[tuple[int, ...]]:
        """The numbers of the locked joints, from 1, of each set in `unseen`."""
        return [tuple(sorted(int(number) for number in text.split("+"))) for text in self.unseen]


@dataclasses.dataclass(frozen=True)
class EnvConfig:
    """An imitation environment of one of three kinds: see `kind`.

    Attributes:
      name: name of the preset.
      expert, learner: the arms.
      arms: what the learner of each episode is drawn from, as of env=any_arm; null where it is always the same.
      limits: "none" (start in the zero pose, paper) or "hardware" (start in the ready pose, the manufacturer's joint
        ranges).
      metric: embodiment distance of the reward.
      demonstrations: motions to imitate.
      horizon: control steps of an episode.
      control_dt: duration of a control step [s]; the torque is constant within it.
      substeps: physics steps in a control step; with an inner loop there is one for each of its periods of 1 ms.
      physics: "mjx"; "fused": the same equations in one fused kernel, many times faster; or "auto": "fused" where it
        covers the learner exactly, otherwise "mjx", see `choose_physics` in mimic/physics/step.py.
      control: what an action is: "torque", which is constant in a control step (paper); or the target of an inner loop
        at 1 kHz: "joint_position" or "joint_velocity", see `mimic.control`; only in a `world`.
      world: gravity, friction, load, sensors and delays, and an inner loop at 1 kHz; null in the paper's world.
      preview: how many control steps ahead the learner also observes the expert; 0 is the paper.
      limit_weight: weight in the reward of joints near or beyond their range and velocity limit; only where `limits`
        is "hardware".
      action_scale: factor on the torque range; at 1 the range is twice the torque that takes a joint from rest to its
        velocity limit in one step, cut at the torque limit.
      speed_bound: joint speed [rad/s] at which an episode ends as a runaway.
      reward, observation: registered terms that are added.
      environment: registered subclass of `ImitationEnv`; that class itself where empty.
    """

    name: str = ""
    expert: ArmConfig = dataclasses.field(default_factory=ArmConfig)
    learner: ArmConfig = dataclasses.field(default_factory=ArmConfig)
    arms: ArmsConfig | None = None
    limits: str = "none"
    metric: MetricConfig = dataclasses.field(default_factory=MetricConfig)
    demonstrations: DemonstrationConfig = dataclasses.field(default_factory=DemonstrationConfig)
    horizon: int = number(50, at_least=1, at_most=10_000)
    control_dt: float = number(0.1, at_least=1e-4, at_most=10.0)  # robots are controlled at 10 kHz at most
    substeps: int = number(10, at_least=1, at_most=1000)  # 0.1 ms for the default control step
    physics: str = AUTO
    control: str = "torque"
    world: WorldConfig | None = None
    preview: int = number(1, at_least=0, at_most=100)  # each step adds an expert to the observation
    limit_weight: float = number(1.0, at_least=0.0, at_most=1e6)
    action_scale: float = number(1.0, at_least=1e-3, at_most=1000.0)  # the torque is cut at the torque limit anyway
    speed_bound: ClassVar[float] = 30.0  # the fastest joints of robots reach it

    reward: RewardConfig = dataclasses.field(default_factory=RewardConfig)
    observation: ObservationConfig = dataclasses.field(default_factory=ObservationConfig)
    environment: str = ""

    def __post_init__(self) -> None:
        check_choice("limits", self.limits, LIMITS)
        check_choice("physics", self.physics, (AUTO, *PHYSICS))
        check_choice("control", self.control, MODES)
        check_ranges(self)
        self._check_applies()
        for name in self.reward.terms:
            registry.check("reward_term", name, "reward.terms")
        for name in self.observation.terms:
            registry.check("observation_term", name, "observation.terms")
        if self.environment:
            registry.check("environment", self.environment, "environment")
        is_recorded = not (self.demonstrations.path or self.demonstrations.source)
        recorded = 0 if not is_recorded else self.demonstrations.count + self.demonstrations.held_out
        steps = recorded * self.horizon * self.recording_substeps
        if steps > _MAX_RECORDED_STEPS:
            raise ValueError(
                f"demonstrations: expected (count + held_out) * horizon * substeps of at most {_MAX_RECORDED_STEPS:,} "
                f"physics steps to record, got {steps:,}"
            )

    def _check_applies(self) -> None:
        """Raises a ValueError for a value that has no effect in an environment of this kind."""
        if self.arms is not None and self.world is not None:
            raise ValueError("arms, world: expected one of them, got both")
        if self.world is None and self.control != "torque":
            raise ValueError(
                f"control: expected torque without an inner loop, got {self.control}; world=ideal, nominal or hardware "
                "has one"
            )
        if self.limits == "none" and self.limit_weight != EnvConfig.limit_weight:
            raise ValueError(f"limit_weight: expected with limits=hardware, got {self.limit_weight}")
        if self.world is not None and self.substeps != EnvConfig.substeps:
            raise ValueError(f"substeps: expected none with an inner loop, whose steps take 1 ms, got {self.substeps}")

    @property
    def kind(self) -> Kind:
        """The kind of environment: one arm in the paper's world, one with an inner loop in a world, or sampled arms."""
        if self.arms is not None:
            return "sampled_arms"
        return "one_arm" if self.world is None else "inner_loop"

    @property
    def recording_substeps(self) -> int:
        """Physics steps in a control step of the demonstrations that are recorded."""
        return max(1, round(self.control_dt / _RECORDING_TIMESTEP)) if self.kind == "inner_loop" else self.substeps

    def build_arms(self) -> ArmPair:
        """Both arms, with the links that the metric compares.

        Raises:
          ValueError: an arm that cannot be loaded, or a learner that is drawn for each episode.
        """
        self.check_one_learner()
        return ArmPair(self.build_arm("expert"), self.build_arm("learner"))

    def build_arm(self, role: str) -> Arm:
        """The "expert" or the "learner", with the links that the metric compares; the line of an error names it."""
        with errors_of(role):
            return build_arm(getattr(self, role), self.limits, self.metric.links)

    def check_one_learner(self) -> None:
        """Raises a ValueError where the learner is another arm in each episode."""
        if self.kind == "sampled_arms":
            raise ValueError(
                f"env: expected an environment of one learner, got {self.name!r}, which draws another learner for each "
                "episode; python -m mimic.evaluate run=DIR learner=NAME evaluates a policy of it on one learner"
            )
