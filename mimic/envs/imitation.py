"""The imitation environment: a torque-controlled learner is rewarded for being like the expert."""

import copy
import dataclasses
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State
from flax import struct
from jaxtyping import Array, Float, Int

from mimic.arms.arm import Arm, build_arm, torque_scale
from mimic.arms.embodiment import Embodiment
from mimic.envs.config import EnvConfig
from mimic.envs.demonstrations import Demonstrations, check_effort, load_demonstrations
from mimic.envs.physics import Load, make_advance
from mimic.envs.recording import record_demonstrations
from mimic.metric.kinematics import LinkStates, link_state_table, link_states

# Of a limit, in rad or as a share of the rated speed: where nearness begins to cost, and how much further all it can.
_MARGIN, _FAR = 0.03, 0.1
# What is folded into an episode's key for its noise, and for the step that it starts at; 0 to 2 would give the keys
# that `start` splits it into.
_NOISE, FIRST_STEP = 3, 4


@struct.dataclass
class ArmState:
    """All that an episode carries.

    Attributes:
      qpos: learner's joint angles [rad].
      qvel: learner's joint velocities [rad/s].
      step: control steps since the demonstration began.
      demonstration: index of the one that is imitated.
      key: for the noise of this episode, and for later episodes.
      load: how the arm differs from its model in this episode; None where that is the same in all.
    """

    qpos: Float[Array, " joints"]
    qvel: Float[Array, " joints"]
    step: Int[Array, ""]
    demonstration: Int[Array, ""]
    key: Array
    load: Load | None = None


def arm_state(state: State) -> ArmState:
    """What an episode's brax state carries of the learner."""
    return cast(ArmState, state.pipeline_state)


