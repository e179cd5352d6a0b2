"""The environment of a robot: targets of an inner loop at 1 kHz, and measurements with noise and delay."""

import copy
import dataclasses
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mimic.arms.arm import Arm
from mimic.control import joint_control
from mimic.control.joint_control import PERIOD, JointParameters, Reference
from mimic.envs.arm_state import ArmState
from mimic.envs.config import EnvConfig
from mimic.envs.imitation import ImitationEnv, observed_parts
from mimic.envs.seen_expert import SeenExpert, see
from mimic.envs.world_state import HardwareState
from mimic.metric.capsule_distances import colliding_pairs
from mimic.metric.kinematics import LinkStates, link_states
from mimic.motions.demonstrations import Demonstrations
from mimic.physics.inner_loop import LoopState, make_inner_loop
from mimic.physics.mjx_loop import MjxLoop, make_mjx_loop
from mimic.physics.mujoco_world import mujoco_world
from mimic.physics.plant import Draw, Plant, draw_episode, drawn_fractions, make_plant
from mimic.physics.step import PhysicsChoice
from mimic.physics.world import MAX_DELAY, WorldConfig

SENT_ACTIONS = 3  # that the policy observes: from them it tells how long its actions take
_DRAW, _START, _MEASURE, _LOSS, _EXPERT = 5, 6, 7, 8, 9  # folded into an episode's key, see mimic/envs/imitation.py


