"""Evaluates controllers: every demonstration once, relative to the kinematic bound and to holding the start pose."""

import copy
import dataclasses
import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State
from flax import struct
from jaxtyping import Array, Float

from mimic.arms.arrays import ArmArrays, stack_arms
from mimic.base.compilation import Background
from mimic.envs.family import SEEN, UNSEEN
from mimic.envs.imitation import ImitationEnv
from mimic.envs.many_arms import AnyArmEnv
from mimic.evaluation.labels import ALL_KINDS, SPLITS
from mimic.evaluation.nearest_pose_controller import ControllerWithMemory
from mimic.evaluation.references import (
    CONTROLLER,
    Motions,
    References,
    baseline_motions,
    references_of_arms,
    references_of_one_arm,
)
from mimic.evaluation.rollout_metrics import (
    WORST,
    Table,
    gap_interval,
    gaps,
    means_by_split,
    measure,
    measure_similarity,
    speed_violations,
)
from mimic.metric.config import CORRESPONDENCES
from mimic.metric.energy_distance import energy_distance
from mimic.metric.kinematics import LinkStates, link_state_table
from mimic.metric.similarity import CentreLine, centre_line_table
from mimic.motions.demonstrations import Demonstrations, concatenate, effective_rank
from mimic.runs.files import write_csv

Controller = Callable[[State], Array]  # (state of the environment) -> action
EVALUATED_TRAINING = 80  # demonstrations for training that are evaluated, or as many as those held out