class ImitationEnv(Env):
    """One learner imitating one of the demonstrations; a brax environment over MJX.

    Reward: minus the embodiment distance to the expert at the new step; with hardware limits, and minus `limit_weight`
    times `limit_excess`. Observation: link states of the learner, of the
    expert, and of the expert `preview` steps ahead, as one vector. Action: a torque for each joint in [-1, 1], scaled
    by `torque_scale`. The episode ends at the horizon, a true end: there is nothing to imitate after it.

    Args:
      config: see `EnvConfig`.
      demonstrations: what is imitated; the config's training demonstrations where None.

    Attributes:
      expert, learner: the embodiments.
      arm: the learner with the model that simulates it.
      metric: of the reward.
      demonstrations: what is imitated.
      expert_states: link states of the demonstrations, [demonstrations, time, links, 3] each.
      torque_scale: [joints] largest torque [N m].

    Raises:
      ValueError: arms or demonstrations that do not fit the config.
    """

    def __init__(self, config: EnvConfig, demonstrations: Demonstrations | None = None):
        self.config = config
        arms = config.build_arms()
        self.expert, self.learner = arms.embodiments
        self.metric = config.metric.build(self.expert, self.learner)
        self.arm = arms.learner
        self.torque_scale = jnp.asarray(torque_scale(self.arm, config.action_scale, config.control_dt))
        home = np.asarray(self.learner.home)
        self._home_states = link_state_table(self.learner, home, np.zeros_like(home))
        timestep = config.control_dt / config.substeps
        self._advance = make_advance(self.arm.model, timestep, config.substeps, config.physics)
        if demonstrations is None:
            demonstrations = training_and_held_out(config, arms.expert)[0]
        self._set_demonstrations(demonstrations)

    def with_demonstrations(self, demonstrations: Demonstrations) -> "ImitationEnv":
        """The same environment on other demonstrations."""
        env = copy.copy(self)
        env._set_demonstrations(demonstrations)
        return env

    def with_expert_states(self, states: LinkStates) -> "ImitationEnv":
        """The same environment on another copy of `expert_states`: inside a program, on what the program is given.

        What a program only finds here becomes a part of it, to compile and to keep with it.
        """
        env = copy.copy(self)
        env.expert_states = states
        return env

    def _set_demonstrations(self, demonstrations: Demonstrations) -> None:
        demonstrations.check_fits(self.expert, self.config.control_dt, self.config.horizon)
        self.demonstrations = demonstrations
        # Made once; `step` looks them up.
        table = link_state_table(self.expert, demonstrations.qpos, demonstrations.qvel)
        self.expert_states: LinkStates = jax.tree.map(jnp.asarray, table)

    def reset(self, rng: Array) -> State:
        """A new episode: the learner at rest in its home pose, a random demonstration from its first step."""
        return self.begin(self.start(rng))

    def begin(self, arm_state: ArmState) -> State:
        """An episode from what `start` gave."""
        zero = jnp.zeros(())
        metrics = {"distance": zero, "limit_excess": zero, "torque_saturation": zero, "runaway": zero}
        return State(arm_state, self.observe_home(arm_state), zero, zero, metrics, {})

    def start(self, key: Array, demonstration: Int[Array, ""] | int | None = None) -> ArmState:
        """The first state of an episode, of a random demonstration where none is named."""
        key_demonstration, key_load, key_next = jax.random.split(key, 3)
        if demonstration is None:
            demonstration = jax.random.randint(key_demonstration, (), 0, self.demonstrations.count)
        home = jnp.asarray(self.learner.home, jnp.float32)
        zero = jnp.zeros((), jnp.int32)
        demonstration = jnp.asarray(demonstration, jnp.int32)
        return ArmState(home, jnp.zeros_like(home), zero, demonstration, key_next, self._draw_load(key_load))

    def _draw_load(self, key: Array) -> Load | None:
        mass, damping = self.config.randomization.mass, self.config.randomization.damping
        if mass[0] == mass[1] and damping[0] == damping[1]:
            return None
        least, largest = (jnp.array(bounds) for bounds in zip(mass, damping, strict=True))
        return Load(*jax.random.uniform(key, (2,), minval=least, maxval=largest))

    def step(self, state: State, action: Float[Array, " joints"]) -> State:
        """Holds a torque for one control step."""
        before = arm_state(state)
        command = jnp.clip(action, -1.0, 1.0)
        step = before.step + 1
        randomization = self.config.randomization
        torque = command
        if randomization.torque_noise:
            key_noise = jax.random.fold_in(jax.random.fold_in(before.key, _NOISE), step)
            noise = jax.random.normal(key_noise, command.shape)
            torque = jnp.clip(command + randomization.torque_noise * noise, -1.0, 1.0)
        load = Load(randomization.mass[0], randomization.damping[0]) if before.load is None else before.load
        qpos, qvel = self._advance(before.qpos, before.qvel, torque * self.torque_scale, load)
        runaway = ~jnp.all(jnp.abs(qvel) < self.config.speed_bound)  # also where not a number
        remaining = (self.config.horizon - step).astype(jnp.float32)
        states = link_states(self.learner, qpos, qvel)
        expert_states = self.expert_at(before.demonstration, step)
        distance = jnp.where(runaway, self._worst_distance, self.states_distance(expert_states, states))
        excess = jnp.where(runaway, 1.0, self.limit_excess(qpos, qvel))
        steps = jnp.where(runaway, 1.0 + remaining, 1.0)  # as if it stayed this bad: ending early never pays
        done = (runaway | (step >= self.config.horizon)).astype(jnp.float32)
        after = dataclasses.replace(before, qpos=qpos, qvel=qvel, step=step)
        metrics = {
            **state.metrics,
            "distance": distance,
            "limit_excess": excess,
            "torque_saturation": jnp.any(jnp.abs(command) > 0.99).astype(jnp.float32),
            "runaway": runaway.astype(jnp.float32),
        }
        reward = -(distance + self.limit_penalty_weight * excess) * steps
        obs = self._seen(states, after)
        return state.replace(pipeline_state=after, obs=obs, reward=reward, done=done, metrics=metrics)

    def distance(
        self, qpos: Float[Array, " joints"], qvel: Float[Array, " joints"], demonstration: Array, step: Array
    ) -> Float[Array, ""]:
        """Embodiment distance of a learner's joint state to a demonstration at a step."""
        return self.states_distance(self.expert_at(demonstration, step), link_states(self.learner, qpos, qvel))

    def states_distance(self, expert_states: LinkStates, learner_states: LinkStates) -> Float[Array, ""]:
        """Embodiment distance of link states, in this environment's metric."""
        return self.metric(expert_states, learner_states)

    def limit_excess(self, qpos: Float[Array, " joints"], qvel: Float[Array, " joints"]) -> Float[Array, ""]:
        """How much joints are at or beyond their limits: 0 within a margin of them, 1 where all are far beyond."""
        lower, upper = jnp.asarray(self.learner.joint_range, jnp.float32).T
        position = jnp.maximum(qpos - upper, lower - qpos) + _MARGIN
        speed = jnp.abs(qvel) / jnp.asarray(self.learner.velocity_limit, jnp.float32) - 1 + _MARGIN
        return 0.5 * jnp.mean(jnp.clip(position / _FAR, 0, 1) + jnp.clip(speed / _FAR, 0, 1))

    @property
    def limit_penalty_weight(self) -> float:
        """What `limit_excess` counts for in the reward."""
        return self.config.limit_weight if self.config.limits == "hardware" else 0.0

    @property
    def _worst_distance(self) -> float:
        """What a runaway costs a step: all corresponding links opposite, at opposite ends of the workspace, at rest."""
        metric, n, n_hat = self.config.metric, self.expert.num_links, self.learner.num_links
        per_pair = np.pi * metric.rotation + 2 * metric.translation + 4 * metric.adaptive
        # No Frobenius norm is above the sum; the entries of hard and soft W sum up to n + n_hat.
        total = n + n_hat if callable(self.metric.correspondence) else np.asarray(self.metric.correspondence).sum()
        return float(per_pair * total / (n * n_hat if metric.reduction == "mean" else 1))

    def expert_at(self, demonstration: Array, step: Array) -> LinkStates:
        """The expert's link states at a step of a demonstration."""
        last = self.demonstrations.horizon
        return jax.tree.map(lambda table: table[demonstration, jnp.minimum(step, last)], self.expert_states)

    def observe(self, state: ArmState) -> Float[Array, " observation"]:
        """What the learner sees: its own link states, then the expert's now and at the steps ahead."""
        return self._seen(link_states(self.learner, state.qpos, state.qvel), state)

    def observe_home(self, state: ArmState) -> Float[Array, " observation"]:
        """The same of an arm at rest in its home pose: less to compute, and to compile."""
        return self._seen(self._home_states, state)

    def _seen(self, learner_states: LinkStates, state: ArmState) -> Float[Array, " observation"]:
        seen = [learner_states]
        seen += [self.expert_at(state.demonstration, state.step + ahead) for ahead in range(self.config.preview + 1)]
        return jnp.concatenate([leaf.ravel() for states in seen for leaf in jax.tree.leaves(states)])

    @property
    def observation_size(self) -> int:
        """Twelve numbers for each link that is seen."""
        return 12 * (self.learner.num_links + (self.config.preview + 1) * self.expert.num_links)

    @property
    def action_size(self) -> int:
        """One torque for each joint."""
        return self.learner.num_joints

    @property
    def backend(self) -> str:
        """What simulates."""
        return "mjx"


