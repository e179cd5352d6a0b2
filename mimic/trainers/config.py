"""The config of a training run. `python -m mimic.train` composes it from mimic/conf and the command line."""

import dataclasses
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Optional, Self, TypeVar

from omegaconf import MISSING

from mimic.base import registry
from mimic.base.config import check_choice
from mimic.base.ranges import check_ranges, number, seed_number
from mimic.envs import env_config, environments
from mimic.envs.config import EnvConfig
from mimic.runs.distributed.process_group import DistributedConfig
from mimic.trainers.presets import MAPPER_PRESETS, PPO_PRESETS, PPO_PRESETS_OF

if TYPE_CHECKING:
    _Value = TypeVar("_Value")
    FromPreset = Annotated[_Value, "a value once the config is resolved"]
else:
    FromPreset = Optional  # None: the preset's value


def _unset() -> Any:
    """A field without a value: the preset gives it."""
    return dataclasses.field(default=None)


NETWORKS = ("mlp", "joints")
LOOPS = ("mimic", "brax")
# Settings that brax's loop lacks, with the values by which ours has none of them either.
_WITHOUT_SCHEDULES = {"final_learning_rate": 1.0, "final_entropy_cost": 1.0, "privileged_critic": False}
LOGGERS = ("local", "wandb")


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
        """Length of a training with a resolved config."""
        raise NotImplementedError

    def resolve(self, backend: str = "cpu", devices: int = 1, *, env: EnvConfig | None = None) -> Self:
        """The config with a value in every field that applies; a resolved config stays as it is.

        Args:
          backend: JAX's backend, by which "auto" chooses the preset.
          devices: number of devices that train.
          env: the environment, by which "auto" chooses the preset too; one learner and the paper's world where None.

        Raises:
          ValueError: a value that does not fit the others, the devices or the environment.
        """
        del backend, devices, env
        return self


