"""What defines a training run. `python -m mimic.train` fills these in from mimic/conf and the command line."""

import dataclasses
import math
from typing import Any, ClassVar

from omegaconf import MISSING

from mimic.config import check_choice
from mimic.envs.config import EnvConfig
from mimic.trainers.distributed.process_group import DistributedConfig

LOGGERS = ("local", "wandb", "mlflow")

PRESETS: dict[str, dict[str, Any]] = {
    # Two cores: few environments, many gradient steps on each sample, since the physics is what costs.
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
        "hidden_layers": [128, 128],
        "crossovers": 0,
        "evaluations": 10,
    },
    # One GPU: as many environments as keep it busy. The high entropy makes the arm try other branches of poses.
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
        "hidden_layers": [512, 256],
        "crossovers": 800,
        "evaluations": 8,
    },
}
_LOOKS = 5  # with a target gap, which is to be noticed soon: an evaluation costs less than the steps between two


@dataclasses.dataclass(frozen=True)
class TrainerConfig:
    """What all trainers have.

    Attributes:
      name: of the trainer.
      preset: where fields that are None take their values from.
    """

    length_key: ClassVar[str]  # the field that says how long to train

    name: str = MISSING
    preset: str = MISSING

    @property
    def total_steps(self) -> int:
        """How long resolved settings train."""
        raise NotImplementedError


@dataclasses.dataclass(frozen=True)
class PPOConfig(TrainerConfig):
    """PPO, on brax's networks. A field that is None takes its value from the preset.

    Attributes:
      name: "ppo".
      preset: "cpu", "gpu", or "auto": by the backend that JAX found.
      num_timesteps: environment steps to train for; rounded up to whole stretches between two evaluations.
      num_envs: arms at once.
      unroll_length: steps of an arm in a batch.
      batch_size: unrolls in a minibatch.
      num_minibatches: minibatches in a batch; batch_size * num_minibatches must be a multiple of num_envs.
      num_updates_per_batch: passes over a batch.
      learning_rate: of Adam at the start.
      final_learning_rate: as a share of it at the end; the decay is linear.
      discounting: of the reward.
      gae_lambda: of the advantage estimate.
      entropy_cost: reward for a wide action distribution.
      clipping_epsilon: of the policy ratio.
      max_grad_norm: gradients are clipped to it: see `updated` in mimic/trainers/ppo/updates.py.
      reward_scaling: of the reward inside PPO.
      hidden_layers: widths of policy and value network.
      crossovers: demonstrations to train on beyond the given ones, mixed from them joint by joint: see `crossovers` in
        mimic/envs/demonstrations.py.
      target_gap: training ends early once the optimality gap on the training demonstrations is no larger; 0 never.
      evaluations: how often the policy is evaluated and saved, as far as whole batches allow; with a target gap the
        preset's number times five.
    """

    length_key: ClassVar[str] = "num_timesteps"

    name: str = "ppo"
    preset: str = "auto"
    num_timesteps: int | None = None
    num_envs: int | None = None
    unroll_length: int | None = None
    batch_size: int | None = None
    num_minibatches: int | None = None
    num_updates_per_batch: int | None = None
    learning_rate: float | None = None
    final_learning_rate: float | None = None
    discounting: float | None = None
    gae_lambda: float = 0.9
    entropy_cost: float | None = None
    clipping_epsilon: float = 0.2
    max_grad_norm: float = 1.0
    reward_scaling: float = 10.0
    hidden_layers: list[int] | None = None
    crossovers: int | None = None
    target_gap: float = 0.0
    evaluations: int | None = None

    def __post_init__(self) -> None:
        check_choice("trainer.preset", self.preset, ("auto", *PRESETS))
        check_choice("trainer.name", self.name, ("ppo",))

    def resolve(self, backend: str = "cpu", devices: int = 1) -> "PPOSettings":
        """The same with every field filled in, and the preset's name.

        Args:
          backend: of JAX; chooses the preset where that is "auto".
          devices: that environments and batches are spread over.

        Raises:
          ValueError: numbers out of range, or batch sizes that PPO cannot divide.
        """
        name = self.preset if self.preset != "auto" else "cpu" if backend == "cpu" else "gpu"
        preset = PRESETS[name]
        if self.target_gap > 0:
            preset = {**preset, "evaluations": _LOOKS * preset["evaluations"]}
        settings = PPOSettings(**{**_filled_in(self, preset), "preset": name})
        settings.check(devices)
        return settings


