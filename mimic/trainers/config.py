"""The config of a training run. `python -m mimic.train` composes it from mimic/conf and the command line."""

import dataclasses
from typing import Any, ClassVar

from omegaconf import MISSING

from mimic.base import registry
from mimic.base.config import check_choice
from mimic.base.ranges import check_ranges, number, seed_number
from mimic.envs.config import EnvConfig
from mimic.runs.distributed.process_group import DistributedConfig

NETWORKS = ("mlp", "joints")
LOGGERS = ("local", "wandb", "mlflow")

PRESETS: dict[str, dict[str, Any]] = {
    # Two cores: few environments and many gradient steps on each sample, because the physics takes most of the time.
    "cpu": {
        "num_timesteps": 3_000_000,
        "num_envs": 512,
        "unroll_length": 10,
        "batch_size": 128,
        "num_minibatches": 32,
        "num_updates_per_batch": 8,
        "learning_rate": 1e-3,
        "final_learning_rate": 0.05,
        "discounting": 0.8,
        "entropy_cost": 0.01,
        "final_entropy_cost": 1.0,
        "network": "mlp",
        "hidden_layers": [128, 128],
        "crossovers": 0,
        "evaluations": 10,
    },
    # One GPU: enough environments to keep it busy. The high entropy cost makes the arm explore other pose branches.
    "gpu": {
        "num_timesteps": 150_000_000,
        "num_envs": 4096,
        "unroll_length": 10,
        "batch_size": 512,
        "num_minibatches": 32,
        "num_updates_per_batch": 4,
        "learning_rate": 1e-3,
        "final_learning_rate": 0.01,
        "discounting": 0.95,
        "entropy_cost": 0.2,
        "final_entropy_cost": 0.05,
        "network": "mlp",
        "hidden_layers": [512, 256],
        "crossovers": 2000,
        "evaluations": 8,
    },
}
# Where the learner is drawn for each episode, an untrained policy is a good controller already: small steps, without a
# reward for noise, and a long horizon, because it pays off late to move to another minimum of the metric.
_OF_DRAWN_ARMS = {
    "network": "joints",
    "learning_rate": 3e-4,
    "final_learning_rate": 0.1,
    "discounting": 0.97,
    "entropy_cost": 0.0,
    "final_entropy_cost": 1.0,
}
# With an inner loop: a smaller learning rate ends with a smaller gap (measured), and delays need a longer horizon.
_OF_INNER_LOOP = {"learning_rate": 3e-4, "discounting": 0.9, "entropy_cost": 0.02}
# Presets in the order of the backends cpu and gpu.
_ONE_ARM, _DRAWN_ARMS, _INNER_LOOP = ("cpu", "gpu"), ("any_arm_cpu", "any_arm"), ("inner_loop_cpu", "inner_loop")
PRESETS |= {name: {**PRESETS[base], **_OF_DRAWN_ARMS} for name, base in zip(_DRAWN_ARMS, _ONE_ARM, strict=True)}
PRESETS |= {name: {**PRESETS[base], **_OF_INNER_LOOP} for name, base in zip(_INNER_LOOP, _ONE_ARM, strict=True)}
PRESETS["any_arm_cpu"] |= {"num_timesteps": 600_000, "evaluations": 5}  # eleven minutes on two cores
PRESETS["any_arm"] |= {"num_timesteps": 30_000_000}  # 0.6 million arms; from 12 to 22 million steps on nothing changed
# Layers twice as wide have about the same gap (docs/hardware_world.md), and a robot's computer takes longer for them.
PRESETS["inner_loop"] |= {"num_timesteps": 120_000_000, "hidden_layers": [256, 128]}
# Factor on the number of evaluations with a target gap, so that training ends soon after the gap is reached: an
# evaluation takes less time than the steps between two evaluations.
_TARGET_GAP_EVALUATIONS = 5


