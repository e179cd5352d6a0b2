"""Evaluates controllers: every demonstration once, relative to the kinematic bound and to holding the start pose."""

import copy
import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State
from flax import struct
from jaxtyping import Array, Float

from mimic.arms.pose_limits import pose_limits
from mimic.base.compilation import Background, on_host
from mimic.envs.imitation import ImitationEnv
from mimic.evaluation.labels import ALL_KINDS, SPLITS
from mimic.evaluation.nearest_pose_controller import ControllerWithMemory
from mimic.evaluation.rollout_metrics import (
    WORST,
    Table,
    gap_interval,
    gaps,
    means_by_split,
    measure,
    measure_similarity,
)
from mimic.metric.kinematics import link_state_table
from mimic.metric.similarity import CentreLine, centre_line_table
from mimic.motions.demonstrations import Demonstrations, concatenate, effective_rank
from mimic.retargeting.kinematic_bound import closest_motion
from mimic.retargeting.pose import shared_joints
from mimic.retargeting.pose_baselines import baseline_poses
from mimic.runs.files import write_csv

Controller = Callable[[State], Array]  # (state of the environment) -> action
Motions = Float[np.ndarray, "demonstrations time joints"]
_CHUNK = 256  # demonstrations whose bound is searched at a time
EVALUATED_TRAINING = 80  # demonstrations for training that are evaluated, or as many as those held out


@struct.dataclass
class Rollouts:
    """Rollouts of a controller, one for each demonstration.

    Attributes:
      qpos: [demonstrations, T, joints] learner's joint angles after each step [rad].
      qvel: [demonstrations, T, joints] its joint velocities after each step [rad/s].
      torque: [demonstrations, T, joints] the controller's torques, within their range and without noise [N m].
      distance: [demonstrations, T] embodiment distance after each step.
      command: [demonstrations, T, joints] what the controller commanded: the torque, or with an inner loop the target,
        see `ImitationEnv.command`. None where it was not recorded.
      start: [demonstrations, joints] joint angles before the first step [rad]. None where they were not recorded.
      reward_terms: [demonstrations, T] value of each of the environment's reward terms, unweighted, by name.
    """

    qpos: Float[Array, "demonstrations time joints"]
    qvel: Float[Array, "demonstrations time joints"]
    torque: Float[Array, "demonstrations time joints"]
    distance: Float[Array, "demonstrations time"]
    command: Float[Array, "demonstrations time joints"] | None = None
    start: Float[Array, "demonstrations joints"] | None = None
    reward_terms: dict[str, Float[Array, "demonstrations time"]] = struct.field(default_factory=dict)


