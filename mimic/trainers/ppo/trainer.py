"""`trainer=ppo`: trains a policy that imitates the expert's motions, of one learner or of many."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mimic.base.compilation import Background, compiling, on_host
from mimic.envs.config import EnvConfig
from mimic.envs.family import SEEN, UNSEEN, report_arms
from mimic.envs.imitation import ImitationEnv, training_and_held_out
from mimic.envs.make import make_env
from mimic.evaluation.evaluator import Controller, Evaluator, Rollouts
from mimic.evaluation.nearest_pose_controller import ControllerWithMemory, nearest_pose_controller
from mimic.motions.demonstrations import Demonstrations, check_effort, concatenate, crossovers
from mimic.motions.experts import MIXED
from mimic.runs.checkpoints import Checkpoint
from mimic.runs.files import DEMONSTRATIONS
from mimic.runs.parameters import has_network
from mimic.runs.signals import Signals
from mimic.trainers.config import PPOConfig, TrainConfig
from mimic.trainers.ppo import ppo, report_rows
from mimic.trainers.trainer import Metrics, OnEvaluation, Params, Row, Trainer

EVALUATED_DEMONSTRATIONS = 8  # of the held-out ones, by each of many arms: with 29 arms, 232 rollouts and bounds


class PPOTrainer(Trainer):
    """Trains a policy on the training demonstrations, and evaluates it on these and on held-out ones.

    A policy of many arms is evaluated on those of `report_arms`, on held-out demonstrations.

    Args:
      config: the run's config.
      run_dir: directory of an existing run, whose demonstrations are used.
      unseen: demonstrations to evaluate on instead of the held-out ones.
      shared: trainer of many arms, whose policy is evaluated on the one of the config; it cannot be trained there.

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
        shared: "PPOTrainer | None" = None,
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
        mixed = with_crossovers(env, self.settings, config.env.demonstrations.seed)
        self._env = env if mixed is env.demonstrations else env.with_demonstrations(mixed)
        self._demonstrations = concatenate(env.demonstrations, held_out)
        self.env_config = dataclasses.replace(config.env, physics=env.physics.name)
        self.headline = (
            f"{config.env.name}: {env.demonstrations.count} demonstrations, {self.settings.num_envs} arms in parallel"
        )
        self.simulation = f"physics: {env.physics.name} ({env.physics.reason})"
        if self._is_cross_checked:
            self.simulation += "; the report evaluates the policy on MJX too"
        if self._has_many_arms:
            self._evaluate_many_arms(config, held_out.select(slice(0, EVALUATED_DEMONSTRATIONS)))
        else:
            self.evaluator = Evaluator(env, held_out)
        self._last: tuple[Params, Rollouts | None] = None, None  # parameters and their rollouts
        self._rollouts = Background(self._compile)
        self._rollouts_on_mjx = Background(self._compile_on_mjx)

    def _evaluate_many_arms(self, config: TrainConfig, evaluated: Demonstrations) -> None:
        """Makes the evaluator of many arms."""
        arms = report_arms(config.env)
        self._controller_rollouts = Background(self._run_controller)
        self.evaluator = Evaluator(self._env, evaluated, arms, lambda: self._controller_rollouts())
        self.columns = "seen arms", "unseen arms"
        self.simulation += (
            f"\nreport: {len(arms[SEEN])} arms seen in training and {len(arms[UNSEEN])} others, on {evaluated.count} "
            "held-out demonstrations"
        )

    @property
    def _has_many_arms(self) -> bool:
        return self.env_config.kind == "sampled_arms"

    def save_inputs(self, run_dir: Path) -> None:
        """Writes the demonstrations."""
        self._demonstrations.save(run_dir / DEMONSTRATIONS)

    def params_template(self) -> Params:
        """Observation statistics and the parameters of policy and value network."""
        if self._shared is not None:
            return self._shared.params_template()
        env = self._env
        return ppo.params_template(self.settings, env.observation_size, env.action_size, env.privileged_size)

    def controller(self, params: Params) -> Controller | ControllerWithMemory:
        """The deterministic policy of these parameters."""
        if self._shared is not None:
            return nearest_pose_controller(self.evaluator.env, self._shared._policy(params))
        return ppo.make_controller(self.settings, self._env.observation_size, self._env.action_size)(params)

    def policy(self, params: Params) -> Callable[[Any], Any]:
        """The deterministic policy: observation -> action in [-1, 1]."""
        return jax.jit(self._policy(params))

    def _policy(self, params: Params) -> Callable[[Any], Any]:
        controller = self.controller(params)
        return lambda observation: controller(SimpleNamespace(obs=observation))  # type: ignore[arg-type]

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
        """Starts to compile the evaluation, and to compute the bound, in this order."""
        self._rollouts.start()
        if self._has_many_arms:
            self._controller_rollouts.start()
        self.evaluator.prepare()

    def train(
        self, run_dir: Path, on_evaluation: OnEvaluation, signals: Signals, restored: Checkpoint | None
    ) -> tuple[int, Params]:
        """See `ppo.train`."""

        def evaluated(step: int, params: Params, metrics: Mapping[str, float]) -> None:
            on_evaluation(step, params, metrics)
            self.evaluator.prepare_baselines()  # not earlier: it would delay the functions of the training
            if self._is_cross_checked:
                self._rollouts_on_mjx.start()

        return self._loop(
            self._env,
            self.settings,
            run_dir,
            seed=self._seed,
            on_evaluation=evaluated,
            signals=signals,
            restored=restored,
            on_compiling=self.prepare_evaluation,
        )

    @property
    def _loop(self) -> Callable[..., tuple[int, Params]]:
        if self.settings.loop == "mimic":
            return ppo.train
        from mimic.trainers.ppo import brax_loop  # takes half a second

        return brax_loop.train

    def follow(self, restored: Checkpoint | None) -> None:
        """See `ppo.train`."""
        ppo.follow(self._env, self.settings, seed=self._seed, restored=restored)

    def evaluate(self, params: Params) -> Rollouts:
        """Runs the deterministic policy once on each demonstration, of many arms with each of them."""
        last, rollouts = self._last
        if rollouts is None or last is not params:  # a checkpoint is evaluated, then compared
            # Parameters come from the host: each sharding over devices would need a compiled function of its own.
            rollouts = jax.device_get(self._rollouts()(jax.device_get(params)))
            self._last = params, rollouts
        return rollouts

    def _run_controller(self) -> Rollouts:
        """The rollouts of the zero action: that of networks whose parameters are 0."""
        statistics, *networks = self._params_shapes()
        idle = jax.tree.map(lambda x: jnp.ones(x.shape, x.dtype), statistics)
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), networks)
        return jax.device_get(self._rollouts()((idle, *zeros)))

    @property
    def _is_cross_checked(self) -> bool:
        return self.env_config.physics != "mjx" and not self._has_many_arms

    def cross_check(self, params: Params) -> Metrics:
        """Gap and distance of the policy on MJX, an engine that is not ours; nothing where the training was on it."""
        if not self._is_cross_checked:
            return {}
        evaluator, rollouts = self._rollouts_on_mjx()
        with on_host():
            summary = evaluator.summary(rollouts(jax.device_get(params)))
        return {"mjx": {key: summary[key] for key in ("optimality_gap", "mean_distance")}}

    def run_controller(self, name: str, params: Params) -> tuple[Rollouts, dict[str, Any]]:
        """See `mimic.evaluation.tracking_controllers.run_controller`; of many arms "policy" or "nearest_pose"."""
        if name == "policy":
            return self.evaluate(params), {}
        if self._has_many_arms:
            assert name == "nearest_pose", name
            return self._controller_rollouts(), {"trainer": name}
        from mimic.evaluation.tracking_controllers import run_controller

        outcome, setting = run_controller(self.evaluator, name)
        return outcome, {"trainer": name, **setting}

    def metrics(self, outcome: Rollouts) -> Metrics:
        """See `Evaluator.summary`."""
        return self.evaluator.summary(outcome)

    def status(self, metrics: Metrics) -> str:
        """See `report_rows.status`."""
        return report_rows.status(metrics)

    def details(self, outcome: Rollouts, controller: str = "policy") -> Metrics:
        """Physics, similarity of the motions and the baselines, and the worst motions, or a row of each arm."""
        details = {
            "physics": self.env_config.physics,
            "similarity": self.evaluator.similarity_summary(outcome, controller),
        }
        if not self._has_many_arms:
            energy_distance = self.evaluator.energy_distance(outcome)
            return {
                **details,
                "energy_distance": energy_distance,
                "worst_demonstrations": self.evaluator.worst(outcome),
            }
        count = self.evaluator.env.demonstrations.count
        return {**details, "evaluated_demonstrations": count, "arms": self.evaluator.details(outcome)}

    def rows(self, metrics: Metrics) -> list[Row]:
        """See `report_rows`."""
        return report_rows.rows(metrics)

    def save_outcome(self, folder: Path, outcome: Rollouts, controller: str = "policy") -> None:
        """Writes tables and plots of the evaluation; in a run directory also a plot of the training."""
        from mimic.evaluation import plots  # imports matplotlib, which takes a second

        labels = plots.labels_of("demonstrations")
        if self._has_many_arms:
            self.evaluator.save_arms(outcome, folder / "arms.csv")
            labels = {"train": "arms seen in training", "held_out": "unseen arms"}
        else:
            self.evaluator.save_table(outcome, folder / "demonstrations.csv")
            self.evaluator.save_curves(outcome, folder / "quality.csv")
            names = {"controller": controller.replace("_", " "), "title": self._name}
            plots.plot_quality(self.evaluator, outcome, folder / "quality.png", **names)
            plots.plot_demonstrations(self.evaluator, outcome, folder / "demonstrations.png", **names)
            similarity = self.evaluator.similarity_summary(outcome, controller)
            plots.plot_similarity(similarity, folder / "similarity.png", title=self._name)
        plots.plot_training(folder, "optimality_gap", "optimality gap [%]", labels=labels, title=self._name)