@dataclasses.dataclass(frozen=True)
class PPOSettings(PPOConfig):
    """A PPO config with every field filled in: what trains, and what a run directory keeps."""

    num_timesteps: int = MISSING
    num_envs: int = MISSING
    unroll_length: int = MISSING
    batch_size: int = MISSING
    num_minibatches: int = MISSING
    num_updates_per_batch: int = MISSING
    learning_rate: float = MISSING
    final_learning_rate: float = MISSING
    discounting: float = MISSING
    entropy_cost: float = MISSING
    hidden_layers: list[int] = MISSING
    crossovers: int = MISSING
    evaluations: int = MISSING

    def check(self, devices: int) -> None:
        """Raises a ValueError for numbers out of range, or batch sizes that the devices cannot divide."""
        whole = ("num_timesteps", "num_envs", "unroll_length", "batch_size", "num_minibatches", "num_updates_per_batch")
        _check_whole(self, *whole, "evaluations")
        for key in ("learning_rate", "max_grad_norm", "reward_scaling", "clipping_epsilon"):
            if not 0 < getattr(self, key) < math.inf:
                raise ValueError(f"trainer.{key}: expected a number above 0, got {getattr(self, key)}")
        for key in ("discounting", "gae_lambda", "final_learning_rate"):
            if not 0 <= getattr(self, key) <= 1:
                raise ValueError(f"trainer.{key}: expected a number in [0, 1], got {getattr(self, key)}")
        for key in ("target_gap", "crossovers"):
            if not getattr(self, key) >= 0:
                raise ValueError(f"trainer.{key}: expected at least 0, got {getattr(self, key)}")
        _check_layers(self.hidden_layers)
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
        """Environment steps."""
        return self.num_timesteps

    @property
    def steps_per_batch(self) -> int:
        """Environment steps between two updates of the policy that collects them."""
        return self.batch_size * self.num_minibatches * self.unroll_length


MAPPER_PRESETS: dict[str, dict[str, Any]] = {
    # Of the paper: network, training set and minibatches. What it leaves open: Adam, rate, epochs, patience.
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
        "patience": 10,
        "evaluations": 100,
    },
    # By measurement, on a GPU and on two cores alike.
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
        "patience": 0,
        "evaluations": 10,
    },
}
MAPPER_INPUTS, MAPPER_OUTPUTS, ACTIVATIONS = ("angles", "link_states"), ("tanh", "circle"), ("leaky_relu", "gelu")


@dataclasses.dataclass(frozen=True)
class PoseMapperConfig(TrainerConfig):
    """The neural pose mapper. A field that is None takes its value from the preset.

    Attributes:
      name: "pose_mapper".
      preset: "large", or "paper".
      inputs: "angles" (paper) or "link_states" of the expert: positions and directions.
      outputs: "tanh" of an angle within the joint's range (paper), or a point on the "circle" for joints that can do a
        full turn.
      heads: poses that the network proposes; the nearest is taken.
      hidden_layers: widths.
      activation: "leaky_relu" (paper) or "gelu".
      samples: poses in an epoch.
      batch_size: poses in a minibatch; divides samples.
      fresh: whether each epoch has new random poses; else it has the same ones, shuffled.
      epochs: how long to train.
      learning_rate: of Adam, after a warm-up.
      final_learning_rate: as a share of it at the end; the decay is a cosine. 1 is a constant rate without warm-up.
      dropout: fraction of the hidden units of each layer that is dropped for a training pose, in [0, 1). The paper
        names it against overfitting and does without; so do the presets.
      weight_decay: of AdamW: each update takes the fraction learning_rate * weight_decay from every weight, and nothing
        from biases. As dropout.
      patience: evaluations without a better distance on the validation poses after which training stops; 0 never.
      target_quality: training ends early once the quality on validation poses is no larger; 0 never.
      evaluations: how often the mapper is evaluated and saved.
      validation_poses: that early stopping looks at.
      held_out_poses: that the report is made on.
    """

    length_key: ClassVar[str] = "epochs"

    name: str = "pose_mapper"
    preset: str = "large"
    inputs: str | None = None
    outputs: str | None = None
    heads: int | None = None
    hidden_layers: list[int] | None = None
    activation: str | None = None
    samples: int | None = None
    batch_size: int | None = None
    fresh: bool | None = None
    epochs: int | None = None
    learning_rate: float | None = None
    final_learning_rate: float | None = None
    dropout: float = 0.0
    weight_decay: float = 0.0
    patience: int | None = None
    target_quality: float = 0.0
    evaluations: int | None = None
    validation_poses: int = 1024
    held_out_poses: int = 10_000

    def __post_init__(self) -> None:
        check_choice("trainer.preset", self.preset, tuple(MAPPER_PRESETS))
        check_choice("trainer.name", self.name, ("pose_mapper",))

    def resolve(self) -> "PoseMapperSettings":
        """The same with every field filled in.

        Raises:
          ValueError: numbers out of range, or a batch size that does not divide the samples.
        """
        settings = PoseMapperSettings(**_filled_in(self, MAPPER_PRESETS[self.preset]))
        settings.check()
        return settings


