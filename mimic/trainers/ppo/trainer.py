"""`trainer=ppo`: trains a policy that imitates the expert's motions by joint torques."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax

from mimic.base.compilation import Background, compiling, on_host
from mimic.envs.config import EnvConfig
from mimic.envs.imitation import ImitationEnv, training_and_held_out
from mimic.envs.make import make_env
from mimic.evaluation.evaluator import Controller, Evaluator, Rollouts
from mimic.evaluation.labels import ALL_KINDS, SPLITS
from mimic.evaluation.nearest_pose_controller import ControllerWithMemory
from mimic.evaluation.rollout_metrics import MIN_SPAN
from mimic.motions.demonstrations import Demonstrations, check_effort, concatenate, crossovers
from mimic.runs.checkpoints import Checkpoint
from mimic.runs.files import DEMONSTRATIONS
from mimic.runs.signals import Signals
from mimic.trainers.config import PPOConfig, TrainConfig
from mimic.trainers.ppo import ppo
from mimic.trainers.trainer import Metrics, OnEvaluation, Params, Row, Trainer


class PolicyOfManyArms(NamedTuple):
    """A policy that was trained on many arms, to evaluate on one.

    Attributes:
      params_template: makes the parameters, or their shapes, with the structure of a checkpoint.
      controller: from the environment of the arm and parameters to the controller of that arm.
    """

    params_template: Callable[[], Params]
    controller: Callable[[ImitationEnv, Params], ControllerWithMemory]


class PPOTrainer(Trainer):
    """Trains a policy on the training demonstrations, and evaluates it on these and on held-out ones.

    Args:
      config: the run's config.
      run_dir: directory of an existing run, whose demonstrations are used.
      unseen: demonstrations to evaluate on instead of the held-out ones.
      shared: the policy, where it was trained on many arms; it can be evaluated, and not trained.

    Attributes:
      evaluator: evaluates controllers on the run's demonstrations.

    Raises:
      ValueError: settings, arms or demonstrations that do not fit each other.
    """

    unit = "env_steps"

    def __init__(
        self,
        config: TrainConfig,
        run_dir: Path | None,
        unseen: Demonstrations | None = None,
        shared: PolicyOfManyArms | None = None,
    ):
        assert isinstance(config.trainer, PPOConfig)
        self._name, self._seed, self._shared = config.env.name, config.seed, shared
        self.settings: PPOConfig = config.trainer
        self.total_steps = self.settings.total_steps
        env, held_out = run_environment(config.env, run_dir)
        if unseen is not None:
            unseen.check_fits(env.expert, config.env.control_dt, unseen.horizon)
            check_effort(unseen, env.expert)
            env, held_out = env.with_horizon(unseen.horizon), unseen
        self.evaluator = Evaluator(env, held_out)
        mixed = with_crossovers(env.demonstrations, self.settings.crossovers, config.env.demonstrations.seed)
        self._env = env if mixed is env.demonstrations else env.with_demonstrations(mixed)
        self._demonstrations = concatenate(env.demonstrations, held_out)
        self.env_config = dataclasses.replace(config.env, physics=env.physics.name)
        self.headline = (
            f"{config.env.name}: {env.demonstrations.count} demonstrations, {self.settings.num_envs} arms in parallel"
        )
        self.simulation = f"physics: {env.physics.name} ({env.physics.reason})"
        if self._is_cross_checked:
            self.simulation += "; the report evaluates the policy on MJX too"
        self._rollouts = Background(self._compile)
        self._rollouts_on_mjx = Background(self._compile_on_mjx)

    def save_inputs(self, run_dir: Path) -> None:
        """Writes the demonstrations."""
        self._demonstrations.save(run_dir / DEMONSTRATIONS)

    def params_template(self) -> Params:
        """Observation statistics and the parameters of policy and value network."""
        if self._shared is not None:
            return self._shared.params_template()
        return ppo.params_template(self.settings, self._env.observation_size, self._env.action_size)

    def controller(self, params: Params) -> Controller | ControllerWithMemory:
        """The deterministic policy of these parameters."""
        if self._shared is not None:
            return self._shared.controller(self.evaluator.env, params)
        return ppo.make_controller(self.settings, self._env.observation_size, self._env.action_size)(params)

    def policy(self, params: Params) -> Callable[[Any], Any]:
        """The deterministic policy: observation -> action in [-1, 1]."""
        controller = self.controller(params)
        return jax.jit(lambda observation: controller(SimpleNamespace(obs=observation)))  # type: ignore[arg-type]

    def _compile(self) -> Callable[[Params], Rollouts]:
        def rollouts(params: Params) -> Rollouts:
            return self.evaluator.rollout(self.controller(params))

        return compiling(rollouts, self._params_shapes())()

    def _compile_on_mjx(self) -> tuple[Evaluator, Callable[[Params], Rollouts]]:
        """The evaluator on MJX and its rollouts, on the CPU, where MJX compiles several times faster."""

        def rollouts_on_mjx(params: Params) -> Rollouts:
            return evaluator.rollout(self.controller(params))

        with on_host():
            evaluator = self.evaluator.on_mjx()
            compiled = jax.jit(rollouts_on_mjx).lower(self._params_shapes()).compile()
        return evaluator, compiled

    def _params_shapes(self) -> Params:
        template = jax.eval_shape(self.params_template)
        return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), template)

    def prepare_evaluation(self) -> None:
        """Starts to compile the evaluation, and to compute the bound and the baselines."""
        self._rollouts.start()
        self.evaluator.prepare()

    def train(
        self, run_dir: Path, on_evaluation: OnEvaluation, signals: Signals, restored: Checkpoint | None
    ) -> tuple[int, Params]:
        """See `ppo.train`."""

        def evaluated(step: int, params: Params, metrics: Mapping[str, float]) -> bool:
            stop = on_evaluation(step, params, metrics)
            if self._is_cross_checked:
                self._rollouts_on_mjx.start()  # not earlier: it would delay the functions of the training
            return stop

        return ppo.train(
            self._env,
            self.settings,
            run_dir,
            seed=self._seed,
            on_evaluation=evaluated,
            signals=signals,
            restored=restored,
            on_compiling=self.prepare_evaluation,
        )

    def follow(self, restored: Checkpoint | None) -> None:
        """See `ppo.train`."""
        ppo.follow(self._env, self.settings, seed=self._seed, restored=restored)

    def evaluate(self, params: Params) -> Rollouts:
        """Runs the deterministic policy once on each demonstration."""
        # Parameters come from the host: each sharding over devices would need a compiled function of its own.
        return self._rollouts()(jax.device_get(params))

    @property
    def _is_cross_checked(self) -> bool:
        return self.env_config.physics != "mjx"

    def cross_check(self, params: Params) -> Metrics:
        """Gap and distance of the policy on MJX, an engine that is not ours; nothing where the training was on it."""
        if not self._is_cross_checked:
            return {}
        evaluator, rollouts = self._rollouts_on_mjx()
        with on_host():
            summary = evaluator.summary(rollouts(jax.device_get(params)))
        return {"mjx": {key: summary[key] for key in ("optimality_gap", "mean_distance")}}

    def run_controller(self, name: str, params: Params) -> tuple[Rollouts, dict[str, Any]]:
        """See `mimic.evaluation.tracking_controllers.run_controller`."""
        if name == "policy":
            return self.evaluate(params), {}
        from mimic.evaluation.tracking_controllers import run_controller

        outcome, setting = run_controller(self.evaluator, name)
        return outcome, {"trainer": name, **setting}

    def metrics(self, outcome: Rollouts) -> Metrics:
        """See `Evaluator.summary`."""
        return self.evaluator.summary(outcome)

    def status(self, metrics: Metrics) -> str:
        """Distance and optimality gap."""
        gap, distance = metrics["optimality_gap"], metrics["mean_distance"]["train"]
        percent = {split: _text("{:.1%}", value) for split, value in gap.items()}
        return f"distance {distance:.4f}  gap {percent['train']}, held out {percent['held_out']}"

    def good_enough(self, metrics: Metrics) -> bool:
        """Whether the target gap is reached on the training demonstrations."""
        return metrics["optimality_gap"]["train"] <= self.settings.target_gap

    def details(self, outcome: Rollouts, controller: str = "policy") -> Metrics:
        """Physics, similarity of the motions compared with the baselines, demonstrations with the largest gaps."""
        return {
            "physics": self.env_config.physics,
            "similarity": self.evaluator.similarity_summary(outcome, controller),
            "worst_demonstrations": self.evaluator.worst(outcome),
        }

    def rows(self, metrics: Metrics) -> list[Row]:
        """Rows of the gap, the distances that define it, and the other metrics."""
        by_split = (
            ("optimality gap", "optimality_gap", "{:.2%}"),
            ("mean distance", "mean_distance", "{:.4f}"),
            ("  kinematic bound (gap 0)", "lower_bound", "{:.4f}"),
            ("  holding start pose (1)", "hold_distance", "{:.4f}"),
            ("angle to expert links", "link_angle_error_deg", "{:.1f} deg"),
            ("angular velocity error", "angular_velocity_error", "{:.2f} rad/s"),
            ("torque / maximum, rms", "torque_rms", "{:.1%}"),
            ("  change in a step, rms", "torque_change", "{:.1%}"),
            ("  steps at the maximum", "torque_saturation", "{:.1%}"),
            ("steps out of range", "position_violations", "{:.0f}"),
            ("  above velocity limit", "speed_violations", "{:.0f}"),
            ("  above torque limit", "torque_violations", "{:.0f}"),
        )
        rows: list[Row] = [
            (label, _text(form, metrics[key]["train"]), _text(form, metrics[key]["held_out"]))
            for label, key, form in by_split
        ]
        rows[1:1] = _rows_of_kinds(metrics["by_kind"])
        rows += [
            (
                f"reward term {key.removeprefix('reward.')}",
                _text("{:.4f}", value["train"]),
                _text("{:.4f}", value["held_out"]),
            )
            for key, value in metrics.items()
            if key.startswith("reward.")
        ]
        if "mjx" in metrics:
            on_mjx = {split: _text("{:.2%}", gap) for split, gap in metrics["mjx"]["optimality_gap"].items()}
            rows.insert(1, ("  evaluated on MJX", on_mjx["train"], on_mjx["held_out"]))
        if not all(math.isfinite(gap) for gap in metrics["optimality_gap"].values()):
            rows.insert(1, ("  none: the best motion saves less than", f"{MIN_SPAN:.0%} of holding", "the start pose"))
        train, held_out = (
            "  ".join(f"{i}: {gap:.0%}" for i, gap in metrics["worst_demonstrations"][split].items())
            for split in SPLITS
        )
        return [*rows, ("worst (number: gap)", train, held_out)]

    def save_outcome(self, folder: Path, outcome: Rollouts, controller: str = "policy") -> None:
        """Writes tables and plots of the evaluation; in a run directory also a plot of the training."""
        from mimic.evaluation import plots  # imports matplotlib, which takes a second

        self.evaluator.save_table(outcome, folder / "demonstrations.csv")
        self.evaluator.save_curves(outcome, folder / "quality.csv")
        names = {"controller": controller.replace("_", " "), "title": self._name}
        plots.plot_quality(self.evaluator, outcome, folder / "quality.png", **names)
        plots.plot_demonstrations(self.evaluator, outcome, folder / "demonstrations.png", **names)
        plots.plot_similarity(
            self.evaluator.similarity_summary(outcome, controller), folder / "similarity.png", title=self._name
        )
        labels = plots.labels_of("demonstrations")
        plots.plot_training(folder, "optimality_gap", "optimality gap [%]", labels=labels, title=self._name)


def _rows_of_kinds(by_kind: Mapping[str, Mapping[str, Mapping[str, float]]]) -> list[Row]:
    """Rows of the gap of each kind of demonstrations, and of the interval of all."""

    def cells(kind: str, text: Callable[[Mapping[str, float]], str]) -> Row:
        train, held_out = (text(of[split]) if split in (of := by_kind[kind]) else "" for split in SPLITS)
        return f"  {kind.replace('_', ' ')}", train, held_out

    def interval(numbers: Mapping[str, float]) -> str:
        return f"{100 * numbers['low']:.2f} to {100 * numbers['high']:.2f}%" if numbers["low"] == numbers["low"] else ""

    intervals = cells(ALL_KINDS, interval)[1:]
    if not any(intervals):
        return []  # there is no gap
    rows: list[Row] = [("  95 % interval", *intervals)]
    if len(kinds := [kind for kind in by_kind if kind != ALL_KINDS]) > 1:
        rows += [cells(kind, lambda numbers: _text("{:.2%}", numbers["optimality_gap"])) for kind in kinds]
    return rows


def _text(form: str, value: float) -> str:
    return form.format(value) if math.isfinite(value) else "none"


def run_environment(config: EnvConfig, run_dir: Path | None) -> tuple[ImitationEnv, Demonstrations]:
    """The environment with its training demonstrations, and the held-out ones; an existing run has its own."""
    config = with_saved_demonstrations(config, run_dir)
    env = make_env(config)
    return env, env.held_out or training_and_held_out(config)[1]  # none where a registered class has motions of its own


def with_saved_demonstrations(config: EnvConfig, run_dir: Path | None) -> EnvConfig:
    """The environment with the demonstrations of an existing run, if there is one."""
    if run_dir is None:
        return config
    saved = dataclasses.replace(config.demonstrations, path=str(run_dir / DEMONSTRATIONS))
    return dataclasses.replace(config, demonstrations=saved)


def with_crossovers(recorded: Demonstrations, count: int, seed: int) -> Demonstrations:
    """Training demonstrations with additional ones, see `crossovers`."""
    if count == 0 or recorded.count == 1:  # a single demonstration cannot be mixed
        return recorded
    return concatenate(recorded, crossovers(recorded, count, seed))