@dataclasses.dataclass(frozen=True)
class PPOConfig(TrainerConfig):
    """PPO, on brax's networks. A field that is None takes its value from the preset.

    Attributes:
      name: "ppo".
      preset: "cpu" or "gpu"; where the learner is drawn for each episode "any_arm_cpu" or "any_arm"; with an inner loop
        (`env.control`, `world`) "inner_loop_cpu" or "inner_loop"; or "auto", which follows JAX's backend.
      loop: "mimic"; or "brax", brax's own training loop (`trainer=brax`), without schedules, `privileged_critic` and
        `resume=`.
      num_timesteps: environment steps of the training, rounded up to whole training epochs; a training epoch is the
        training between two evaluations.
      num_envs: number of arms that are simulated in parallel.
      unroll_length: steps of an unroll, which are consecutive steps of one arm.
      batch_size: unrolls in a minibatch.
      num_minibatches: minibatches in a batch; batch_size * num_minibatches must be a multiple of num_envs.
      num_updates_per_batch: passes over a batch.
      learning_rate: Adam's learning rate at the start.
      final_learning_rate: learning rate at the end as a fraction of learning_rate; the decay is linear.
      discounting: discount factor of the reward.
      gae_lambda: lambda of generalised advantage estimation.
      entropy_cost: weight of the policy's entropy in the loss at the start.
      final_entropy_cost: entropy cost at the end as a fraction of entropy_cost; the change is linear.
      clipping_epsilon: the policy ratio is clipped to 1 +- this.
      max_grad_norm: gradients are clipped to this norm, see `update` in mimic/trainers/ppo/ppo.py.
      reward_scaling: factor on the reward inside PPO.
      network: "mlp"; or "joints", a policy with a token for each joint, for environments with a drawn arm.
      hidden_layers: widths of the hidden layers of the policy and value networks; with network "joints" of the latter.
      crossovers: number of additional training demonstrations, mixed joint by joint from the recorded ones, see
        `crossovers` in mimic/motions/demonstrations.py.
      displaced_crossovers: fraction of these that start anywhere in the joint ranges, where all demonstrations start in
        the same pose.
      privileged_critic: whether the value network also observes what the policy never does: the elapsed fraction of the
        episode, the expert's future and, in a world with an inner loop, what was drawn for it, see
        `ImitationEnv.privileged`.
      evaluations: number of evaluations and checkpoints, as far as whole batches allow.
      keep: number of newest checkpoints that the run keeps, at least 2: those two can be resumed exactly.
    """

    length_key: ClassVar[str] = "num_timesteps"

    name: str = "ppo"
    preset: str = "auto"
    loop: str = "mimic"
    num_timesteps: FromPreset[int] = number(None, at_least=1, at_most=10**12)  # a week on eight GPUs
    num_envs: FromPreset[int] = number(None, at_least=1, at_most=2**22)
    unroll_length: FromPreset[int] = number(None, at_least=1, at_most=10_000)
    batch_size: FromPreset[int] = number(None, at_least=1, at_most=2**22)
    num_minibatches: FromPreset[int] = number(None, at_least=1, at_most=100_000)
    num_updates_per_batch: FromPreset[int] = number(None, at_least=1, at_most=1000)
    # Adam's steps are about as large as its rate, and the initial weights are below 1.
    learning_rate: FromPreset[float] = number(None, above=0.0, at_most=1.0)
    final_learning_rate: FromPreset[float] = number(None, at_least=0.0, at_most=1.0)
    discounting: FromPreset[float] = number(None, at_least=0.0, at_most=1.0)
    gae_lambda: float = number(0.9, at_least=0.0, at_most=1.0)
    entropy_cost: FromPreset[float] = number(None, at_least=0.0, at_most=1000.0)
    final_entropy_cost: FromPreset[float] = number(None, at_least=0.0, at_most=1.0)
    clipping_epsilon: float = number(0.2, above=0.0, at_most=10.0)
    max_grad_norm: float = number(1.0, above=0.0, at_most=1e6)
    reward_scaling: float = number(10.0, above=0.0, at_most=1e6)  # its square is in the loss
    network: FromPreset[str] = _unset()
    hidden_layers: FromPreset[list[int]] = number(None, at_least=1, at_most=2**16, entries=(1, 32))
    crossovers: FromPreset[int] = number(None, at_least=0, at_most=100_000)
    displaced_crossovers: FromPreset[float] = number(None, at_least=0.0, at_most=1.0)
    privileged_critic: bool = True
    evaluations: FromPreset[int] = number(None, at_least=1, at_most=1_000_000)

    def __post_init__(self) -> None:
        check_choice("trainer.preset", self.preset, ("auto", *PPO_PRESETS))
        check_choice("trainer.name", self.name, ("ppo",))
        check_choice("trainer.loop", self.loop, LOOPS)
        if self.network is not None:
            check_choice("trainer.network", self.network, NETWORKS)
        check_ranges(self, "trainer.")

    def resolve(self, backend: str = "cpu", devices: int = 1, *, env: EnvConfig | None = None) -> Self:
        """See `TrainerConfig.resolve`."""
        of_backends = PPO_PRESETS_OF["one_arm" if env is None else env.kind]
        name = self.preset if self.preset != "auto" else of_backends[backend != "cpu"]
        preset = PPO_PRESETS[name]
        config = _filled_in(self, preset, preset=name)
        config._check(devices)
        if env is not None and config.network != "mlp" and env.kind != "sampled_arms":
            raise ValueError(
                f"trainer.network: expected mlp for one learner, got {config.network} (preset {name}), which is for a "
                "learner that is drawn for each episode (env.arms)"
            )
        return config

    def _check(self, devices: int) -> None:
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
        for key, value in _WITHOUT_SCHEDULES.items() if self.loop == "brax" else ():
            if getattr(self, key) != value:
                raise ValueError(f"trainer.{key}: expected {value} with brax's loop, got {getattr(self, key)}")

    @property
    def total_steps(self) -> int:
        """Environment steps of the training."""
        return self.num_timesteps

    def at(self, progress: Any) -> Self:
        """Returns the resolved config with the entropy cost at a fraction of the training.

        Args:
          progress: in [0, 1], a number or a scalar array.
        """
        if self.final_entropy_cost == 1:
            return self
        return dataclasses.replace(
            self, entropy_cost=self.entropy_cost * (1 + progress * (self.final_entropy_cost - 1))
        )

    @property
    def steps_per_batch(self) -> int:
        """Environment steps of a batch: one policy collects all of them."""
        return self.batch_size * self.num_minibatches * self.unroll_length


# Fields of an environment that a mapper does not use: it maps poses and simulates nothing.
_NOT_OF_MAPPERS = (
    *("demonstrations", "horizon", "preview", "reward", "observation", "limit_weight"),
    *("control_dt", "substeps", "physics", "action_scale"),
)
MAPPER_INPUTS, MAPPER_OUTPUTS, ACTIVATIONS = ("angles", "link_states"), ("tanh", "circle"), ("leaky_relu", "gelu")