@struct.dataclass
class Rollouts:
    """Rollouts of a controller, one for each demonstration; of many arms, one for each arm and demonstration.

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


class Group(NamedTuple):
    """The rows of an arm in a split."""

    split: str
    arm: str
    rows: slice


class Evaluator:
    """Evaluates controllers on the training and the held-out demonstrations of an environment.

    Where the environment draws its learner, it evaluates the arms of a report on the held-out demonstrations. The
    splits are then those of the arms: "train" are those seen in training. A row of a table is a demonstration; of many
    arms, those of the first arm come first, then those of the second, and so on.

    Args:
      env: the training environment.
      held_out: demonstrations for evaluation only.
      arms: the arms of a report by split and name, see `report_arms`; none where the environment has one learner.
      controller: the rollouts of the zero action of many arms, with which they are compared.

    Attributes:
      env: the training environment on the evaluated demonstrations, those for training first.
      groups: the rows of each arm and split.

    Raises:
      ValueError: no arms, or two of one name.
    """

    def __init__(
        self,
        env: ImitationEnv,
        held_out: Demonstrations,
        arms: Mapping[str, Mapping[str, ArmArrays]] | None = None,
        controller: "Callable[[], Rollouts] | None" = None,
    ):
        self._arms: ArmArrays | None = None  # [arms, ...] each
        if arms is None:
            training = env.demonstrations.select(slice(0, max(EVALUATED_TRAINING, held_out.count)))
            self.env = env.with_demonstrations(concatenate(training, held_out))
            ends = 0, training.count, training.count + held_out.count
            self.groups = [Group(split, env.learner.name, slice(*ends[i : i + 2])) for i, split in enumerate(SPLITS)]
            self._references = Background(lambda: references_of_one_arm(self.env))
            self._baselines = Background(lambda: baseline_motions(self.env))
            return
        assert isinstance(env, AnyArmEnv) and controller is not None
        names = [(split, name) for split, key in zip(SPLITS, (SEEN, UNSEEN), strict=True) for name in arms[key]]
        if len({name for _, name in names}) < max(len(names), 1):
            shown = ", ".join(name for _, name in names)
            raise ValueError(f"arms: expected arms of different names in the report, got {shown}")
        of_many = self.env = env.by_distance().with_demonstrations(held_out)
        count = held_out.count
        self.groups = [Group(*names[i], slice(i * count, (i + 1) * count)) for i in range(len(names))]
        stacked = stack_arms([arm for key in (SEEN, UNSEEN) for arm in arms[key].values()]).astype(np.float32)
        self._arms = stacked

        def references() -> References:
            rollouts = jax.device_get(controller())
            return references_of_arms(of_many, stacked, rollouts.qpos, rollouts.distance)

        self._references = Background(references)
        self._baselines = Background(lambda: {})  # they are among the references

    def on_mjx(self) -> "Evaluator":
        """An evaluator of rollouts on MJX, with the same bound and the same baselines."""
        evaluator = copy.copy(self)
        evaluator.env = self.env.on_mjx()
        return evaluator

    def prepare(self) -> None:
        """Starts to compute `lower_bound` and `hold_distance` in the background."""
        self._references.start()

    def prepare_baselines(self) -> None:
        """Starts to compute the baselines in the background. Most of it is Python, which would delay a compilation."""
        self._baselines.start()

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

        def begin(demonstration: Array, arm: ArmArrays | None) -> tuple[State, Any]:
            key = jax.random.PRNGKey(0)
            if arm is None:
                start = env.start(jax.random.fold_in(key, demonstration), demonstration)
            else:
                start = cast(AnyArmEnv, env).start_of(arm, demonstration, key)
            state = env.begin(start)
            return state, controller.start(state)

        def step(carry: tuple[State, Any]) -> tuple[tuple[State, Any], Rollouts]:
            action, memory = controller.act(*carry)
            action = jnp.clip(action, -1.0, 1.0)
            state = env.step(carry[0], action)
            after: Any = state.pipeline_state
            before: Any = carry[0].pipeline_state
            torque, command = env.commanded_torque(before, after, action), env.command(before, action)
            terms = {term.name: state.metrics[term.metric] for term in env.reward_terms}
            distance = state.metrics["distance"]
            return (state, memory), Rollouts(after.qpos, after.qvel, torque, distance, command, reward_terms=terms)

        # `vmap` is inside the loop: around the loop, JAX would trace a step twice, without and with the batch.
        count = env.demonstrations.count
        arms = self._arms_of_rows(count)
        start = jax.vmap(begin)(jnp.tile(jnp.arange(count), 1 if arms is None else len(self.groups)), arms)
        _, over_time = jax.lax.scan(lambda carry, _: jax.vmap(step)(carry), start, None, length=env.config.horizon)
        rollouts = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), over_time)
        first: Any = start[0].pipeline_state
        return dataclasses.replace(rollouts, start=first.qpos)

    def _arms_of_rows(self, count: int) -> ArmArrays | None:
        """The arm of each row, where each arm has `count` demonstrations; None for one learner."""
        if self._arms is None:
            return None
        return jax.tree.map(lambda x: np.repeat(x, count, axis=0), self._arms)

    @property
    def parts(self) -> dict[str, slice]:
        """The rows of each split that has an arm, as slices of all rows."""
        rows = {group.split: [g.rows for g in self.groups if g.split == group.split] for group in self.groups}
        return {split: slice(slices[0].start, slices[-1].stop) for split, slices in rows.items()}

    @functools.cached_property
    def _expert_line(self) -> CentreLine:
        """Centre lines of the expert after each step, for each row."""
        qpos = self.env.demonstrations.qpos[:, 1 : self.env.config.horizon + 1].astype(np.float32)
        if self._arms is None:
            return centre_line_table(self.env.embodiments[0], qpos)
        line = centre_line_table(self.env.expert, qpos)
        return jax.tree.map(lambda x: np.tile(x, (len(self.groups), *[1] * (x.ndim - 1))), line)

    def similarity(self, qpos: Motions) -> Table:
        """Similarity of a learner's motions, one row for each, see `measure_similarity`."""
        learner = self._arms_of_rows(self.env.demonstrations.count) or self.env.embodiments[1]
        return measure_similarity(self._expert_line, learner, np.asarray(qpos, np.float32))

    @functools.cached_property
    def _baseline_similarity(self) -> dict[str, Table]:
        motions = {**self._references().motions, **self._baselines()}
        return {name: self.similarity(qpos) for name, qpos in motions.items()}

    def similarity_summary(self, rollouts: Rollouts, controller: str) -> dict[str, dict[str, dict[str, float]]]:
        """Means by split of each measure of similarity, for a controller and for the baselines.

        The baselines are `nearest_poses`, the poses of the kinematic bound, and those of
        `mimic.retargeting.pose_baselines.BASELINES`; of many arms, the zero action and holding the home pose.
        """
        baselines = dict(self._baseline_similarity)
        if controller != "policy":
            baselines.pop(CONTROLLER, None)  # it is the one that was evaluated
        tables = {controller: self.similarity(np.asarray(rollouts.qpos)), **baselines}
        return means_by_split(tables, self.parts)

    def energy_distance(self, rollouts: Rollouts) -> dict[str, float]:
        """Energy distance between the ensembles of expert and learner at each step, one learner; means by split.

        Empty with a registered correspondence, which may know the pair alone and no arm beside itself.
        """
        env = self.env
        if env.config.metric.correspondence not in CORRESPONDENCES:
            return {}
        learner_states = link_state_table(env.learner, np.asarray(rollouts.qpos), np.asarray(rollouts.qvel))
        expert_states = jax.tree.map(lambda x: x[:, 1 : env.config.horizon + 1], jax.device_get(env.expert_states))

        def of_step(pair: tuple[LinkStates, LinkStates]) -> Array:
            return energy_distance(env.expert, env.learner, pair[0], pair[1], env.config.metric)

        @jax.jit
        def mean(*states: LinkStates) -> Array:
            return jnp.mean(jax.lax.map(of_step, jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), states)))

        def of_part(part: slice) -> float:
            return float(mean(*(jax.tree.map(lambda x: x[part], x) for x in (expert_states, learner_states))))

        return {split: of_part(part) for split, part in self.parts.items()}

    def table(self, rollouts: Rollouts) -> Table:
        """One row for each demonstration: gap, mean distance, bound, distance of the start pose, and `measure`'s.

        `reward.NAME` is the mean of a reward term, unweighted. Of many arms there are the distance of the zero action
        and the fraction of steps above a velocity limit instead of `measure`'s columns. The bound is the result of a
        search; at steps where a rollout of one of many arms is below it, it is lowered to the rollout.
        """
        qpos, qvel, torque = (np.asarray(x) for x in (rollouts.qpos, rollouts.qvel, rollouts.torque))
        distances, bounds, controller = np.asarray(rollouts.distance), self.lower_bound, self._references().controller
        if self._arms is None:
            measured = measure(self.env, link_state_table(self.env.learner, qpos, qvel), qpos, qvel, torque)
        else:
            assert controller is not None
            bounds, controller_distance = np.minimum(bounds, distances), controller.mean(axis=1, dtype=float)
            arms = cast(ArmArrays, self._arms_of_rows(self.env.demonstrations.count))
            measured = {"controller_distance": controller_distance, "speed_violations": speed_violations(arms, qvel)}
        distance, bound, hold = (x.mean(axis=1, dtype=float) for x in (distances, bounds, self.hold_distance))
        return {
            "optimality_gap": gaps(distance, bound, hold),
            "mean_distance": distance,
            "lower_bound": bound,
            "hold_distance": hold,
            **measured,
            **{f"reward.{name}": np.asarray(x).mean(axis=1, dtype=float) for name, x in rollouts.reward_terms.items()},
        }

    def by_arm(self, table: Table) -> Table:
        """Totals of the columns over the rows of each of `groups`: sums of violations of one arm, otherwise means.

        The gaps are those of the mean distances. `span` is the fraction of the distance of holding that a best motion
        saves.
        """

        def of_groups(key: str) -> np.ndarray:
            total = np.sum if self._arms is None and key.endswith("violations") else np.mean
            return np.array([total(table[key][group.rows]) for group in self.groups])

        totals = {key: of_groups(key) for key in table if key != "optimality_gap"}
        bound, hold = totals["lower_bound"], totals["hold_distance"]
        columns = {"gap": gaps(totals["mean_distance"], bound, hold)}
        if self._arms is not None:
            columns["controller_gap"] = gaps(totals.pop("controller_distance"), bound, hold)
        return {**columns, **totals, "span": 1 - bound / np.maximum(hold, 1e-12)}

    def summary(self, rollouts: Rollouts) -> dict[str, Any]:
        """The metrics of a controller by split; of many arms means over them, their median and their largest gap."""
        table = self.table(rollouts)
        by_arm, splits = self.by_arm(table), np.array([group.split for group in self.groups])

        def by_split(key: str, total: Callable[[np.ndarray], Any] = np.mean) -> dict[str, float]:
            values = {split: by_arm[key][splits == split] for split in self.parts}
            finite = {split: of_split[~np.isnan(of_split)] for split, of_split in values.items()}
            return {split: total(of_split).item() if of_split.size else np.nan for split, of_split in finite.items()}

        gaps_of_many: dict[str, Any] = {}
        of_one: dict[str, Any] = {}
        if self._arms is None:
            of_one = {"by_kind": self._by_kind(table), "effective_rank": self._effective_rank()}
            of_one["late_gap"] = self._late_gap(rollouts)
        else:
            gaps_of_many = {"median_gap": by_split("gap", np.median), "largest_gap": by_split("gap", np.max)}
            gaps_of_many["controller_gap"] = by_split("controller_gap")
        distances = {key: by_split(key) for key in ("mean_distance", "lower_bound", "hold_distance")}
        others = [key for key in by_arm if key not in ("gap", "controller_gap", "span", *distances)]
        totals = {key: by_split(key) for key in others}
        return {"optimality_gap": by_split("gap"), **gaps_of_many, **distances, **of_one, **totals}

    def _late_gap(self, rollouts: Rollouts) -> dict[str, float]:
        """The gap of the second half of the episodes by split, in which the way from the start pose has ended."""
        curves = np.asarray(rollouts.distance), self.lower_bound, self.hold_distance
        late = slice(curves[0].shape[1] // 2, None)
        return {
            split: float(gaps(*(x[part, late].mean(dtype=float) for x in curves))) for split, part in self.parts.items()
        }

    def _effective_rank(self) -> dict[str, float]:
        demonstrations = self.env.demonstrations
        return {split: effective_rank(demonstrations.select(part)) for split, part in self.parts.items()}

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

    def details(self, rollouts: Rollouts) -> dict[str, dict[str, Any]]:
        """The row of each of many arms in `by_arm`, its number of joints, and whether training has seen it."""
        by_arm, details = self.by_arm(self.table(rollouts)), {}
        for i, (split, name, _) in enumerate(self.groups):
            joints = int(np.sum(cast(ArmArrays, self._arms).is_free[i]))
            values = {key: column[i].item() for key, column in by_arm.items()}
            details[name] = {"seen": split == "train", "joints": joints, **values}
        return details

    def save_arms(self, rollouts: Rollouts, out: Path) -> None:
        """Writes `details` as CSV."""
        rows = [{"arms": "seen" if arm.pop("seen") else "unseen", "arm": name, **arm}
                for name, arm in self.details(rollouts).items()]  # fmt: skip
        write_csv(out, list(rows[0]), [tuple(row.values()) for row in rows])

    def save_table(self, rollouts: Rollouts, out: Path) -> None:
        """Writes the table as CSV, with the split and the number of each demonstration."""
        table = {**self.table(rollouts), **self.similarity(np.asarray(rollouts.qpos))}
        numbers = [(split, i) for split, part in self.parts.items() for i in range(len(self.hold_distance[part]))]
        kinds = self.env.demonstrations.kinds
        rows = [(*number, *row) for number, *row in zip(numbers, kinds, *table.values(), strict=True)]
        write_csv(out, ["split", "demonstration", "kind", *table], rows)
