"""The imitation environment whose learner is another arm in each episode; one compiled function for all of them.

An action does not set torques: the same torque means something else on every arm. It changes accelerations. Those
without it lead to one of the poses nearest to the expert's, see `next_goals`. Inverse
dynamics turns accelerations into torques within the arm's limits, see `planned_torque`. So the zero action is
already a controller of any arm, and a policy learns what it lacks.
"""

import copy
import dataclasses
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State
from flax import struct
from jaxtyping import Array, Float, Int

from mimic.arms.arm import Arm
from mimic.arms.arrays import MAX_JOINTS, ArmArrays, arm_arrays
from mimic.arms.sampler import Sampler
from mimic.envs.arm_state import ArmState, arm_state
from mimic.envs.config import EnvConfig
from mimic.envs.family import arm_sampler, check_family
from mimic.envs.imitation import ImitationEnv, where_done
from mimic.envs.many_arms_control import Plan, make_plan, max_speed, planned_torque, torque_scale
from mimic.envs.many_arms_observation import observation_size, observe
from mimic.metric.config import check_metric
from mimic.metric.correspondence import arc_length_correspondence
from mimic.metric.distance import Metric
from mimic.metric.kinematics import link_states
from mimic.motions.demonstrations import Demonstrations
from mimic.physics.composite_kernel import make_advance
from mimic.physics.step import PhysicsChoice
from mimic.retargeting.array_goals import Goals, Problem, chosen_goal, first_goals, next_goals, random_numbers

_HOLD_SAMPLES = 5  # steps of a demonstration at which the distance of holding the home pose is computed
_RUNAWAY = 3.0  # distance charged for each step after a runaway, as a multiple of that of holding the home pose
_EXCESS = 0.01  # added to the excess of both distances in a relative reward, in units of holding the home pose
_MIN_HOLD = 1e-3  # distance; below it, an arm that rests is already where the expert is


_states_of_motions = jax.jit(jax.vmap(jax.vmap(link_states, (None, 0, 0)), (None, 0, 0)))


@struct.dataclass
class AnyArmState(ArmState):
    """The state of an episode, with its arm.

    Attributes:
      arm: the learner.
      max_torque: [joints] maximum torque [N m], see `torque_scale`.
      hold: mean distance of holding the home pose, the unit of the reward.
      followed: the local minima at the last step, after the choice of the goal.
      goals: the local minima that the controller follows, which `with_plan` derives from `followed`.
      plan: what the controller does in the next step; from `with_plan`.
      baseline: the same episode with zero actions, which the reward compares with; None in `AnyArmEnv.by_distance`.
    """

    arm: ArmArrays = None  # type: ignore[assignment] - fields after one with a default need one too
    max_torque: Float[Array, " joints"] = None  # type: ignore[assignment]
    hold: Float[Array, ""] = None  # type: ignore[assignment]
    followed: Goals = None  # type: ignore[assignment]
    goals: Goals = None  # type: ignore[assignment]
    plan: Plan = None  # type: ignore[assignment]
    baseline: "AnyArmState | None" = None