def observation_layout(expert: Embodiment, learner: Embodiment, preview: int) -> list[dict[str, Any]]:
    """What the numbers of an observation are: name, shape, unit, and where they start and stop."""
    units = {
        "position": "chain lengths",
        "direction": "1",
        "linear_velocity": "chain lengths/s",
        "angular_velocity": "rad/s",
    }
    seen = [("learner", learner), ("expert", expert)]
    seen += [(f"expert {ahead} steps ahead", expert) for ahead in range(1, preview + 1)]
    layout, start = [], 0
    for whose, arm in seen:
        for name, unit in units.items():
            stop = start + 3 * arm.num_links
            shape = [arm.num_links, 3]
            layout.append({"name": f"{whose}: {name}", "shape": shape, "unit": unit, "start": start, "stop": stop})
            start = stop
    return layout


def training_and_held_out(config: EnvConfig, expert: Arm | None = None) -> tuple[Demonstrations, Demonstrations]:
    """The demonstrations of a config, split: the first `count` are trained on, the next `held_out` are not.

    Raises:
      ValueError: a file that cannot be read, does not fit the expert, asks more of it than it can, or holds too few.
    """
    expert = expert or build_arm(config.expert, config.limits, config.metric.links)
    wanted = config.demonstrations
    if wanted.path:
        loaded = load_demonstrations(Path(wanted.path).expanduser())
        loaded.check_fits(expert.embodiment, config.control_dt, config.horizon)
        check_effort(loaded, expert.embodiment)
        if loaded.count < wanted.count + wanted.held_out:
            raise ValueError(
                f"demonstrations: {wanted.path!r} holds {loaded.count}, but count={wanted.count} to train on and "
                f"held_out={wanted.held_out} are asked for"
            )
    else:
        loaded = record_demonstrations(
            expert,
            wanted.count + wanted.held_out,
            kind=wanted.kind,
            seed=wanted.seed,
            horizon=config.horizon,
            dt=config.control_dt,
            substeps=config.substeps,
        )
    training = loaded.select(slice(0, wanted.count))
    held_out = loaded.select(slice(wanted.count, wanted.count + wanted.held_out))
    return training, held_out
