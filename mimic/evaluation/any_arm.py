"""Evaluates a policy of any arm: every arm of a report on the same held-out demonstrations, in one function."""

import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State
from flax import struct
from jaxtyping import Array, Float

from mimic.arms.arm import build_arm
from mimic.arms.arrays import MAX_JOINTS, ArmArrays, arm_arrays, stack_arms
from mimic.base.compilation import Background, compiled_quickly, on_host
from mimic.envs.family import SEEN, UNSEEN
from mimic.envs.many_arms import AnyArmEnv, any_arm_state
from mimic.evaluation.evaluator import Controller
from mimic.evaluation.rollout_metrics import gaps
from mimic.metric.kinematics import LinkStates, link_states
from mimic.metric.similarity import centre_line, similarity
from mimic.retargeting.array_bound import closest_motion
from mimic.runs.files import write_csv

EVALUATED_DEMONSTRATIONS = 8  # of the held-out ones: with 29 arms, 232 rollouts and bounds
_ROUNDING = 1e-5  # relative float32 error of a velocity at its limit

Motions = Float[Any, "arms demonstrations time joints"]
Distances = Float[Any, "arms demonstrations time"]
ArmTable = dict[str, Float[np.ndarray, " arms"]]


@struct.dataclass
class ArmRollouts:
    """Rollouts of a controller: each arm on each demonstration.

    Attributes:
      qpos: [arms, demonstrations, T, joints] joint angles after each step [rad].
      is_fast: [arms, demonstrations, T] whether a joint exceeds its velocity limit after the step.
      distance: [arms, demonstrations, T] embodiment distance after each step.
    """

    qpos: Motions
    is_fast: Distances
    distance: Distances


class ArmsOutcome(NamedTuple):
    """The rollouts of a policy, and those of the zero action, which is the controller without learning."""

    policy: ArmRollouts
    controller: ArmRollouts


class ArmReferences(NamedTuple):
    """The references of the metrics.

    Attributes:
      bound: [arms, demonstrations, T] the kinematic bound.
      hold: [arms, demonstrations, T] distance of holding the home pose.
      nearest: [arms, demonstrations, T, joints] the poses of the bound [rad].
    """

    bound: Distances
    hold: Distances
    nearest: Motions