@dataclasses.dataclass(frozen=True)
class TrainerConfig:
    """The fields of all trainers.

    Attributes:
      name: name of the trainer.
      preset: name of the preset; it gives the values of the fields that are None.
      keep: number of newest checkpoints that a run keeps.
    """

    length_key: ClassVar[str]  # the field that sets the training length

    name: str = MISSING
    preset: str = MISSING
    keep: int = number(50, at_least=2, at_most=1_000_000)

    @property
    def total_steps(self) -> int:
        """Length of a training with resolved settings."""
        raise NotImplementedError

    def resolve(self) -> "TrainerConfig":
        """The settings with every field filled in. Raises a `ValueError` where a value is out of range."""
        raise NotImplementedError


@dataclasses.dataclass(frozen=True)
class PPOConfig(TrainerConfig):
    """PPO, on brax's networks. A field that is None takes its value from the preset.

    Attributes:
      name: "ppo".
      preset: "cpu" or "gpu"; where the learner is drawn for each episode "any_arm_cpu" or "any_arm"; with an inner loop
        (`env.control`, `world`) "inner_loop_cpu" or "inner_loop"; or "auto", which follows JAX's backend.
      num_timesteps: environment steps of the training, rounded up to whole training epochs; a training epoch is the
        training between two evaluations.
      num_envs: number of arms that are simulated in parallel.
      unroll_length: steps of an unroll, which are consecutive steps of one arm.
      batch_size: unrolls in a minibatch.
      num_minibatches: minibatches in a batch; batch_size * num_minibatches must be a multiple of num_envs.
      num_updates_per_batch: passes over a batch.
      learning_rate: Adam's learning rate at the start.
      final_learning_rate: learning rate at the end as a fraction of learning_rate; the decay is linear.
      discounting: discount factor of the reward at the start.
      final_discounting: discount factor at the end; the change is linear. The same as at the start where None.
      gae_lambda: lambda of generalised advantage estimation.
      entropy_cost: weight of the policy's entropy in the loss at the start.
      final_entropy_cost: entropy cost at the end as a fraction of entropy_cost; the change is linear.
      clipping_epsilon: the policy ratio is clipped to 1 +- this.
      max_grad_norm: gradients are clipped to this norm, see `updated` in mimic/trainers/ppo/updates.py.
      reward_scaling: factor on the reward inside PPO.
      network: "mlp"; or "joints", a policy with a token for each joint, for environments with a drawn arm.
      hidden_layers: widths of the hidden layers of the policy and value networks; with network "joints" of the latter.
      crossovers: number of additional training demonstrations, mixed joint by joint from the recorded ones, see
        `crossovers` in mimic/motions/demonstrations.py.
      timed_critic: whether the value network also observes the elapsed fraction of the episode, on which the return
        depends. The policy never observes it.
      target_gap: training ends early when the optimality gap on the training demonstrations is at most this; 0 disables
        it.
      evaluations: number of evaluations and checkpoints, as far as whole batches allow; with a target gap five times
        the preset's number.
      keep: number of newest checkpoints that the run keeps, at least 2: those two can be resumed exactly.
    """

    length_key: ClassVar[str] = "num_timesteps"

    name: str = "ppo"
    preset: str = "auto"
    # Sizes: `check_training_memory` rejects products that do not fit.
    num_timesteps: int | None = number(None, at_least=1, at_most=10**12)  # a week on eight GPUs
    num_envs: int | None = number(None, at_least=1, at_most=2**22)
    unroll_length: int | None = number(None, at_least=1, at_most=10_000)
    batch_size: int | None = number(None, at_least=1, at_most=2**22)
    num_minibatches: int | None = number(None, at_least=1, at_most=100_000)
    num_updates_per_batch: int | None = number(None, at_least=1, at_most=1000)
    # Adam's steps are about as large as its rate, and the initial weights are below 1.
    learning_rate: float | None = number(None, above=0.0, at_most=1.0)
    final_learning_rate: float | None = number(None, at_least=0.0, at_most=1.0)
    discounting: float | None = number(None, at_least=0.0, at_most=1.0)
    final_discounting: float | None = number(None, at_least=0.0, at_most=1.0)
    gae_lambda: float = number(0.9, at_least=0.0, at_most=1.0)
    entropy_cost: float | None = number(None, at_least=0.0, at_most=1000.0)
    final_entropy_cost: float | None = number(None, at_least=0.0, at_most=1.0)
    clipping_epsilon: float = number(0.2, above=0.0, at_most=10.0)
    max_grad_norm: float = number(1.0, above=0.0, at_most=1e6)
    reward_scaling: float = number(10.0, above=0.0, at_most=1e6)  # its square is in the loss
    network: str | None = None
    hidden_layers: list[int] | None = number(None, at_least=1, at_most=2**16, entries=(1, 32))
    crossovers: int | None = number(None, at_least=0, at_most=100_000)
    timed_critic: bool = True
    target_gap: float = number(0.0, at_least=0.0, at_most=100.0)
    evaluations: int | None = number(None, at_least=1, at_most=1_000_000)

    def __post_init__(self) -> None:
        check_choice("trainer.preset", self.preset, ("auto", *PRESETS))
        check_choice("trainer.name", self.name, ("ppo",))
        if self.network is not None:
            check_choice("trainer.network", self.network, NETWORKS)
        check_ranges(self, "trainer.")

    def resolve(self, backend: str = "cpu", devices: int = 1, *, env: EnvConfig | None = None) -> "PPOSettings":
        """Returns the settings: every field has a value, and `preset` is never "auto".

        Args:
          backend: JAX's backend; it chooses the preset where that is "auto".
          devices: number of devices that environments and batches are distributed over.
          env: the environment, which chooses the preset too; one learner and the world of the paper where None.

        Raises:
          ValueError: numbers out of range, or batch sizes that PPO cannot divide.
        """
        presets = _ONE_ARM
        if env is not None and (env.arms.are_drawn or env.has_inner_loop):
            presets = _DRAWN_ARMS if env.arms.are_drawn else _INNER_LOOP
        name = self.preset if self.preset != "auto" else presets[backend != "cpu"]
        preset = PRESETS[name]
        if self.target_gap > 0:
            preset = {**preset, "evaluations": _TARGET_GAP_EVALUATIONS * preset["evaluations"]}
        fields = _filled_in(self, preset)
        if self.final_discounting is None:
            fields["final_discounting"] = fields["discounting"]
        settings = PPOSettings(**{**fields, "preset": name})
        settings.check(devices)
        return settings