class HardwareEnv(ImitationEnv):
    """An `ImitationEnv` whose actions are targets of an inner loop, in a world with gravity, friction and delays.

    Reward and metrics are those of the true motion. The observation has the measured link states of the learner in
    place of the true ones, and then the angles and velocities of the reference, or the measured ones where actions are
    torques, and the last actions that were sent. With `world.history`, the measured motion of past ticks follows. With
    `world.expert` the expert's link states are measured ones too, see `see`.

    Args:
      config: see `EnvConfig`; of the kind "inner_loop".
      demonstrations: see `ImitationEnv`.

    Attributes:
      plant: the learner, as the inner loop simulates it.
      torque_scale: [joints] maximum torque [N m].
      parameters: of the inner loop, [joints] each.

    Raises:
      ValueError: arms, demonstrations or settings that do not fit.
    """

    def __init__(self, config: EnvConfig, demonstrations: Demonstrations | None = None):
        _check(config)
        super().__init__(config, demonstrations)
        if self.world.hidden_links[1] >= self.expert.num_links:
            raise ValueError(
                f"world.hidden_links: expected fewer than the expert's {self.expert.num_links} links, got "
                f"{self.world.hidden_links}"
            )

    @property
    def world(self) -> WorldConfig:
        """The world of the config."""
        assert self.config.world is not None, "checked by `_check`"
        return self.config.world

    def _set_physics(self, physics: PhysicsChoice) -> None:
        config, arm = self.config, self.arm
        self.physics, self.config = physics, dataclasses.replace(config, physics=physics.name)
        self.plant = plant_of(config, arm)
        make = self._make_fused_loop if physics.name == "fused" else self._make_mjx_loop
        waiting = round(self.world.action_latency / PERIOD)
        self._waiting_loop = make(waiting) if waiting else None
        self._acting_loop = make(round(config.control_dt / PERIOD) - waiting)
        parameters = self.plant.constants.parameters
        self.parameters = JointParameters(*(jnp.asarray(x, jnp.float32) for x in parameters))
        self.torque_scale = self.parameters.torque

    def _start_poses_of(self, demonstrations: Demonstrations) -> Float[np.ndarray, "demonstrations joints"]:
        """See `ImitationEnv`; within the joint ranges of the inner loop, which end before those of the robot."""
        lower, upper = np.asarray(self.parameters.lower), np.asarray(self.parameters.upper)
        return np.clip(super()._start_poses_of(demonstrations), lower, upper)

    def _make_mjx_loop(self, periods: int) -> MjxLoop:
        world = self.world
        capsules = self.capsules if world.contacts else None
        pairs = colliding_pairs(self.learner, capsules) if capsules else ()
        model = mujoco_world(self.arm, world, capsules, pairs)
        return make_mjx_loop(self.config.control, self.plant, model, periods)

    def _make_fused_loop(self, periods: int) -> MjxLoop:
        loop = make_inner_loop(self.config.control, self.plant.constants, periods)

        def run(draw: Draw, state: LoopState, target: Float[Array, " joints"]) -> LoopState:
            return loop(self.plant.episode(draw), state, target)

        return run

    def on_mjx(self) -> "HardwareEnv":
        """See `ImitationEnv`; without contacts, which take ten times as long and which the fused loop lacks too."""
        env = copy.copy(self)
        env.config = dataclasses.replace(self.config, world=dataclasses.replace(self.world, contacts=False))
        return cast(HardwareEnv, env.with_physics("mjx"))

    def start(self, key: Array, demonstration: Int[Array, ""] | int | None = None) -> HardwareState:
        """The first state of an episode: at rest near the start pose, which is also the reference."""
        state, joints = super().start(key, demonstration), self.learner.num_joints
        deviation = self.world.start_noise
        noise = jax.random.uniform(jax.random.fold_in(key, _START), (joints,), minval=-deviation, maxval=deviation)
        qpos = jnp.clip(state.qpos + noise, self.parameters.lower, self.parameters.upper) if deviation else state.qpos
        draw = draw_episode(self.world, joints, jax.random.fold_in(key, _DRAW))
        zero = jnp.zeros_like(qpos)
        actions = jnp.zeros((MAX_DELAY + 1, self.action_size))
        sent = jnp.zeros((max(SENT_ACTIONS, self.world.history), self.action_size))
        reference = Reference(qpos + draw.bias, zero, zero)  # where the arm seems to be
        fields = {field.name: getattr(state, field.name) for field in dataclasses.fields(state)}
        fields |= {"qpos": qpos, "reference": reference, "torque": zero, "draw": draw}
        measured = self._measure(LoopState(qpos, zero, reference, zero), draw, state.key, state.step)
        history = jnp.tile(measured, (MAX_DELAY + 1 + self.world.history, 1))
        target = reference.qpos if self.config.control == "joint_position" else zero  # the arm stays where it is
        return HardwareState(**fields, sent=sent, arrived=actions, target=target, measured=history)

    def _simulate(
        self, before: ArmState, command: Float[Array, " numbers"]
    ) -> tuple[HardwareState, Float[Array, " joints"]]:
        """See `ImitationEnv`; the torque is that of the last period."""
        state = cast(HardwareState, before)
        step = state.step + 1
        arrived = command
        if self.world.packet_loss:
            key_loss = jax.random.fold_in(jax.random.fold_in(state.key, _LOSS), step)
            is_lost = jax.random.uniform(key_loss) < self.world.packet_loss
            arrived = jnp.where(is_lost, state.arrived[0], command)
        history = _pushed(state.arrived, arrived)
        acting = history[state.draw.action_delay]
        loop = LoopState(state.qpos, state.qvel, state.reference, state.torque)
        loop, target = self.tick(state.draw, loop, state.target, acting)
        after = dataclasses.replace(
            state,
            qpos=loop.qpos,
            qvel=loop.qvel,
            step=step,
            reference=loop.reference,
            torque=loop.torque,
            sent=_pushed(state.sent, command),
            arrived=history,
            target=target,
            measured=_pushed(state.measured, self._measure(loop, state.draw, state.key, step)),
        )
        return after, loop.torque

    def tick(
        self, draw: Draw, loop: LoopState, before: Float[Array, " joints"], acting: Float[Array, " numbers"]
    ) -> tuple[LoopState, Float[Array, " joints"]]:
        """Arm and inner loop after a tick, and the target at its end.

        Args:
          draw: what is drawn for an episode; its delays have no effect here.
          loop: arm and inner loop before the tick.
          before: target at the end of the last tick.
          acting: the action that acts in this tick.
        """
        if self._waiting_loop is not None:
            loop = self._waiting_loop(draw, loop, before)
        target = joint_control.action_target(self.config.control, acting, loop.reference, self.parameters, jnp)
        return self._acting_loop(draw, loop, target), target

    def _measure(self, state: LoopState, draw: Draw, key: Array, step: Array) -> Float[Array, " numbers"]:
        """Measured angles and velocities, and those of the reference."""
        world, reference = self.world, state.reference
        is_torque = self.config.control == "torque"
        key = jax.random.fold_in(jax.random.fold_in(key, _MEASURE), step)
        noise = jax.random.normal(key, (2, len(state.qpos)))
        qpos = state.qpos + draw.bias + world.position_noise * noise[0]
        qvel = state.qvel + world.velocity_noise * noise[1]
        return jnp.concatenate([qpos, qvel, *((qpos, qvel) if is_torque else (reference.qpos, reference.qvel))])

    def privileged(self, state: ArmState) -> Float[Array, " numbers"]:
        """What only a critic observes: the elapsed time, what was drawn, and the true expert where it is measured."""
        draw = cast(HardwareState, state).draw
        fractions = drawn_fractions(draw, self.world)
        parts = [super().privileged(state), fractions]
        if self.world.expert != "exact":
            parts.append(expert_vector([self.expert_at(state.demonstration, state.step + 1)]))
        return jnp.concatenate(parts)

    def commanded_torque(
        self, before: ArmState, after: ArmState, action: Float[Array, " numbers"]
    ) -> Float[Array, " joints"]:
        """The torque of the last period [N m], in addition to gravity compensation."""
        del before, action
        return cast(HardwareState, after).torque

    def expert_at(self, demonstration: Array, step: Array) -> LinkStates:
        """See `ImitationEnv`; after the horizon the expert stays where it is, as in an exported controller."""
        return super().expert_at(demonstration, jnp.minimum(step, self.config.horizon))

    def seen_expert(self, state: ArmState, step: Array | int, ticks: int) -> SeenExpert:
        """The measured expert of an episode in some ticks from a step on, as the policy observes it."""
        steps = jnp.arange(ticks) + step
        states = jax.vmap(self.expert_at, (None, 0))(state.demonstration, steps)
        return see(self.world, states, jax.random.fold_in(state.key, _EXPERT), steps[0], self.config.control_dt)

    def command(self, before: ArmState, action: Float[Array, " numbers"]) -> Float[Array, " joints"]:
        """The target angles [rad], velocities [rad/s] or torques [N m] of an action that arrives at once."""
        reference = cast(HardwareState, before).reference
        return joint_control.action_target(self.config.control, action, reference, self.parameters, jnp)

    def observe(self, state: ArmState) -> Float[Array, " observation"]:
        """See the class, and `control_observation`."""
        state = cast(HardwareState, state)
        measured = state.measured[state.draw.observation_delay]
        if self.world.expert == "exact":
            ahead = range(self.config.preview + 1)
            expert = expert_vector([self.expert_at(state.demonstration, state.step + k) for k in ahead])
        else:
            expert = self.seen_expert(state, state.step, self.config.preview + 1).vector()
        observation = control_observation(self, measured, state.sent.ravel(), expert)
        if not self.world.history:
            return observation
        past = jax.lax.dynamic_slice_in_dim(state.measured, state.draw.observation_delay + 1, self.world.history)
        qpos, qvel, *_ = jnp.split(past, 4, axis=1)
        displacement = qpos - measured[: len(state.qpos)]  # of the order of its deviation, in contrast to the angles
        return jnp.concatenate([observation, displacement.ravel(), qvel.ravel()])