@dataclasses.dataclass(frozen=True)
class PoseMapperConfig(TrainerConfig):
    """The neural pose mapper. A field that is None takes its value from the preset.

    Attributes:
      name: "pose_mapper".
      preset: "large", which "auto" is too, or "paper".
      inputs: "angles" of the expert (paper), or its "link_states": positions and directions.
      outputs: "tanh", scaled to the joint's range (paper), or "circle": a point on the unit circle for joints whose
        range is a full rotation.
      heads: number of poses that the network proposes; the nearest one is the output.
      hidden_layers: widths of the hidden layers.
      activation: "leaky_relu" (paper) or "gelu".
      samples: poses in an epoch.
      batch_size: poses in a minibatch; must divide samples.
      fresh: whether each epoch draws new random poses; otherwise all epochs have the same poses, shuffled.
      epochs: number of epochs.
      learning_rate: Adam's learning rate after a warm-up.
      final_learning_rate: learning rate at the end as a fraction of learning_rate; the decay is a cosine. With 1 the
        rate is constant, without warm-up.
      patience: training ends after this many evaluations without a smaller distance on the validation poses; 0 disables
        it.
      evaluations: number of evaluations and checkpoints.
      validation_poses: number of poses that early stopping is decided on.
      held_out_poses: number of poses that the report is computed on.
    """

    length_key: ClassVar[str] = "epochs"

    name: str = "pose_mapper"
    preset: str = "auto"
    inputs: FromPreset[str] = _unset()
    outputs: FromPreset[str] = _unset()
    heads: FromPreset[int] = number(None, at_least=1, at_most=1000)
    hidden_layers: FromPreset[list[int]] = number(None, at_least=1, at_most=2**16, entries=(1, 32))
    activation: FromPreset[str] = _unset()
    samples: FromPreset[int] = number(None, at_least=1, at_most=10**9)
    batch_size: FromPreset[int] = number(None, at_least=1, at_most=10**9)
    fresh: FromPreset[bool] = _unset()
    epochs: FromPreset[int] = number(None, at_least=1, at_most=10_000_000)
    # Adam's steps are about as large as its rate, and the initial weights are below 1.
    learning_rate: FromPreset[float] = number(None, above=0.0, at_most=1.0)
    final_learning_rate: FromPreset[float] = number(None, at_least=0.0, at_most=1.0)
    patience: FromPreset[int] = number(None, at_least=0, at_most=1_000_000)
    evaluations: FromPreset[int] = number(None, at_least=1, at_most=1_000_000)
    validation_poses: int = number(1024, at_least=1, at_most=10_000_000)
    held_out_poses: FromPreset[int] = number(None, at_least=1, at_most=10_000_000)

    def __post_init__(self) -> None:
        check_choice("trainer.preset", self.preset, ("auto", *MAPPER_PRESETS))
        check_choice("trainer.name", self.name, ("pose_mapper",))
        check_ranges(self, "trainer.")

    def resolve(self, backend: str = "cpu", devices: int = 1, *, env: EnvConfig | None = None) -> Self:
        """See `TrainerConfig.resolve`."""
        del backend, devices
        if env is not None and env.kind == "sampled_arms":
            raise ValueError(
                f"trainer: expected ppo where the learner is drawn for each episode, env={env.name}, got pose_mapper, "
                "which has one learner; imitate_pose takes any arm as data, without a training"
            )
        name = "large" if self.preset == "auto" else self.preset
        config = _filled_in(self, MAPPER_PRESETS[name], preset=name)
        check_choice("trainer.inputs", str(config.inputs), MAPPER_INPUTS)
        check_choice("trainer.outputs", str(config.outputs), MAPPER_OUTPUTS)
        check_choice("trainer.activation", str(config.activation), ACTIVATIONS)
        if config.samples % config.batch_size:
            raise ValueError(
                f"trainer.batch_size: expected a divisor of samples = {config.samples}, got {config.batch_size}"
            )
        return config

    @property
    def total_steps(self) -> int:
        """Training poses, counted in every epoch."""
        return self.samples * self.epochs


_Config = TypeVar("_Config", bound=TrainerConfig)
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


def _filled_in(config: _Config, values: dict[str, Any], **changes: Any) -> _Config:
    """The config with these values of a preset where its fields are None, and some changes."""
    unset = [field.name for field in dataclasses.fields(config) if getattr(config, field.name) is None]
    return dataclasses.replace(config, **{name: values.get(name) for name in unset}, **changes)


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
      logger: "local" for the run directory alone, or "wandb": Weights & Biases gets the metrics too.
      compilation_cache: folder where JAX keeps compiled functions between runs; none where empty.
      distributed: see `DistributedConfig`.
    """

    env: EnvConfig = dataclasses.field(default_factory=EnvConfig)
    trainer: TrainerConfig = dataclasses.field(default_factory=TrainerConfig)
    seed: int = seed_number()
    run_dir: str = ""
    resume: str = ""
    init: str = ""
    logger: str = "local"
    compilation_cache: str = "~/.cache/mimic/jax"
    distributed: DistributedConfig = dataclasses.field(default_factory=DistributedConfig)

    def __post_init__(self) -> None:
        check_ranges(self)
        check_choice("logger", self.logger, LOGGERS)

    def resolve(self, backend: str = "cpu", devices: int = 1) -> Self:
        """The config with a resolved trainer, see `TrainerConfig.resolve`."""
        return dataclasses.replace(self, trainer=self.trainer.resolve(backend, devices, env=self.env))

    def check_used(self) -> None:
        """Raises a ValueError for a field of the environment that its user changed and the trainer does not use."""
        env = self.env
        if self.trainer.name != "pose_mapper" or env.world is not None:  # the preset of a world sets many fields
            return
        preset = env_config(env.name) if env.name in environments() else EnvConfig()
        for field in _NOT_OF_MAPPERS:
            if getattr(env, field) != getattr(preset, field):
                raise ValueError(
                    f"env.{field}: expected no change with trainer=pose_mapper, which simulates nothing, "
                    f"got {getattr(env, field)!r:.80}"
                )