@dataclasses.dataclass(frozen=True)
class PPOSettings(PPOConfig):
    """A PPO config where every field has a value: used by the training and saved in the run directory."""

    num_timesteps: int = MISSING
    num_envs: int = MISSING
    unroll_length: int = MISSING
    batch_size: int = MISSING
    num_minibatches: int = MISSING
    num_updates_per_batch: int = MISSING
    learning_rate: float = MISSING
    final_learning_rate: float = MISSING
    discounting: float = MISSING
    final_discounting: float = MISSING
    entropy_cost: float = MISSING
    final_entropy_cost: float = MISSING
    network: str = MISSING
    hidden_layers: list[int] = MISSING
    crossovers: int = MISSING
    evaluations: int = MISSING

    def check(self, devices: int) -> None:
        """Raises a ValueError for batch sizes that the environments or the devices cannot divide."""
        unrolls = self.batch_size * self.num_minibatches
        if unrolls % self.num_envs:
            raise ValueError(
                f"trainer: batch_size * num_minibatches = {self.batch_size} * {self.num_minibatches} = {unrolls} "
                f"must be a multiple of num_envs = {self.num_envs}"
            )
        for key in ("num_envs", "batch_size"):
            if getattr(self, key) % devices:
                raise ValueError(
                    f"trainer.{key}: expected a multiple of the {devices} devices, got {getattr(self, key)}"
                )

    @property
    def total_steps(self) -> int:
        """Environment steps of the training."""
        return self.num_timesteps

    def at(self, progress: Any) -> "PPOSettings":
        """Returns the settings at a fraction of the training, with the entropy cost and the discount factor there.

        Args:
          progress: in [0, 1], a number or a scalar array.
        """
        if self.final_entropy_cost == 1 and self.final_discounting == self.discounting:
            return self
        return dataclasses.replace(
            self,
            entropy_cost=self.entropy_cost * (1 + progress * (self.final_entropy_cost - 1)),
            discounting=self.discounting + progress * (self.final_discounting - self.discounting),
        )

    @property
    def steps_per_batch(self) -> int:
        """Environment steps of a batch: one policy collects all of them."""
        return self.batch_size * self.num_minibatches * self.unroll_length