class Evaluator:
    """Evaluates controllers on the training and the held-out demonstrations of an environment.

    Args:
      env: the training environment.
      held_out: demonstrations for evaluation only.

    Attributes:
      env: the training environment on the evaluated demonstrations, those for training first.
    """

    def __init__(self, env: ImitationEnv, held_out: Demonstrations):
        training = env.demonstrations.select(slice(0, max(EVALUATED_TRAINING, held_out.count)))
        self._num_train = training.count
        self.env = env.with_demonstrations(concatenate(training, held_out))
        self._references = Background(lambda: _references(self.env))

    def on_mjx(self) -> "Evaluator":
        """An evaluator of rollouts on MJX, with the same bound and the same baselines."""
        evaluator = copy.copy(self)
        evaluator.env = self.env.on_mjx()
        return evaluator

    def prepare(self) -> None:
        """Starts to compute `lower_bound`, `hold_distance` and the baselines in the background."""
        self._references.start()

    @property
    def lower_bound(self) -> Float[np.ndarray, "demonstrations time"]:
        """The kinematic bound at each step.

        It is the best result of an optimisation, and so an upper estimate of the true minimum. Its name is that of the
        report key, which stays for old runs. It is computed at the first access, unless `prepare` was called.
        """
        return self._references().bound

    @property
    def hold_distance(self) -> Float[np.ndarray, "demonstrations time"]:
        """Embodiment distance at each step of a learner that stays at rest in its start pose."""
        return self._references().hold

    @property
    def nearest_poses(self) -> Motions:
        """The poses of the kinematic bound [rad]."""
        return self._references().motions["nearest_poses"]

    def only(self, index: int) -> "Evaluator":
        """An evaluator of one of the demonstrations, whose references take a fraction of the time; it is held out."""
        demonstrations = self.env.demonstrations
        return Evaluator(self.env.with_demonstrations(demonstrations.select([])), demonstrations.select([index]))

    def rollout(self, controller: Controller | ControllerWithMemory) -> Rollouts:
        """Runs a controller on every demonstration. Call it under `jax.jit`."""
        env = self.env
        if not isinstance(controller, ControllerWithMemory):
            function = controller
            controller = ControllerWithMemory(lambda state: (), lambda state, memory: (function(state), memory))

        def begin(demonstration: Array) -> tuple[State, Any]:
            key = jax.random.fold_in(jax.random.PRNGKey(0), demonstration)
            state = env.begin(env.start(key, demonstration))
            return state, controller.start(state)

        def step(carry: tuple[State, Any]) -> tuple[tuple[State, Any], Rollouts]:
            action, memory = controller.act(*carry)
            action = jnp.clip(action, -1.0, 1.0)
            state = env.step(carry[0], action)
            after: Any = state.pipeline_state
            torque, command = env.commanded_torque(after, action), env.command(carry[0].pipeline_state, action)
            terms = {term.name: state.metrics[term.metric] for term in env.reward_terms}
            distance = state.metrics["distance"]
            return (state, memory), Rollouts(after.qpos, after.qvel, torque, distance, command, reward_terms=terms)

        # `vmap` is inside the loop: around the loop, JAX would trace a step twice, without and with the batch.
        start = jax.vmap(begin)(jnp.arange(env.demonstrations.count))
        _, over_time = jax.lax.scan(lambda carry, _: jax.vmap(step)(carry), start, None, length=env.config.horizon)
        rollouts = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), over_time)
        first: Any = start[0].pipeline_state
        return dataclasses.replace(rollouts, start=first.qpos)

    @property
    def parts(self) -> dict[str, slice]:
        """The demonstrations of each split, as slices of all demonstrations."""
        return {"train": slice(0, self._num_train), "held_out": slice(self._num_train, None)}

    @functools.cached_property
    def _expert_line(self) -> CentreLine:
        """Centre lines of the demonstrations after each step."""
        steps, expert = self.env.config.horizon, self.env.embodiments[0]
        return centre_line_table(expert, self.env.demonstrations.qpos[:, 1 : steps + 1].astype(np.float32))

    def similarity(self, qpos: Motions) -> Table:
        """Similarity of a learner's motions, one row for each demonstration, see `measure_similarity`."""
        return measure_similarity(self._expert_line, self.env.embodiments[1], np.asarray(qpos, np.float32))

    @functools.cached_property
    def _baseline_similarity(self) -> dict[str, Table]:
        return {name: self.similarity(qpos) for name, qpos in self._references().motions.items()}

    def similarity_summary(self, rollouts: Rollouts, controller: str) -> dict[str, dict[str, dict[str, float]]]:
        """Means by split of each measure of similarity, for a controller and for the baselines.

        The baselines are `nearest_poses`, the poses of the kinematic bound, and those of
        `mimic.retargeting.pose_baselines.BASELINES`.
        """
        tables = {controller: self.similarity(np.asarray(rollouts.qpos)), **self._baseline_similarity}
        return means_by_split(tables, self.parts)

    def table(self, rollouts: Rollouts) -> Table:
        """One row for each demonstration: gap, mean distance, bound, distance of the start pose, and `measure`'s.

        `reward.NAME` is the mean of a reward term, unweighted.
        """
        qpos, qvel, torque = (np.asarray(x) for x in (rollouts.qpos, rollouts.qvel, rollouts.torque))
        states = link_state_table(self.env.learner, qpos, qvel)
        distances = np.asarray(rollouts.distance), self.lower_bound, self.hold_distance
        distance, bound, hold = (x.mean(axis=1, dtype=float) for x in distances)
        return {
            "optimality_gap": gaps(distance, bound, hold),
            "mean_distance": distance,
            "lower_bound": bound,
            "hold_distance": hold,
            **measure(self.env, states, qpos, qvel, torque),
            **{f"reward.{name}": np.asarray(x).mean(axis=1, dtype=float) for name, x in rollouts.reward_terms.items()},
        }

    def summary(self, rollouts: Rollouts) -> dict[str, Any]:
        """The metrics of a controller, for the training and the held-out demonstrations."""
        table, parts = self.table(rollouts), self.parts

        def by_split(values: np.ndarray, total: Callable[..., Any] = np.mean) -> dict[str, float]:
            return {split: total(values[part]).item() for split, part in parts.items()}

        means = {key: by_split(table[key]) for key in ("mean_distance", "lower_bound", "hold_distance")}
        return {
            "optimality_gap": {split: float(gaps(*(mean[split] for mean in means.values()))) for split in SPLITS},
            **means,
            "by_kind": self._by_kind(table),
            "effective_rank": {
                split: effective_rank(self.env.demonstrations.select(part)) for split, part in parts.items()
            },
            **{
                key: by_split(values, np.sum if key.endswith("violations") else np.mean)
                for key, values in table.items()
                if key not in means and key != "optimality_gap"
            },
        }

    def _by_kind(self, table: Table) -> dict[str, dict[str, dict[str, float]]]:
        """The gap of each kind of demonstrations and of all, with its interval, as {kind: {split: {name: number}}}."""
        columns = np.stack([table[key] for key in ("mean_distance", "lower_bound", "hold_distance")])
        kinds = np.array(self.env.demonstrations.kinds)
        result: dict[str, dict[str, dict[str, float]]] = {}
        for kind in (*dict.fromkeys(kinds.tolist()), ALL_KINDS):
            for split, part in self.parts.items():
                distance, bound, hold = columns[:, part][:, (kinds[part] == kind) | (kind == ALL_KINDS)]
                if len(distance):
                    gap, low, high = gap_interval(distance[None], bound, hold)
                    numbers = {"optimality_gap": gap, "low": low, "high": high, "demonstrations": len(distance)}
                    result.setdefault(kind, {})[split] = numbers
        return result

    def worst(self, rollouts: Rollouts) -> dict[str, dict[str, float]]:
        """The largest gaps of each split, by number of the demonstration."""
        gap = self.table(rollouts)["optimality_gap"]
        worst = {}
        for split, part in self.parts.items():
            order = np.argsort(-gap[part])[:WORST]  # those without a gap come last
            worst[split] = {str(index): float(gap[part][index]) for index in order if np.isfinite(gap[part][index])}
        return worst

    def save_curves(self, rollouts: Rollouts, out: Path) -> None:
        """Writes the curves of `quality.png` as CSV: the distance over the time of an episode, for each split."""
        dt, distance = self.env.config.control_dt, np.asarray(rollouts.distance)
        rows = []
        for split, part in self.parts.items():
            low, high = np.quantile(distance[part], [0.1, 0.9], axis=0)
            curves = distance[part].mean(axis=0), low, high, self.lower_bound[part].mean(axis=0)
            columns = *curves, self.hold_distance[part].mean(axis=0)
            rows += [(split, round(dt * (i + 1), 9), *values) for i, values in enumerate(zip(*columns, strict=True))]
        write_csv(out, ["split", "time", "mean", "low", "high", "bound", "hold"], rows)

    def save_table(self, rollouts: Rollouts, out: Path) -> None:
        """Writes the table as CSV, with the split and the number of each demonstration."""
        table = {**self.table(rollouts), **self.similarity(np.asarray(rollouts.qpos))}
        numbers = [(split, i) for split, part in self.parts.items() for i in range(len(self.hold_distance[part]))]
        kinds = self.env.demonstrations.kinds
        rows = [(*number, *row) for number, *row in zip(numbers, kinds, *table.values(), strict=True)]
        write_csv(out, ["split", "demonstration", "kind", *table], rows)