class ArmsEvaluator:
    """Evaluates controllers on the arms of a report.

    Args:
      env: the environment on the demonstrations of the report.
      arms: the arms by their names, of the splits `SEEN` and `UNSEEN`; see `report_arms`.
      controller: the rollouts of the zero action, from which the bound's search starts.

    Attributes:
      env: the environment.
      names: the names of all arms, those seen in training first.
      arms: all arms in this order, [arms, ...] each.

    Raises:
      ValueError: no arms, or two of one name.
    """

    def __init__(
        self, env: AnyArmEnv, arms: Mapping[str, Mapping[str, ArmArrays]], controller: Callable[[], ArmRollouts]
    ):
        self.env = env
        self.names = [name for split in (SEEN, UNSEEN) for name in arms[split]]
        if len(set(self.names)) < max(len(self.names), 1):
            raise ValueError(f"arms: expected arms of different names in the report, got {', '.join(self.names)}")
        ordered = [arm for split in (SEEN, UNSEEN) for arm in arms[split].values()]
        self.arms: ArmArrays = jax.tree.map(jnp.asarray, stack_arms(ordered).astype(np.float32))
        self._num_seen = len(arms[SEEN])
        expert = build_arm(env.config.expert, env.config.limits, env.config.metric.links)
        self._expert = jax.tree.map(jnp.asarray, arm_arrays(expert).astype(np.float32))
        steps = env.config.horizon
        qpos = env.demonstrations.qpos[:, 1 : steps + 1]
        padding = [(0, 0), (0, 0), (0, MAX_JOINTS - qpos.shape[-1])]
        self._expert_qpos = np.pad(qpos, padding).astype(np.float32)
        self._references = Background(lambda: self._compute_references(controller()))

    def prepare(self) -> None:
        """Starts to compute the bounds and the distances of holding the home pose in the background."""
        self._references.start()

    def references(self) -> ArmReferences:
        """The bounds and the distances of holding the home pose, computed once."""
        return self._references()

    @property
    def parts(self) -> dict[str, slice]:
        """The arms of each split, as slices of all arms: "train" are those seen in training."""
        return {"train": slice(0, self._num_seen), "held_out": slice(self._num_seen, None)}

    def rollout(self, controller: Controller, env: AnyArmEnv | None = None) -> ArmRollouts:
        """Runs a controller of any arm on every arm and demonstration. Call it under `jax.jit`.

        Args:
          controller: the controller.
          env: the environment on other demonstrations than those of the report.
        """
        env = env or self.env
        count = env.demonstrations.count
        arms = jax.tree.map(lambda x: jnp.repeat(x, count, axis=0), self.arms)  # one batch, as in training
        demonstrations = jnp.tile(jnp.arange(count), len(self.names))

        def begin(arm: ArmArrays, demonstration: Array) -> State:
            return env.begin(env.start_of(arm, demonstration, jax.random.PRNGKey(0)))

        def step(state: State) -> tuple[State, ArmRollouts]:
            state = env.step(state, jnp.clip(controller(state), -1.0, 1.0))
            after = any_arm_state(state)
            is_slow = jnp.abs(after.qvel) <= after.arm.velocity_limit * (1 + _ROUNDING)  # False for NaN too
            fast = jnp.any(~is_slow & (after.arm.is_free > 0))
            return state, ArmRollouts(after.qpos, fast.astype(jnp.float32), state.metrics["distance"])

        start = jax.vmap(begin)(arms, demonstrations)
        _, over_time = jax.lax.scan(lambda state, _: jax.vmap(step)(state), start, None, length=env.config.horizon)
        shape = len(self.names), count
        return jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1).reshape(*shape, len(x), *x.shape[2:]), over_time)

    def _compute_references(self, controller: ArmRollouts) -> ArmReferences:
        """The references; one arm after the other, so that the search takes the memory of one."""
        env = self.env
        expert_states = jax.tree.map(lambda x: np.asarray(x)[:, 1 : env.config.horizon + 1], env.expert_states)

        def of_arm(inputs: tuple[ArmArrays, Array]) -> ArmReferences:
            arm, guesses = inputs
            metric, at_home = env.metric_of(arm), link_states(arm, arm.home)

            def of_demonstration(expert: LinkStates, guess: Array) -> ArmReferences:
                closest = closest_motion(arm, metric, expert, jnp.where(jnp.isfinite(guess), guess, arm.home))
                hold = jax.vmap(lambda state: metric(state, at_home))(expert)
                return ArmReferences(closest.distance, hold, closest.qpos)

            return jax.vmap(of_demonstration)(expert_states, guesses)

        inputs = jax.tree.map(np.asarray, (self.arms, controller.qpos))
        with on_host():  # as the bound of one arm: there it compiles several times faster, and it runs once
            search = compiled_quickly(lambda *inputs: jax.lax.map(of_arm, inputs), *inputs)
            return jax.tree.map(np.asarray, search(*inputs))

    def table(self, outcome: ArmsOutcome) -> ArmTable:
        """One row for each arm: joints, gaps, distances and the fraction of steps above a velocity limit.

        `span` is the fraction of the distance of holding that a best motion saves. The bound is the result of a search;
        at steps where a rollout is below it, it is lowered to the rollout.
        """
        references = self.references()
        policy, controller = (np.asarray(rollouts.distance) for rollouts in outcome)
        lowered = np.minimum(references.bound, np.minimum(policy, controller))
        distances = policy, controller, lowered, references.hold
        distance, own, bound, hold = (x.mean(axis=(1, 2), dtype=float) for x in distances)
        return {
            "joints": np.asarray(self.arms.is_free).sum(axis=1),
            "gap": gaps(distance, bound, hold),
            "controller_gap": gaps(own, bound, hold),
            "mean_distance": distance,
            "lower_bound": bound,
            "hold_distance": hold,
            "span": 1 - bound / np.maximum(hold, 1e-12),
            "speed_violations": np.asarray(outcome.policy.is_fast).mean(axis=(1, 2), dtype=float),
        }

    def summary(self, outcome: ArmsOutcome) -> dict[str, dict[str, float]]:
        """The metrics by split, if it has arms: means over them, and their median and largest gap."""
        table = self.table(outcome)
        totals: dict[str, tuple[str, Callable[[np.ndarray], Any]]] = {
            "optimality_gap": ("gap", np.mean),
            "median_gap": ("gap", np.median),
            "largest_gap": ("gap", np.max),
            "controller_gap": ("controller_gap", np.mean),
            **{key: (key, np.mean) for key in ("mean_distance", "lower_bound", "hold_distance", "speed_violations")},
        }
        parts = {split: part for split, part in self.parts.items() if self.names[part]}
        return {
            key: {split: _total(table[column][part], total) for split, part in parts.items()}
            for key, (column, total) in totals.items()
        }

    def details(self, outcome: ArmsOutcome) -> dict[str, dict[str, Any]]:
        """The row of each arm by its name, with whether it was seen in training; None for a gap without meaning."""
        table = self.table(outcome)
        rows = {}
        for index, name in enumerate(self.names):
            values = {key: column[index].item() for key, column in table.items()}
            rows[name] = {"seen": index < self._num_seen, **values, "joints": int(values["joints"])}
        return rows

    @functools.cached_property
    def _measure(self) -> Callable[[Motions], dict[str, Array]]:
        """Measures of similarity [arms, demonstrations] of motions of all arms, means over time."""

        def of_one(arm: ArmArrays, expert_qpos: Array, qpos: Array) -> dict[str, Array]:
            values = similarity(centre_line(self._expert, expert_qpos), centre_line(arm, qpos))
            return {name: value.mean() for name, value in values.items()}

        of_arm = jax.vmap(of_one, in_axes=(None, 0, 0))
        expert_qpos = jnp.asarray(self._expert_qpos)
        return jax.jit(lambda qpos: jax.vmap(of_arm, in_axes=(0, None, 0))(self.arms, expert_qpos, qpos))

    def similarity_summary(self, outcome: ArmsOutcome, name: str) -> dict[str, dict[str, dict[str, float]]]:
        """Means by split of each measure of similarity, as `Evaluator.similarity_summary`.

        Args:
          outcome: the rollouts.
          name: of the policy, or of the controller in its place.
        """
        home = jnp.broadcast_to(self.arms.home[:, None, None], outcome.policy.qpos.shape)
        motions = {"controller": outcome.controller.qpos, name: outcome.policy.qpos}
        motions |= {"nearest_poses": self.references().nearest, "hold_home": home}
        if name != "policy":
            del motions["controller"]  # it is the one that was evaluated
        else:
            motions = {name: motions.pop(name), **motions}
        result: dict[str, dict[str, dict[str, float]]] = {}
        for method, qpos in motions.items():
            measures = {key: np.asarray(value, float) for key, value in self._measure(jnp.asarray(qpos)).items()}
            result[method] = {
                key: {split: float(value[part].mean()) for split, part in self.parts.items() if value[part].size}
                for key, value in measures.items()
            }
        return result

    def save_table(self, outcome: ArmsOutcome, out: Path) -> None:
        """Writes the table as CSV, with the split and the name of each arm."""
        table = self.table(outcome)
        seen = ["seen"] * self._num_seen + ["unseen"] * (len(self.names) - self._num_seen)
        write_csv(out, ["arms", "arm", *table], zip(seen, self.names, *table.values(), strict=True))


def _total(values: np.ndarray, total: Callable[[np.ndarray], Any]) -> float:
    """A total of the values that are not NaN."""
    finite = values[~np.isnan(values)]
    return float(total(finite)) if finite.size else float("nan")
