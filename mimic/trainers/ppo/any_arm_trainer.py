"""`trainer=ppo` where the learner is another arm in each episode: trains one policy for all of them."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import State
from jaxtyping import Array

from mimic.base.compilation import Background, compiling
from mimic.envs.config import EnvConfig
from mimic.envs.family import SEEN, UNSEEN, arms_config, report_arms
from mimic.envs.imitation import ImitationEnv, training_and_held_out
from mimic.envs.make import make_family_env
from mimic.envs.many_arms import AnyArmEnv
from mimic.evaluation.any_arm import EVALUATED_DEMONSTRATIONS, ArmRollouts, ArmsEvaluator, ArmsOutcome
from mimic.evaluation.labels import SPLITS
from mimic.evaluation.nearest_pose_controller import ControllerWithMemory, nearest_pose_controller
from mimic.evaluation.rollout_metrics import MIN_SPAN
from mimic.motions.demonstrations import Demonstrations, check_effort, concatenate
from mimic.runs.checkpoints import Checkpoint
from mimic.runs.files import DEMONSTRATIONS
from mimic.runs.signals import Signals
from mimic.trainers.config import PPOConfig, TrainConfig
from mimic.trainers.ppo import ppo
from mimic.trainers.ppo.trainer import PolicyOfManyArms, with_crossovers, with_saved_demonstrations
from mimic.trainers.trainer import Metrics, OnEvaluation, Params, Row, Trainer

_VALIDATION = 64  # training demonstrations by which a fine-tuning chooses its result: one arm, so they cost little


class AnyArmPPOTrainer(Trainer):
    """Trains a policy of many arms, and evaluates it on those of `report_arms`, on held-out demonstrations.

    The result of a fine-tuning, where the policy of another run is trained further on one arm, is the checkpoint with
    the smallest mean distance on training demonstrations, the start among them, as training can make it worse.

    Args:
      config: the run's config.
      run_dir: directory of an existing run, whose demonstrations are used.
      unseen: demonstrations to evaluate on instead of the held-out ones.

    Attributes:
      evaluator: evaluates controllers on the arms of the report.

    Raises:
      ValueError: settings, arms or demonstrations that do not fit each other.
    """

    unit = "env_steps"
    columns = ("seen arms", "unseen arms")

    def __init__(self, config: TrainConfig, run_dir: Path | None, unseen: Demonstrations | None = None):
        assert isinstance(config.trainer, PPOConfig)
        self._name, self._seed = config.env.name, config.seed
        self.settings: PPOConfig = config.trainer
        self.total_steps = self.settings.total_steps
        training, held_out = training_and_held_out(with_saved_demonstrations(config.env, run_dir))
        self._demonstrations = concatenate(training, held_out)
        mixed = with_crossovers(training, self.settings.crossovers, config.env.demonstrations.seed)
        self._env = make_family_env(config.env, mixed)
        if unseen is not None:
            unseen.check_fits(self._env.expert, config.env.control_dt, config.env.horizon)
            check_effort(unseen, self._env.expert)
            held_out = unseen
        arms = report_arms(config.env)
        evaluated = held_out.select(slice(0, EVALUATED_DEMONSTRATIONS))
        env = AnyArmEnv(_without_baseline(self._env.config), self._env.sampler, evaluated)
        self.evaluator = ArmsEvaluator(env, arms, lambda: self._controller_rollouts())
        self._rollout_env, self._validated = env, 0
        if config.learner and unseen is None:  # in one function with the report's, which takes long to compile
            validation = training.select(slice(0, _VALIDATION))
            self._rollout_env = AnyArmEnv(env.config, env.sampler, concatenate(validation, evaluated))
            self._validated = validation.count
        self.env_config = self._env.config
        self.headline = f"{self._name}: {training.count} demonstrations, {self.settings.num_envs} arms in parallel"
        self.simulation = (
            f"physics: fused ({self._env.physics.reason})\n"
            f"report: {len(arms[SEEN])} arms seen in training and {len(arms[UNSEEN])} others, on {evaluated.count} "
            "held-out demonstrations"
        )
        self._last: tuple[Params, Any] = None, None  # parameters and their rollouts
        self._rollouts = Background(self._compile)
        self._controller_rollouts = Background(self._run_controller)

    def save_inputs(self, run_dir: Path) -> None:
        """Writes the demonstrations."""
        self._demonstrations.save(run_dir / DEMONSTRATIONS)

    def params_template(self) -> Params:
        """Observation statistics and the parameters of policy and value network."""
        return ppo.params_template(self.settings, *self._sizes)

    def policy(self, params: Params) -> Callable[[Any], Any]:
        """The deterministic policy: observation -> action in [-1, 1]."""
        return jax.jit(self._policy(params))

    def shared_policy(self) -> PolicyOfManyArms:
        """The policy, to evaluate it on one arm by `PPOTrainer`."""

        def controller(env: ImitationEnv, params: Params) -> ControllerWithMemory:
            return nearest_pose_controller(env, self._policy(params))

        return PolicyOfManyArms(self.params_template, controller)

    def _policy(self, params: Params) -> Callable[[Array], Array]:
        controller = ppo.make_controller(self.settings, *self._sizes)(params)
        return lambda observation: controller(SimpleNamespace(obs=observation))  # type: ignore[arg-type]

    @property
    def _sizes(self) -> tuple[int, int]:
        return self._env.observation_size, self._env.action_size

    def _compile(self) -> Callable[[Params, Any], ArmRollouts]:
        """The rollouts of a policy, or of the zero action: one function, as it takes most of its time to compile."""

        def rollouts(params: Params, is_policy: Array) -> ArmRollouts:
            policy = ppo.make_controller(self.settings, *self._sizes)(params)

            def controller(state: State) -> Array:
                return jnp.where(is_policy, policy(state), 0.0)

            return self.evaluator.rollout(controller, self._rollout_env)

        return compiling(rollouts, self._params_shapes(), jax.ShapeDtypeStruct((), jnp.bool_))()

    def _params_shapes(self) -> Params:
        template = jax.eval_shape(self.params_template)
        return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), template)

    def _run_controller(self) -> ArmRollouts:
        """The rollouts of the zero action, for which any parameters do."""
        unused = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), self._params_shapes())
        return self._run(unused, is_policy=False)[1]

    def _run(self, params: Params, *, is_policy: bool) -> tuple[ArmRollouts, ArmRollouts]:
        """The rollouts on validation demonstrations, of which there may be none, and on those of the report."""
        last, rollouts = self._last  # of one moment: another thread may run the zero action
        if last is params:  # a checkpoint is evaluated, then compared
            return rollouts
        all_rollouts = jax.device_get(self._rollouts()(jax.device_get(params), jnp.asarray(is_policy)))
        parts = slice(0, self._validated), slice(self._validated, None)
        validation, report = (jax.tree.map(lambda x, part=part: x[:, part], all_rollouts) for part in parts)
        self._last = params, (validation, report)
        return validation, report

    def _validation_distance(self, params: Params) -> float:
        """The mean distance on validation demonstrations."""
        return float(self._run(params, is_policy=True)[0].distance.mean(dtype=float))

    def prepare_evaluation(self) -> None:
        """Starts to compile the evaluation and to compute the bounds, in this order."""
        self._rollouts.start()
        self._controller_rollouts.start()
        self.evaluator.prepare()

    def train(
        self, run_dir: Path, on_evaluation: OnEvaluation, signals: Signals, restored: Checkpoint | None
    ) -> tuple[int, Params]:
        """See `ppo.train`."""
        return ppo.train(
            self._env,  # type: ignore[arg-type] - it has what the loop uses of an ImitationEnv
            self.settings,
            run_dir,
            seed=self._seed,
            on_evaluation=on_evaluation,
            signals=signals,
            restored=restored,
            on_compiling=self.prepare_evaluation,
            score=self._validation_distance if self._validated else None,
        )

    def follow(self, restored: Checkpoint | None) -> None:
        """See `ppo.train`."""
        ppo.follow(self._env, self.settings, seed=self._seed, restored=restored)  # type: ignore[arg-type]

    def evaluate(self, params: Params) -> ArmsOutcome:
        """Runs the deterministic policy and the zero action once on each arm and demonstration."""
        return ArmsOutcome(self._run(params, is_policy=True)[1], self._controller_rollouts())

    def run_controller(self, name: str, params: Params) -> tuple[ArmsOutcome, dict[str, Any]]:
        """The policy, or "nearest_pose": the controller without learning; the others need an environment of one arm."""
        if name == "policy":
            return self.evaluate(params), {}
        assert name == "nearest_pose", name
        return ArmsOutcome(self._controller_rollouts(), self._controller_rollouts()), {"trainer": name}

    def metrics(self, outcome: ArmsOutcome) -> Metrics:
        """See `ArmsEvaluator.summary`."""
        return self.evaluator.summary(outcome)

    def status(self, metrics: Metrics) -> str:
        """Mean gaps on seen and unseen arms, and those of the controller without learning."""
        seen, unseen = _texts("{:.2%}", metrics["optimality_gap"])
        own = "/".join(_texts("{:.2%}", metrics["controller_gap"]))
        return f"gap {seen}, unseen arms {unseen}  without learning {own}"

    def good_enough(self, metrics: Metrics) -> bool:
        """Whether the target gap is reached, as the mean over the arms seen in training."""
        return 0 < self.settings.target_gap >= metrics["optimality_gap"].get("train", math.inf)

    def details(self, outcome: ArmsOutcome, controller: str = "policy") -> Metrics:
        """Physics, similarity of the motions compared with the baselines, and a row for each arm."""
        return {
            "physics": "fused",
            "evaluated_demonstrations": self.evaluator.env.demonstrations.count,
            "similarity": self.evaluator.similarity_summary(outcome, controller),
            "arms": self.evaluator.details(outcome),
        }

    def rows(self, metrics: Metrics) -> list[Row]:
        """Rows of the gaps, the distances that define them, and the number of arms."""
        by_split = (
            ("optimality gap, mean over arms", "optimality_gap", "{:.2%}"),
            ("  median arm", "median_gap", "{:.2%}"),
            ("  worst arm", "largest_gap", "{:.2%}"),
            ("  without learning", "controller_gap", "{:.2%}"),
            ("mean distance", "mean_distance", "{:.4f}"),
            ("  kinematic bound (gap 0)", "lower_bound", "{:.4f}"),
            ("  holding start pose (1)", "hold_distance", "{:.4f}"),
            ("steps above velocity limit", "speed_violations", "{:.2%}"),
        )
        rows: list[Row] = [(label, *_texts(form, metrics[key])) for label, key, form in by_split]
        seen, unseen = ({n: arm for n, arm in metrics["arms"].items() if arm["seen"] == seen} for seen in (True, False))
        rows.insert(3, ("    which is", _worst(seen), _worst(unseen)))
        rows.append(("arms", str(len(seen)), str(len(unseen))))
        without = [sum(math.isnan(arm["gap"]) for arm in arms.values()) for arms in (seen, unseen)]
        if any(without):
            rows.append((f"  without gap (span below {MIN_SPAN:.0%})", str(without[0]), str(without[1])))
        return rows

    def save_outcome(self, folder: Path, outcome: ArmsOutcome, controller: str = "policy") -> None:
        """Writes a table and a plot of the arms; in a run directory also a plot of the training."""
        from mimic.evaluation import plots  # imports matplotlib, which takes a second

        self.evaluator.save_table(outcome, folder / "arms.csv")
        series = {"gap": controller.replace("_", " "), "controller_gap": "controller without learning"}
        arms, label = self.evaluator.details(outcome), "optimality gap [%]"
        plots.plot_arms(arms, series, folder / "arms.png", label=label, title=self._name)
        labels = {"train": "arms seen in training", "held_out": "unseen arms"}
        plots.plot_training(folder, "optimality_gap", label, labels=labels, title=self._name)


def _without_baseline(config: EnvConfig) -> EnvConfig:
    """The config without what only the reward needs."""
    return dataclasses.replace(config, arms=dataclasses.replace(arms_config(config), reward="distance"))


def _worst(arms: Mapping[str, Mapping[str, Any]]) -> str:
    """The name of the arm with the largest gap."""
    gaps = {name: arm["gap"] for name, arm in arms.items() if not math.isnan(arm["gap"])}
    return max(gaps, key=lambda name: gaps[name]) if gaps else "none"


def _texts(form: str, by_split: Mapping[str, float]) -> tuple[str, str]:
    """The values of both splits as texts; "none" for one without arms or without a gap that means something."""
    values = (by_split.get(split, math.nan) for split in SPLITS)
    seen, unseen = (form.format(value) if math.isfinite(value) else "none" for value in values)
    return seen, unseen