MAPPER_PRESETS: dict[str, dict[str, Any]] = {
    # Network, training set and minibatches are the paper's. The paper does not state optimiser, rate, epochs, patience.
    "paper": {
        "inputs": "angles",
        "outputs": "tanh",
        "heads": 1,
        "hidden_layers": [32, 32, 32],
        "activation": "leaky_relu",
        "samples": 1024,
        "batch_size": 32,
        "fresh": False,
        "epochs": 2000,
        "learning_rate": 1e-3,
        "final_learning_rate": 1.0,
        "weight_decay": 0.0,
        "patience": 10,
        "evaluations": 100,
        "held_out_poses": 10_000,
    },
    # The best by measurement, both on a GPU and on two cores.
    "large": {
        "inputs": "link_states",
        "outputs": "circle",
        "heads": 4,
        "hidden_layers": [128, 128, 128],
        "activation": "gelu",
        "samples": 65_536,
        "batch_size": 512,
        "fresh": True,
        "epochs": 30,
        "learning_rate": 2e-3,
        "final_learning_rate": 1e-3,
        "weight_decay": 0.0,
        "patience": 0,
        "evaluations": 10,
        "held_out_poses": 10_000,
    },
    # A learner that is drawn for each training pose, on one GPU: 26 million arms and poses.
    "any_arm": {
        "width": 128,
        "layers": 3,
        "heads": 8,
        "guesses": 8,
        "refinements": 8,
        "samples": 262_144,
        "batch_size": 2048,
        "fresh": True,
        "epochs": 92,
        "learning_rate": 1e-3,
        "final_learning_rate": 1e-3,
        "weight_decay": 1e-4,
        "patience": 0,
        "evaluations": 8,
        "held_out_poses": 256,
    },
    # The same on two cores, in about 15 minutes: some 4000 arms and poses in a second.
    "any_arm_cpu": {
        "width": 64,
        "layers": 2,
        "heads": 8,
        "guesses": 8,
        "refinements": 8,
        "samples": 65_536,
        "batch_size": 512,
        "fresh": True,
        "epochs": 48,
        "learning_rate": 2e-3,
        "final_learning_rate": 1e-3,
        "weight_decay": 1e-4,
        "patience": 0,
        "evaluations": 8,
        "held_out_poses": 32,
    },
}
_ONE_LEARNER_PRESETS, _ANY_ARM_PRESETS = ("paper", "large"), ("any_arm", "any_arm_cpu")
# Fields that apply only to the network of one learner, and only to that of any arm.
_OF_ONE_LEARNER = ("inputs", "outputs", "hidden_layers", "activation")
_OF_ANY_ARM = ("width", "layers", "guesses", "refinements")
ATTENTION_HEADS = 4  # of each layer of the network of any arm
MAPPER_INPUTS, MAPPER_OUTPUTS, ACTIVATIONS = ("angles", "link_states"), ("tanh", "circle"), ("leaky_relu", "gelu")