class References(NamedTuple):
    """The references of the metrics.

    Attributes:
      bound: [demonstrations, time] the kinematic bound.
      hold: [demonstrations, time] distance of holding the start pose.
      motions: the learner's angles [demonstrations, time, joints] [rad] by baseline; see
        `Evaluator.similarity_summary`.
    """

    bound: Float[np.ndarray, "demonstrations time"]
    hold: Float[np.ndarray, "demonstrations time"]
    motions: dict[str, Motions]


def _references(env: ImitationEnv) -> References:
    steps = env.config.horizon
    qpos, qvel = (x[:, 1 : steps + 1] for x in (env.demonstrations.qpos, env.demonstrations.qvel))
    copied_qpos, copied_qvel = (shared_joints(env.expert, env.learner, x) for x in (qpos, qvel))
    copied_qpos = np.clip(copied_qpos, *pose_limits(env.learner, float))
    expert = jax.tree.map(lambda x: np.asarray(x)[:, 1 : steps + 1], env.expert_states)
    distance = jax.jit(jax.vmap(jax.vmap(env.states_distance)))
    held_qpos = np.broadcast_to(env.start_poses[:, None], copied_qpos.shape)
    copied, hold = (
        np.asarray(distance(expert, link_state_table(env.learner, *motion)))
        for motion in ((copied_qpos, copied_qvel), (held_qpos, np.zeros_like(copied_qvel)))
    )
    # If copying the expert's joints gives distance 0 everywhere, the bound needs no optimisation.
    bound, nearest = _lower_bound(env, qpos, qvel) if copied.any() else (copied, copied_qpos)
    motions = {"nearest_poses": nearest, **baseline_poses(env.expert, env.learner, qpos)}
    return References(bound, hold, motions)


def _lower_bound(env: ImitationEnv, qpos: Motions, qvel: Motions) -> tuple[np.ndarray, Motions]:
    """The kinematic bound [demonstrations, time], and its poses."""

    def closest(qpos: Array, qvel: Array) -> tuple[Array, Array]:
        solution = closest_motion(env.expert, env.learner, qpos, qvel, **env.metric.arguments)
        return solution.distance, solution.qpos

    # Of many demonstrations in chunks of one size, the last one filled up: all at once, they need too much memory.
    count = len(qpos)
    size = min(count, _CHUNK)
    padded = np.minimum(np.arange(-(-count // size) * size), count - 1).reshape(-1, size)
    # On the CPU, where the function compiles several times faster; it runs only once.
    with on_host():
        search = jax.jit(jax.vmap(closest))
        chunks = [search(qpos[rows].astype(np.float32), qvel[rows].astype(np.float32)) for rows in padded]
        distance, poses = (np.concatenate([np.asarray(chunk[i]) for chunk in chunks])[:count] for i in range(2))
        return distance, poses