@dataclasses.dataclass(frozen=True)
class PoseMapperSettings(PoseMapperConfig):
    """A pose mapper's config with every field filled in."""

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
    patience: int = MISSING
    evaluations: int = MISSING

    def check(self) -> None:
        """Raises a ValueError for numbers out of range, or a batch size that does not divide the samples."""
        check_choice("trainer.inputs", str(self.inputs), MAPPER_INPUTS)
        check_choice("trainer.outputs", str(self.outputs), MAPPER_OUTPUTS)
        check_choice("trainer.activation", str(self.activation), ACTIVATIONS)
        _check_whole(
            self, "heads", "samples", "batch_size", "epochs", "evaluations", "validation_poses", "held_out_poses"
        )
        _check_layers(self.hidden_layers)
        if not 0 < self.learning_rate < math.inf:
            raise ValueError(f"trainer.learning_rate: expected a number above 0, got {self.learning_rate}")
        if not 0 <= self.final_learning_rate <= 1:
            raise ValueError(
                f"trainer.final_learning_rate: expected a number in [0, 1], got {self.final_learning_rate}"
            )
        if not 0 <= self.dropout < 1:
            raise ValueError(f"trainer.dropout: expected a fraction in [0, 1), got {self.dropout}")
        if not 0 <= self.weight_decay < math.inf:
            raise ValueError(f"trainer.weight_decay: expected a finite number of at least 0, got {self.weight_decay}")
        if self.patience < 0 or not self.target_quality >= 0:
            raise ValueError(
                f"trainer: expected patience and target_quality of at least 0, got {self.patience}, "
                f"{self.target_quality}"
            )
        if self.samples % self.batch_size:
            raise ValueError(
                f"trainer.batch_size: expected a divisor of samples = {self.samples}, got {self.batch_size}"
            )

    @property
    def total_steps(self) -> int:
        """Poses to train on, each time anew."""
        return self.samples * self.epochs


TRAINERS: dict[str, type[TrainerConfig]] = {"ppo": PPOConfig, "pose_mapper": PoseMapperConfig}


def _filled_in(config: TrainerConfig, preset: dict[str, Any]) -> dict[str, Any]:
    """All fields; those that are None from the preset."""
    fields = {field.name: getattr(config, field.name) for field in dataclasses.fields(config)}
    return {key: preset.get(key) if value is None else value for key, value in fields.items()}


def _check_whole(config: TrainerConfig, *keys: str) -> None:
    for key in keys:
        if getattr(config, key) < 1:
            raise ValueError(f"trainer.{key}: expected at least 1, got {getattr(config, key)}")


def _check_layers(layers: list[int] | None) -> None:
    if not layers or min(layers) < 1:
        raise ValueError(f"trainer.hidden_layers: expected one or more widths above 0, got {layers}")


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """A training run.

    Attributes:
      env: see `EnvConfig`.
      trainer: one of `TRAINERS`.
      seed: of networks, exploration and resets.
      run_dir: where everything is written; runs/ENV-TRAINER-seedSEED-TIME where empty.
      resume: a run directory to go on from.
      logger: "local", "wandb", "mlflow", or a list of these: where metrics go beside the run directory, which has them
        in any case.
      compilation_cache: folder where JAX keeps compiled programs between runs; none where empty.
      distributed: see `DistributedConfig`.
    """

    env: EnvConfig = dataclasses.field(default_factory=EnvConfig)
    trainer: TrainerConfig = dataclasses.field(default_factory=TrainerConfig)
    seed: int = 0
    run_dir: str = ""
    resume: str = ""
    logger: Any = "local"
    compilation_cache: str = "~/.cache/mimic/jax"
    distributed: DistributedConfig = dataclasses.field(default_factory=DistributedConfig)

    def __post_init__(self) -> None:
        for name in self.loggers:
            check_choice("logger", name, LOGGERS)

    @property
    def loggers(self) -> list[str]:
        """The services, as a list."""
        return [self.logger] if isinstance(self.logger, str) else list(map(str, self.logger or ()))