@dataclasses.dataclass(frozen=True)
class PoseMapperConfig(TrainerConfig):
    """The neural pose mapper. A field that is None takes its value from the preset.

    If the environment draws its learner (`env.arms`), one network maps to all of these arms: see
    `mimic.trainers.pose_mapper.any_arm_model`. It has `width`, `layers`, `guesses` and `refinements`, and neither
    `inputs`, `outputs`, `hidden_layers`, `activation` nor `dropout`. A training pose is then a pose of the expert and
    an arm, and with `env.arms.expert=drawn` the expert is another arm for each pose too.

    Attributes:
      name: "pose_mapper".
      preset: "large" or "paper" for one learner, "any_arm" or "any_arm_cpu" where the learner is drawn, or "auto":
        "large", or of the latter two that of JAX's backend.
      inputs: "angles" of the expert (paper), or its "link_states": positions and directions.
      outputs: "tanh", scaled to the joint's range (paper), or "circle": a point on the unit circle for joints whose
        range is a full rotation.
      heads: number of poses that the network proposes; the nearest one is the output, to any arm after Newton steps.
      hidden_layers: widths of the hidden layers.
      activation: "leaky_relu" (paper) or "gelu".
      width: of a token of the network of any arm; a multiple of 4.
      layers: transformer layers of the network of any arm.
      guesses: number of constant poses of the learner, spread over its joints' ranges, which the mapper to any arm
        improves beside those of its network.
      refinements: Newton steps of the mapper to any arm from each of these poses; training has none.
      samples: poses in an epoch.
      batch_size: poses in a minibatch; must divide samples.
      fresh: whether each epoch draws new random poses; otherwise all epochs have the same poses, shuffled.
      epochs: number of epochs.
      learning_rate: Adam's learning rate after a warm-up.
      final_learning_rate: learning rate at the end as a fraction of learning_rate; the decay is a cosine. With 1 the
        rate is constant, without warm-up.
      dropout: fraction of the hidden units of each layer that is dropped for a training pose, in [0, 1). The paper
        mentions it against overfitting and does not use it; the presets do not either.
      weight_decay: AdamW's: each update subtracts the fraction learning_rate * weight_decay of every weight; biases do
        not decay. The presets for one learner do not use it.
      patience: training ends after this many evaluations without a smaller distance on the validation poses; 0 disables
        it.
      target_quality: training ends early when the quality on the validation poses, or on the arms seen in training, is
        at most this; 0 disables it.
      evaluations: number of evaluations and checkpoints.
      validation_poses: number of poses that early stopping is decided on.
      held_out_poses: number of poses that the report is computed on, the same for each arm.
    """

    length_key: ClassVar[str] = "epochs"

    name: str = "pose_mapper"
    preset: str = "auto"
    inputs: str | None = None
    outputs: str | None = None
    # Sizes: `check_training_memory` rejects products that do not fit.
    heads: int | None = number(None, at_least=1, at_most=1000)
    hidden_layers: list[int] | None = number(None, at_least=1, at_most=2**16, entries=(1, 32))
    activation: str | None = None
    width: int | None = number(None, at_least=4, at_most=2**14)
    layers: int | None = number(None, at_least=1, at_most=100)
    guesses: int | None = number(None, at_least=0, at_most=1000)
    refinements: int | None = number(None, at_least=0, at_most=1000)
    samples: int | None = number(None, at_least=1, at_most=10**9)
    batch_size: int | None = number(None, at_least=1, at_most=10**9)
    fresh: bool | None = None
    epochs: int | None = number(None, at_least=1, at_most=10_000_000)
    # Adam's steps are about as large as its rate, and the initial weights are below 1.
    learning_rate: float | None = number(None, above=0.0, at_most=1.0)
    final_learning_rate: float | None = number(None, at_least=0.0, at_most=1.0)
    dropout: float = number(0.0, at_least=0.0, below=1.0)
    weight_decay: float | None = number(None, at_least=0.0, at_most=1000.0)  # times the rate in an update
    patience: int | None = number(None, at_least=0, at_most=1_000_000)
    target_quality: float = number(0.0, at_least=0.0, at_most=100.0)
    evaluations: int | None = number(None, at_least=1, at_most=1_000_000)
    validation_poses: int = number(1024, at_least=1, at_most=10_000_000)
    held_out_poses: int | None = number(None, at_least=1, at_most=10_000_000)

    def __post_init__(self) -> None:
        check_choice("trainer.preset", self.preset, ("auto", *MAPPER_PRESETS))
        check_choice("trainer.name", self.name, ("pose_mapper",))
        check_ranges(self, "trainer.")

    def resolve(self) -> "PoseMapperSettings":
        """Returns the settings of a mapper to one learner: every field has a value.

        Raises:
          ValueError: numbers out of range, a batch size that does not divide the samples, or a setting of a mapper to
            any arm.
        """
        name = "large" if self.preset == "auto" else self.preset
        self._check_applies(name, _ONE_LEARNER_PRESETS, _OF_ANY_ARM, "to one learner")
        settings = PoseMapperSettings(**{**_filled_in(self, MAPPER_PRESETS[name]), "preset": name})
        settings.check()
        return settings

    def resolve_any_arm(self, backend: str = "cpu") -> "AnyArmMapperSettings":
        """Returns the settings of a mapper to any arm: every field that applies has a value.

        Args:
          backend: JAX's backend; it chooses the preset where that is "auto".

        Raises:
          ValueError: numbers out of range, a batch size that does not divide the samples, or a setting of a mapper to
            one learner.
        """
        name = self.preset if self.preset != "auto" else "any_arm_cpu" if backend == "cpu" else "any_arm"
        self._check_applies(name, _ANY_ARM_PRESETS, _OF_ONE_LEARNER, "to any arm (env.arms)")
        if self.dropout:
            raise ValueError(f"trainer.dropout: expected 0 for a mapper to any arm (env.arms), got {self.dropout}")
        settings = AnyArmMapperSettings(**{**_filled_in(self, MAPPER_PRESETS[name]), "preset": name})
        settings.check()
        return settings

    def _check_applies(self, preset: str, valid: tuple[str, ...], others: tuple[str, ...], kind: str) -> None:
        """Raises a ValueError for a preset or a field of the other kind of mapper."""
        if preset not in valid:
            raise ValueError(f"trainer.preset: expected {' or '.join(valid)} for a mapper {kind}, got {preset}")
        for field in others:
            if getattr(self, field) is not None:
                raise ValueError(f"trainer.{field}: expected none for a mapper {kind}, got {getattr(self, field)}")

    def _check_batch_size(self) -> None:
        if self.samples % self.batch_size:  # type: ignore[operator] - called by classes whose fields have values
            raise ValueError(
                f"trainer.batch_size: expected a divisor of samples = {self.samples}, got {self.batch_size}"
            )