def plant_of(config: EnvConfig, arm: Arm) -> Plant:
    """The plant of an environment with an inner loop, see `make_plant`."""
    assert config.world is not None, "checked by `_check`"
    return make_plant(config.learner, arm, config.world, action_scale=config.action_scale, control_dt=config.control_dt)


def _check(config: EnvConfig) -> None:
    """Raises a ValueError for settings that such an environment does not have."""
    if config.world is None:
        raise ValueError("world: expected one, as world=nominal, got none")
    periods = config.control_dt / PERIOD
    if abs(periods - round(periods)) > 1e-6:
        raise ValueError(f"control_dt: expected a multiple of {PERIOD} s with an inner loop, got {config.control_dt}")
    latency = config.world.action_latency
    if abs(latency / PERIOD - round(latency / PERIOD)) > 1e-6 or latency >= config.control_dt:
        raise ValueError(
            f"world.action_latency: expected a multiple of {PERIOD} s below control_dt = {config.control_dt} s, got "
            f"{latency}"
        )
    if config.observation.terms:
        raise ValueError(f"observation.terms: expected none with an inner loop, got {config.observation.terms}")


def _pushed(history: Float[Array, "ticks numbers"], newest: Float[Array, " numbers"]) -> Float[Array, "ticks numbers"]:
    return jnp.concatenate([newest[None], history[:-1]])


def expert_vector(states: list[LinkStates]) -> Float[Array, " numbers"]:
    """Link states of the expert now and at the next ticks, as one vector."""
    return jnp.concatenate([part.ravel() for of_tick in states for part in observed_parts(of_tick)])


def control_observation(
    env: ImitationEnv,
    measured: Float[Array, " numbers"],
    past_actions: Float[Array, " actions"],
    expert: Float[Array, " expert"],
) -> Float[Array, " observation"]:
    """The observation of a policy of `HardwareEnv`, from what a controller knows.

    Args:
      env: the environment.
      measured: measured angles [rad] and velocities [rad/s], and those of the reference.
      past_actions: the last actions that were sent, the newest first.
      expert: see `expert_vector`, or `SeenExpert.vector` where the expert is measured.
    """
    qpos, qvel, reference_qpos, reference_qvel = jnp.split(measured, 4)
    own = observed_parts(link_states(env.learner, qpos, qvel))
    home = np.asarray(env.learner.home, np.float32)
    parts = [*(part.ravel() for part in own), expert, reference_qpos - home, reference_qvel, past_actions]
    return jnp.concatenate(parts)