def run_environment(config: EnvConfig, run_dir: Path | None) -> tuple[ImitationEnv, Demonstrations]:
    """The environment with its training demonstrations, and the held-out ones; an existing run has its own."""
    config = with_saved_demonstrations(config, run_dir)
    env = make_env(config)
    return env, env.held_out or training_and_held_out(config)[1]  # none where a registered class has motions of its own


def with_saved_demonstrations(config: EnvConfig, run_dir: Path | None) -> EnvConfig:
    """The environment with the demonstrations of an existing run; a network of the package has them recorded again."""
    if run_dir is None or has_network(run_dir):
        return config
    saved = dataclasses.replace(config.demonstrations, path=str(run_dir / DEMONSTRATIONS), source="", kind=MIXED)
    return dataclasses.replace(config, demonstrations=saved)


def with_crossovers(env: ImitationEnv, settings: PPOConfig, seed: int) -> Demonstrations:
    """An environment's demonstrations with the additional ones of the settings, see `crossovers`."""
    recorded = env.demonstrations
    if settings.crossovers == 0 or recorded.count == 1:  # a single demonstration cannot be mixed
        return recorded
    start_alike = np.allclose(recorded.qpos[:, 0], recorded.qpos[0, 0])
    displaced = settings.displaced_crossovers if start_alike else 0.0
    mixed = crossovers(recorded, settings.crossovers, seed, displaced, np.asarray(env.expert.joint_range))
    return concatenate(recorded, mixed)