@dataclasses.dataclass(frozen=True)
class PoseMapperSettings(PoseMapperConfig):
    """A pose mapper's config where every field has a value, but for those of a mapper to any arm."""

    inputs: str = MISSING
    outputs: str = MISSING
    heads: int = MISSING
    hidden_layers: list[int] = MISSING
    activation: str = MISSING
    samples: int = MISSING
    batch_size: int = MISSING
    fresh: bool = MISSING
    epochs: int = MISSING
    learning_rate: float = MISSING
    final_learning_rate: float = MISSING
    weight_decay: float = MISSING
    patience: int = MISSING
    evaluations: int = MISSING
    held_out_poses: int = MISSING

    def check(self) -> None:
        """Raises a ValueError for an unknown choice, or a batch size that does not divide the samples."""
        check_choice("trainer.inputs", str(self.inputs), MAPPER_INPUTS)
        check_choice("trainer.outputs", str(self.outputs), MAPPER_OUTPUTS)
        check_choice("trainer.activation", str(self.activation), ACTIVATIONS)
        self._check_batch_size()

    @property
    def total_steps(self) -> int:
        """Training poses, counted in every epoch."""
        return self.samples * self.epochs


@dataclasses.dataclass(frozen=True)
class AnyArmMapperSettings(PoseMapperConfig):
    """The config of a mapper to any arm where every field has a value, but for those of a mapper to one learner."""

    heads: int = MISSING
    width: int = MISSING
    layers: int = MISSING
    guesses: int = MISSING
    refinements: int = MISSING
    samples: int = MISSING
    batch_size: int = MISSING
    fresh: bool = MISSING
    epochs: int = MISSING
    learning_rate: float = MISSING
    final_learning_rate: float = MISSING
    weight_decay: float = MISSING
    patience: int = MISSING
    evaluations: int = MISSING
    held_out_poses: int = MISSING

    def check(self) -> None:
        """Raises a ValueError for a width that attention cannot divide, or a batch size that no epoch can."""
        if self.width % ATTENTION_HEADS:
            raise ValueError(f"trainer.width: expected a multiple of {ATTENTION_HEADS}, got {self.width}")
        self._check_batch_size()

    @property
    def total_steps(self) -> int:
        """Training poses, each with an arm, counted in every epoch."""
        return self.samples * self.epochs