class AnyArmEnv(ImitationEnv):
    """An `ImitationEnv` whose learner is drawn by a sampler for each episode, and carried by the state.

    Reward: how much nearer the arm is than with zero actions since the start of the episode, see `relative_reward`: the
    controller, which is simulated too, has the return 0 on every arm, and all arms count alike. Action: for each joint
    slot a change of its acceleration in [-1, 1], see `planned_torque`. Observation: see
    `mimic.envs.many_arms_observation.observe`.

    Args:
      config: see `EnvConfig`; of the kind "sampled_arms".
      demonstrations: see `ImitationEnv`.
      sampler: draws the learner of an episode; that of the config where None.

    Attributes:
      sampler: draws the learner of an episode.
      expert_arrays: the expert, as the learners are.

    Raises:
      ValueError: settings that such an environment does not have, a metric or expert that arrays do not cover, or
        demonstrations that do not fit.
    """

    def __init__(self, config: EnvConfig, demonstrations: Demonstrations | None = None, sampler: Sampler | None = None):
        check_family(config)
        self._has_baseline = True
        self.sampler = sampler or arm_sampler(config)
        super().__init__(config, demonstrations)

    def _set_arms(self) -> Arm:
        config = self.config
        self._weights = check_metric(config.metric)
        expert = config.build_arm("expert")
        self.expert = expert.embodiment
        self.expert_arrays = jax.tree.map(jnp.asarray, arm_arrays(expert).astype(np.float32))
        self.physics = PhysicsChoice("fused", "the arm is data of the compiled function")
        self.config = dataclasses.replace(config, physics=self.physics.name)
        self._advance = make_advance(config.control_dt / config.substeps, config.substeps)
        return expert

    def _set_demonstrations(self, demonstrations: Demonstrations) -> None:
        demonstrations.check_fits(self.expert, self.config.control_dt, self.config.horizon)
        self.demonstrations = demonstrations
        padding = [(0, 0), (0, 0), (0, MAX_JOINTS - self.expert.num_joints)]
        motions = (np.pad(x, padding).astype(np.float32) for x in (demonstrations.qpos, demonstrations.qvel))
        # By the kinematics of the learners, so that an arm that equals the expert can match it exactly.
        self.expert_states = _states_of_motions(self.expert_arrays, *motions)

    def by_distance(self) -> "AnyArmEnv":
        """The same environment without a baseline to simulate.

        The reward is then minus the embodiment distance after the step, in units of holding the home pose.
        """
        env = copy.copy(self)
        env._has_baseline = False
        return env

    def start(self, key: Array, demonstration: Int[Array, ""] | int | None = None) -> AnyArmState:
        """The first state of an episode of a new arm; the demonstration is random where None."""
        key_demonstration, key_arm, key_next = jax.random.split(key, 3)
        if demonstration is None:
            demonstration = jax.random.randint(key_demonstration, (), 0, self.demonstrations.count)
        return self.start_of(self.sampler(key_arm), demonstration, key_next)

    def start_of(self, arm: ArmArrays, demonstration: Int[Array, ""] | int, key: Array) -> AnyArmState:
        """The first state of an episode of a given arm on a demonstration."""
        demonstration = jnp.asarray(demonstration, jnp.int32)
        metric, zeros = self.metric_of(arm), jnp.zeros(MAX_JOINTS)
        samples = jnp.linspace(1, self.config.horizon, _HOLD_SAMPLES).astype(jnp.int32)
        at_home = link_states(arm, arm.home)
        held = jax.vmap(lambda step: metric(self.expert_at(demonstration, step), at_home))(samples)
        state = AnyArmState(
            qpos=arm.home,
            qvel=zeros,
            step=jnp.zeros((), jnp.int32),
            demonstration=demonstration,
            key=key,
            arm=arm,
            max_torque=torque_scale(arm, self.config.action_scale, self.config.control_dt),
            hold=jnp.maximum(held.mean(), _MIN_HOLD),
            followed=first_goals(arm.home),
            goals=first_goals(arm.home),
            plan=Plan(zeros, jnp.zeros((MAX_JOINTS, MAX_JOINTS)), zeros),
        )
        if self._has_baseline:
            state = dataclasses.replace(state, baseline=state)
        return self.with_plan(state)

    def with_plan(self, state: AnyArmState) -> AnyArmState:
        """The state with its goals at the next step, and the plan to move to the first of them; again, the same."""
        if state.baseline is None:
            return self._planned(state)
        both = jax.tree.map(lambda *x: jnp.stack(x), dataclasses.replace(state, baseline=None), state.baseline)
        both = jax.vmap(self._planned)(both)  # one function for both compiles faster
        own, baseline = (jax.tree.map(lambda x, i=i: x[i], both) for i in range(2))
        return dataclasses.replace(own, baseline=baseline)

    def _planned(self, state: AnyArmState) -> AnyArmState:
        expert = self.expert_at(state.demonstration, state.step + 1)
        matrix, dt = arc_length_correspondence(self.expert_arrays, state.arm), self.config.control_dt
        problem = Problem(state.arm, self._weights, matrix, expert, dt)
        goals = next_goals(problem, state.followed, state.qpos, random_numbers(state.key, state.step))
        speed = max_speed(state.arm, self.config.limits)
        plan = make_plan(state.arm, state.qpos, state.qvel, goals.goal, speed, dt)
        return dataclasses.replace(state, goals=goals, plan=plan)

    def at_step(self, state: ArmState, step: Int[Array, ""]) -> AnyArmState:
        """A state of `start` at another step of its demonstration."""
        state = cast(AnyArmState, state)
        baseline = None if state.baseline is None else dataclasses.replace(state.baseline, step=step)
        return self.with_plan(dataclasses.replace(state, step=step, baseline=baseline))

    def metric_of(self, arm: ArmArrays) -> Metric:
        """The metric between the expert and an arm."""
        return Metric(arc_length_correspondence(self.expert_arrays, arm), self._weights)

    def learner_in(self, state: ArmState) -> ArmArrays:
        """The learner in a state."""
        return cast(AnyArmState, state).arm

    def metric_in(self, state: ArmState) -> Metric:
        """The metric between the expert and the learner in a state."""
        return self.metric_of(cast(AnyArmState, state).arm)

    def _simulate(
        self, before: ArmState, command: Float[Array, " numbers"]
    ) -> tuple[AnyArmState, Float[Array, " joints"]]:
        before = cast(AnyArmState, before)
        after = self._moved(before, command)
        if before.baseline is not None:
            after = dataclasses.replace(after, baseline=self._moved(before.baseline, jnp.zeros(self.action_size)))
        return self.with_plan(after), self.command(before, command)

    def _moved(self, before: AnyArmState, action: Float[Array, " actions"]) -> AnyArmState:
        """The state after a control step of constant torque, without its plan."""
        torque = self.command(before, action)
        qpos, qvel = self._advance(before.arm, before.qpos, before.qvel, torque)
        followed = chosen_goal(before.goals)
        return dataclasses.replace(before, qpos=qpos, qvel=qvel, step=before.step + 1, followed=followed)

    def _runaway_distance(self, state: ArmState) -> Float[Array, ""]:
        return _RUNAWAY * cast(AnyArmState, state).hold

    def _reward(
        self, before: ArmState, after: ArmState, distance: Float[Array, ""], excess: Float[Array, ""]
    ) -> Float[Array, ""]:
        before, after, other = cast(AnyArmState, before), cast(AnyArmState, after), cast(AnyArmState, after).baseline
        if other is None:
            return -distance / after.hold
        expert = self.expert_at(other.demonstration, other.step)
        baseline = self.metric_in(other)(expert, link_states(other.arm, other.qpos, other.qvel))
        baseline = jnp.where(self._is_runaway(other), self._runaway_distance(other), baseline)
        return relative_reward(distance, baseline, self._nearest(before), after.hold)

    def _nearest(self, before: AnyArmState) -> Float[Array, ""]:
        """The distance after the next step of an arm that is exactly in its goal, or in that of the baseline."""
        assert before.baseline is not None
        expert, metric = self.expert_at(before.demonstration, before.step + 1), self.metric_of(before.arm)
        goals = before.goals.goal, before.baseline.goals.goal
        own, baseline = (metric(expert, link_states(before.arm, goal.qpos, goal.qvel)) for goal in goals)
        return jnp.fmin(own, baseline)  # a baseline that ran away may be NaN, and must not end the training

    def command(self, before: ArmState, action: Float[Array, " actions"]) -> Float[Array, " joints"]:
        """The torque of an action [N m]."""
        state = cast(AnyArmState, before)
        return planned_torque(state.arm, state.plan, action, state.max_torque, self.config.control_dt)

    def restart_done(self, states: State) -> State:
        """Starts a new episode of a new arm for each arm of a batch whose episode is done."""
        arms = any_arm_state(states)
        arms = where_done(states.done, jax.vmap(self.start)(arms.key), arms)
        # Once for all: XLA removes the plans and observations of `step` and `start`, which nothing uses.
        arms = jax.vmap(self.with_plan)(arms)
        return states.replace(pipeline_state=arms, obs=jax.vmap(self.observe)(arms))

    def observe(self, state: ArmState) -> Float[Array, " observation"]:
        """The observation, see `mimic.envs.many_arms_observation.observe`."""
        state = cast(AnyArmState, state)
        expert = self.expert_at(state.demonstration, state.step + 1)
        expert = jax.tree.map(lambda x: x[: self.expert.num_links], expert)
        inputs = state.qpos, state.qvel, state.goals, state.max_torque, state.plan
        return observe(state.arm, expert, *inputs, self.config.control_dt)

    @property
    def observation_size(self) -> int:
        """Length of an observation."""
        return observation_size(self.expert.num_links)

    @property
    def action_size(self) -> int:
        """Length of an action: one number for each joint slot."""
        return MAX_JOINTS


def relative_reward(
    distance: Float[Array, ""], baseline: Float[Array, ""], nearest: Float[Array, ""], hold: Float[Array, ""]
) -> Float[Array, ""]:
    """The logarithm of the ratio of the baseline's excess over the nearest distance to that of the arm.

    Arms that are near their best motion and arms that are far from it count alike: with plain differences of the
    distance, a training follows the latter and does harm to the former.

    Args:
      distance: of the arm.
      baseline: of the same arm with zero actions since the start of the episode.
      nearest: of the nearest pose that is known.
      hold: of holding the home pose, the unit.
    """
    own, other = (jnp.maximum(x - nearest, 0.0) / hold + _EXCESS for x in (distance, baseline))
    return jnp.log(other / own)


def any_arm_state(state: State) -> AnyArmState:
    """The `AnyArmState` in a brax state, with its type."""
    return cast(AnyArmState, arm_state(state))