MapperSettings = PoseMapperSettings | AnyArmMapperSettings
BUILT_IN_TRAINERS: dict[str, type[TrainerConfig]] = {"ppo": PPOConfig, "pose_mapper": PoseMapperConfig}
registry.reserve("trainer", tuple(BUILT_IN_TRAINERS))


def trainers() -> tuple[str, ...]:
    """The names of the trainers, those of mimic first and then those that are registered."""
    return (*BUILT_IN_TRAINERS, *registry.names("trainer"))


def trainer_config(name: str) -> type[TrainerConfig]:
    """The config class of a trainer.

    Raises:
      ValueError: an unknown trainer, or a registered one whose `config_class` is no frozen dataclass with that name.
    """
    if name in BUILT_IN_TRAINERS:
        return BUILT_IN_TRAINERS[name]
    config_class: Any = getattr(registry.find("trainer", name, "trainer.name"), "config_class", None)
    is_config = isinstance(config_class, type) and issubclass(config_class, TrainerConfig)
    if not (is_config and getattr(config_class, "name", None) == name):
        raise ValueError(
            f"trainer {name!r}: expected the attribute config_class, a frozen dataclass derived from TrainerConfig "
            f"with the default name = {name!r}, got {config_class!r:.80}"
        )
    return config_class


def _filled_in(config: TrainerConfig, preset: dict[str, Any]) -> dict[str, Any]:
    """All fields; where one is None, the preset's value."""
    fields = {field.name: getattr(config, field.name) for field in dataclasses.fields(config)}
    return {key: preset.get(key) if value is None else value for key, value in fields.items()}


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """A training run.

    Attributes:
      env: see `EnvConfig`.
      trainer: config of one of `trainers()`.
      seed: random seed of networks, exploration and resets.
      run_dir: folder that the run writes to; runs/ENV-TRAINER-seedSEED-TIME where empty.
      resume: run directory of the run to continue.
      init: run directory of another run; training starts from the parameters of its last checkpoint.
      learner: with `init`, a run of many arms: name or file of the one arm that training then goes on with, see
        `fine_tuned` in mimic/trainers/fine_tuning.py.
      logger: "local", "wandb", "mlflow", or a list of these: services that metrics are sent to. The run directory
        always has the metrics.
      compilation_cache: folder where JAX keeps compiled functions between runs; none where empty.
      distributed: see `DistributedConfig`.
    """

    env: EnvConfig = dataclasses.field(default_factory=EnvConfig)
    trainer: TrainerConfig = dataclasses.field(default_factory=TrainerConfig)
    seed: int = seed_number()
    run_dir: str = ""
    resume: str = ""
    init: str = ""
    learner: str = ""
    logger: Any = "local"
    compilation_cache: str = "~/.cache/mimic/jax"
    distributed: DistributedConfig = dataclasses.field(default_factory=DistributedConfig)

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.learner and not self.init:
            raise ValueError(
                f"learner: expected with init=DIR of a run of many arms, got {self.learner!r} without it; env.learner "
                "is the learner of an environment"
            )
        for name in self.loggers:
            check_choice("logger", name, LOGGERS)

    @property
    def loggers(self) -> list[str]:
        """The names in `logger` as a list."""
        return [self.logger] if isinstance(self.logger, str) else list(map(str, self.logger or ()))

    def resolved_trainer(self, backend: str = "cpu", devices: int = 1) -> TrainerConfig:
        """The trainer's settings for this environment, with every field that applies filled in.

        Args:
          backend: JAX's backend; it chooses the preset where that is "auto".
          devices: number of devices.

        Raises:
          ValueError: a value out of range, or one that does not apply to the environment.
        """
        drawn_arms = self.env.arms.are_drawn
        if isinstance(self.trainer, PPOConfig):
            return self.trainer.resolve(backend, devices, env=self.env)
        if isinstance(self.trainer, PoseMapperConfig) and drawn_arms:
            return self.trainer.resolve_any_arm(backend)
        return self.trainer.resolve()
