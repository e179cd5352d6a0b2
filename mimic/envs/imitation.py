"""The imitation environment: a torque-controlled learner is rewarded for its similarity to the expert."""

import mimic.base.quiet_mjx  # noqa: F401  # before brax

# isort: split
import copy
import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State
from jaxtyping import Array, Bool, Float, Int

from mimic.arms.arm import Arm, torque_scale
from mimic.arms.arrays import ArmArrays
from mimic.arms.capsules import Capsules, fit_capsules
from mimic.arms.drives import drives_of
from mimic.arms.embodiment import Embodiment
from mimic.base import compat, registry
from mimic.envs.arm_state import ArmState, arm_state
from mimic.envs.config import EnvConfig
from mimic.envs.start_poses import start_poses
from mimic.envs.terms import ObservationTerm, Transition, observation_terms, observed, reward_terms
from mimic.metric.capsule_distances import changing_pairs
from mimic.metric.distance import LinkDistance, Metric
from mimic.metric.kinematics import LinkStates, link_state_table, link_states
from mimic.motions.demonstrations import RECORDED_SPEED, Demonstrations, check_effort, load_demonstrations
from mimic.motions.experts import KINDS, MIXED
from mimic.motions.recording import record_demonstrations
from mimic.physics.step import PhysicsChoice, choose_physics, make_advance

# The limit penalty starts this margin inside a limit and is at its maximum a width further out; in rad for positions,
# as a fraction of the velocity limit for speeds.
_LIMIT_MARGIN, _LIMIT_WIDTH = 0.03, 0.1
# Folded into an episode's key for the step it starts at; 0 to 2 would give the keys that `start` splits the key into.
FIRST_STEP = 4
_FORESIGHT = 3, 6, 10  # steps ahead at which a critic knows the expert
TEST_SETS, TEST_COUNT = 5, 128  # demonstrations of each kind in a set


class ImitationEnv(Env):
    """One learner imitating one of the demonstrations; a brax environment.

    Reward: minus the embodiment distance to the expert after the step; with hardware limits also minus `limit_weight`
    times `limit_excess`. Observation: link states of the learner, of the expert now, and of the expert at each of the
    next `preview` steps, then the learner's joints, as one vector. Link states alone do not show the angles where two
    axes coincide, as those of a Panda's joints 1 and 3 where joint 2 is at 0. Action: a torque for each joint in
    [-1, 1], scaled by `torque_scale`. The episode terminates at the horizon, because there is nothing to imitate after
    it; this is no truncation.
    The config's `reward.terms` and `observation.terms` add to reward and observation.

    A subclass may override `observe`, as one vector of any length, and `start`: `reset`, `step` and `restart_done` call
    them.

    Args:
      config: see `EnvConfig`.
      demonstrations: motions to imitate; the config's training demonstrations where None.

    Attributes:
      config: the config; its `physics` is resolved, "mjx" or "fused".
      physics: the physics and the reason for it.
      embodiments: those of the expert and the learner.
      expert, learner: the same, without hands where the metric gives these no weight.
      arm: the learner with its simulation model.
      metric: metric of the reward.
      demonstrations: motions to imitate.
      held_out: the demonstrations of the config that are for evaluation; None where the motions were given.
      expert_states: link states of the demonstrations, [demonstrations, time, links, 3] each.
      start_poses: [demonstrations, joints] where the learner starts each demonstration, at rest [rad].
      reward_terms, observation_terms: the functions that the config adds to reward and observation.
      torque_scale: [joints] maximum torque [N m].

    Raises:
      ValueError: arms or demonstrations that do not fit the config.
    """

    def __init__(self, config: EnvConfig, demonstrations: Demonstrations | None = None):
        compat.mend_brax()  # here: brax's trainers take any environment, wrapped by any function
        self.config = config
        self.reward_terms = reward_terms(config.reward.terms)
        self.observation_terms = observation_terms(config.observation.terms)
        expert = self._set_arms()
        self.held_out: Demonstrations | None = None
        if demonstrations is None:
            demonstrations, self.held_out = training_and_held_out(config, expert)
        self._set_demonstrations(demonstrations)

    def _set_arms(self) -> Arm:
        """Sets the arms, the metric and the physics; returns the expert."""
        config = self.config
        arms = config.build_arms()
        self.embodiments = arms.embodiments
        self.expert, self.learner = map(config.metric.compared, arms.embodiments)
        self.metric = config.metric.build(self.expert, self.learner)
        self.arm = arms.learner
        self.torque_scale = jnp.asarray(torque_scale(self.arm, config.action_scale, config.control_dt))
        self._set_physics(choose_physics(config.physics, self.arm.model))
        return arms.expert

    def with_demonstrations(self, demonstrations: Demonstrations) -> "ImitationEnv":
        """The same environment on other demonstrations."""
        env = copy.copy(self)
        env._set_demonstrations(demonstrations)
        return env

    def with_horizon(self, horizon: int) -> "ImitationEnv":
        """The same environment with episodes of another length, see `Demonstrations.of_length`."""
        env = copy.copy(self)
        env.config = dataclasses.replace(self.config, horizon=horizon)
        env._set_demonstrations(self.demonstrations.of_length(horizon))
        return env

    def with_physics(self, physics: str) -> "ImitationEnv":
        """The same environment, simulated by "mjx" or "fused"."""
        env = copy.copy(self)
        env._set_physics(choose_physics(physics, self.arm.model))
        return env

    def on_mjx(self) -> "ImitationEnv":
        """The environment that cross-checks this one: simulated by MJX, an engine that is not ours."""
        return self.with_physics("mjx")

    def with_expert_states(self, states: LinkStates) -> "ImitationEnv":
        """The same environment with another array for `expert_states`: an argument of the function that JAX compiles.

        An array that a function takes from the environment itself becomes a constant of the compiled function.
        """
        env = copy.copy(self)
        env.expert_states = states
        return env

    def _set_physics(self, physics: PhysicsChoice) -> None:
        self.physics = physics
        config = self.config = dataclasses.replace(self.config, physics=physics.name)
        timestep = config.control_dt / config.substeps
        self._advance = make_advance(self.arm.model, timestep, config.substeps, physics.name)

    def _set_demonstrations(self, demonstrations: Demonstrations) -> None:
        demonstrations.check_fits(self.expert, self.config.control_dt, self.config.horizon)
        self.demonstrations = demonstrations
        # Computed once: `step` only looks them up.
        table = link_state_table(self.expert, demonstrations.qpos, demonstrations.qvel)
        self.expert_states: LinkStates = jax.device_put(table)
        self.start_poses = self._start_poses_of(demonstrations)

    def _start_poses_of(self, demonstrations: Demonstrations) -> Float[np.ndarray, "demonstrations joints"]:
        capsules = self.capsules if "self_collision" in self.config.reward.terms else None
        return start_poses(self.expert, self.learner, demonstrations.qpos[:, 0], self.metric.arguments, capsules)

    @functools.cached_property
    def capsules(self) -> Capsules:
        """Capsules around the links of the learner, fitted at the first access, see `fit_capsules`."""
        return fit_capsules(self.config.learner, self.config.limits)

    @functools.cached_property
    def changing_pairs(self) -> Bool[np.ndarray, " pairs"]:
        """Whether the joints change the distance of each of the capsules' pairs."""
        return changing_pairs(self.learner, self.capsules)

    def reset(self, rng: Array) -> State:
        """Starts an episode: a random demonstration at its first step, the learner at rest in its start pose."""
        return self.begin(self.start(rng))

    def begin(self, arm_state: ArmState) -> State:
        """The brax state of an episode that starts in a state of `start`."""
        zero = jnp.zeros(())
        metrics = {"distance": zero, "limit_excess": zero, "torque_saturation": zero, "runaway": zero}
        metrics |= {term.metric: zero for term in self.reward_terms}
        return State(arm_state, self.observe(arm_state), zero, zero, metrics, {})

    def start(self, key: Array, demonstration: Int[Array, ""] | int | None = None) -> ArmState:
        """The first state of an episode; the demonstration is random where None."""
        key_demonstration, key_next = jax.random.split(key)
        if demonstration is None:
            demonstration = jax.random.randint(key_demonstration, (), 0, self.demonstrations.count)
        demonstration = jnp.asarray(demonstration, jnp.int32)
        qpos = jnp.asarray(self.start_poses)[demonstration]
        zero = jnp.zeros((), jnp.int32)
        return ArmState(qpos, jnp.zeros_like(qpos), zero, demonstration, key_next)

    def at_step(self, state: ArmState, step: Int[Array, ""]) -> ArmState:
        """A state of `start` at another step of its demonstration."""
        return dataclasses.replace(state, step=step)

    def step(self, state: State, action: Float[Array, " numbers"]) -> State:
        """Advances an episode by one control step.

        Raises:
          ValueError: an action of another length.
        """
        if action.shape != (self.action_size,):
            raise ValueError(f"action: expected shape ({self.action_size},), got {action.shape}")
        before = arm_state(state)
        command = jnp.clip(action, -1.0, 1.0)
        after, torque = self._simulate(before, command)
        learner, qpos, qvel = self.learner_in(after), after.qpos, after.qvel
        runaway = self._is_runaway(after)
        states = link_states(learner, qpos, qvel)
        expert_states = self.expert_at(before.demonstration, after.step)
        distance = jnp.where(runaway, self._runaway_distance(after), self.metric_in(after)(expert_states, states))
        excess = jnp.where(runaway, 1.0, limit_excess(learner, qpos, qvel))
        # A runaway is charged its penalty for all remaining steps, so that ending an episode early is never better.
        remaining = (self.config.horizon - after.step).astype(jnp.float32)
        steps = jnp.where(runaway, 1.0 + remaining, 1.0)
        done = (runaway | (after.step >= self.config.horizon)).astype(jnp.float32)
        metrics = {
            **state.metrics,
            "distance": distance,
            "limit_excess": excess,
            "torque_saturation": jnp.any(jnp.abs(command) > 0.99).astype(jnp.float32),
            "runaway": runaway.astype(jnp.float32),
        }
        reward = self._reward(before, after, distance, excess) * steps
        transition = Transition(before, after, command, torque, states, expert_states)
        for term in self.reward_terms:
            value = jnp.where(runaway, -np.sign(term.weight), term.value(self, transition))
            metrics[term.metric] = value
            reward = reward + term.weight * value * steps
        obs = self._observe_states(after, states)
        return state.replace(pipeline_state=after, obs=obs, reward=reward, done=done, metrics=metrics)

    def learner_in(self, state: ArmState) -> Embodiment | ArmArrays:
        """The learner in a state: a constant, or what the state carries."""
        del state
        return self.learner

    def metric_in(self, state: ArmState) -> Metric:
        """The metric between the expert and the learner in a state."""
        del state
        return self.metric

    def _is_runaway(self, state: ArmState) -> Bool[Array, ""]:
        return ~jnp.all(jnp.abs(state.qvel) < self.config.speed_bound)  # True for NaN too

    def _runaway_distance(self, state: ArmState) -> Float[Array, ""] | float:
        """The distance charged for each step of a runaway."""
        del state
        return self._worst_distance

    def _reward(
        self, before: ArmState, after: ArmState, distance: Float[Array, ""], excess: Float[Array, ""]
    ) -> Float[Array, ""]:
        """The reward of a step that is no runaway, without `reward.terms`."""
        del before, after
        return -(distance + self.limit_penalty_weight * excess)

    def _simulate(
        self, before: ArmState, command: Float[Array, " numbers"]
    ) -> tuple[ArmState, Float[Array, " joints"]]:
        """The state after a control step of an action in [-1, 1], and the torque in it [N m], which is constant."""
        torque = command * self.torque_scale
        qpos, qvel = self._advance(before.qpos, before.qvel, torque)
        return dataclasses.replace(before, qpos=qpos, qvel=qvel, step=before.step + 1), torque

    def commanded_torque(
        self, before: ArmState, after: ArmState, action: Float[Array, " numbers"]
    ) -> Float[Array, " joints"]:
        """The torque that an action commands in the control step from one state to the next [N m]."""
        del after
        return self.command(before, action)

    def command(self, before: ArmState, action: Float[Array, " numbers"]) -> Float[Array, " joints"]:
        """What an action in [-1, 1] commands in a state: torques [N m]."""
        del before
        return action * self.torque_scale

    def privileged(self, state: ArmState) -> Float[Array, " numbers"]:
        """What only a critic observes: the elapsed fraction of the episode, and where the expert's links will be.

        Without the latter the advantages hold the differences between motions that begin alike.
        """
        future = [self.expert_at(state.demonstration, state.step + steps).position.ravel() for steps in _FORESIGHT]
        return jnp.concatenate([state.step[None] / self.config.horizon, *future])

    @property
    def privileged_size(self) -> int:
        """Length of `privileged`."""
        return jax.eval_shape(lambda: self.privileged(self.start(jax.random.PRNGKey(0)))).size

    def restart_done(self, states: State) -> State:
        """Starts a new episode, on a random demonstration, for each arm of a batch whose episode is done."""
        arms = arm_state(states)
        arms = where_done(states.done, jax.vmap(self.start)(arms.key), arms)
        # Once for all arms: XLA removes the observations of `step`, which nothing uses.
        return states.replace(pipeline_state=arms, obs=jax.vmap(self.observe)(arms))

    def distance(
        self, qpos: Float[Array, " joints"], qvel: Float[Array, " joints"], demonstration: Array, step: Array
    ) -> Float[Array, ""]:
        """Embodiment distance between a learner's joint state and a demonstration at a step."""
        return self.states_distance(self.expert_at(demonstration, step), link_states(self.learner, qpos, qvel))

    def states_distance(self, expert_states: LinkStates, learner_states: LinkStates) -> Float[Array, ""]:
        """Embodiment distance between link states, in this environment's metric."""
        return self.metric(expert_states, learner_states)

    @property
    def limit_penalty_weight(self) -> float:
        """Weight of `limit_excess` in the reward."""
        return self.config.limit_weight if self.config.limits == "hardware" else 0.0

    @property
    def _worst_distance(self) -> float:
        """Distance charged per step of a runaway: all corresponding links antiparallel, at opposite ends, at rest."""
        metric, n, n_hat = self.config.metric, self.expert.num_links, self.learner.num_links
        per_pair = np.pi * metric.rotation + 2 * metric.translation + 4 * metric.adaptive
        if isinstance(self.metric.weights, LinkDistance):
            with jax.ensure_compile_time_eval():
                per_pair = float(self.metric.weights.function(*_opposite_links()))
        # The Frobenius norm is at most the sum of the entries; those of hard and soft W sum to n + n_hat.
        total = n + n_hat if callable(self.metric.correspondence) else np.asarray(self.metric.correspondence).sum()
        of_links = per_pair * total / (n * n_hat if metric.reduction == "mean" else 1)
        hand = self.metric.hand_weights
        return float(of_links + np.pi * hand.rotation + 2 * hand.position)

    def expert_at(self, demonstration: Array, step: Array) -> LinkStates:
        """The expert's link states at a step of a demonstration."""
        last = self.demonstrations.horizon
        return jax.tree.map(lambda table: table[demonstration, jnp.minimum(step, last)], self.expert_states)

    def observe(self, state: ArmState) -> Float[Array, " observation"]:
        """The observation: the learner's link states, then the expert's now and at each of the next `preview` steps.

        Sines, cosines and velocities of the learner's joints follow, then the config's `observation.terms`.

        A subclass may override it: every observation of the environment is then the subclass's.
        """
        return self._link_observation(state, link_states(self.learner, state.qpos, state.qvel))

    @property
    def _has_own_observation(self) -> bool:
        """Whether `observe` is overridden, in a subclass or on this object."""
        return getattr(self.observe, "__func__", None) is not ImitationEnv.observe

    def _observe_states(self, state: ArmState, learner_states: LinkStates) -> Float[Array, " observation"]:
        """What `observe` returns; without an override it reuses the learner's link states, which are known."""
        return self.observe(state) if self._has_own_observation else self._link_observation(state, learner_states)

    def _link_observation(self, state: ArmState, learner_states: LinkStates) -> Float[Array, " observation"]:
        observed_states = [learner_states]
        observed_states += [
            self.expert_at(state.demonstration, state.step + ahead) for ahead in range(self.config.preview + 1)
        ]
        parts = [part.ravel() for states in observed_states for part in observed_parts(states)]
        parts += [jnp.sin(state.qpos), jnp.cos(state.qpos), state.qvel]
        return jnp.concatenate([*parts, *(observed(*term, self, state) for term in self.observation_terms)])

    @property
    def observation_size(self) -> int:
        """Length of an observation: numbers of each observed link and hand, and what terms or a subclass change.

        Raises:
          ValueError: the config names terms that a subclass does not observe.
        """
        if not (self._has_own_observation or self.observation_terms):
            return observation_layout(self.expert, self.learner, self.config.preview, {})[-1]["stop"]
        size, terms = _observed_size(self), self.config.observation.terms
        if terms and type(self).observe is not ImitationEnv.observe:
            without = copy.copy(self)
            without.observation_terms = []
            if size == _observed_size(without):
                raise ValueError(
                    f"observation.terms: expected none with {type(self).__name__}, whose observe() leaves them out, "
                    f"got {terms}"
                )
        return size

    @property
    def action_size(self) -> int:
        """Length of an action: one torque for each joint."""
        return self.learner.num_joints

    @property
    def backend(self) -> str:
        """Name of the physics backend, for brax."""
        return self.physics.name


def limit_excess(
    arm: Embodiment | ArmArrays, qpos: Float[Array, " joints"], qvel: Float[Array, " joints"]
) -> Float[Array, ""]:
    """Mean over joints of the excess over position and velocity limits, in [0, 1].

    It is 0 up to 0.03 rad, or 3 % of the velocity limit, before a limit, and 1 where all joints are 0.1 rad and 10 %
    further than that.
    """
    lower, upper = jnp.asarray(arm.joint_range, jnp.float32).T
    position = jnp.maximum(qpos - upper, lower - qpos) + _LIMIT_MARGIN
    speed = jnp.abs(qvel) / jnp.asarray(arm.velocity_limit, jnp.float32) - 1 + _LIMIT_MARGIN
    return 0.5 * jnp.mean(jnp.clip(position / _LIMIT_WIDTH, 0, 1) + jnp.clip(speed / _LIMIT_WIDTH, 0, 1))


def where_done(done: Float[Array, " batch"], new: Any, old: Any) -> Any:
    """The new values of the samples of a batch whose episode is done, and the old ones of the others."""
    is_done = done.astype(bool)

    def choose(new: Array, old: Array) -> Array:
        return jnp.where(is_done.reshape(done.shape + (1,) * (old.ndim - 1)), new, old)

    return jax.tree.map(choose, new, old)


def _opposite_links() -> tuple[LinkStates, LinkStates]:
    """Two links that are antiparallel, at opposite ends of the reach and at rest."""
    x, zero = jnp.array([[1.0, 0.0, 0.0]]), jnp.zeros((1, 3))
    links = LinkStates(x, x, zero, zero), LinkStates(-x, -x, zero, zero)
    return jax.tree.map(lambda leaf: leaf[0], links)


def env_class(config: EnvConfig) -> type[ImitationEnv]:
    """The class of an environment: `ImitationEnv`, or the registered class that the config names.

    Raises:
      ValueError: an unknown class.
    """
    if not config.environment:
        return ImitationEnv
    registered = registry.find("environment", config.environment, "environment")
    if not (isinstance(registered, type) and issubclass(registered, ImitationEnv)):
        raise ValueError(
            f"environment: {config.environment!r}: expected a subclass of ImitationEnv, got {registered!r}"
        )
    return registered


def _observed_size(env: ImitationEnv) -> int:
    return jax.eval_shape(lambda: env.observe(env.start(jax.random.PRNGKey(0)))).size


def observed_parts(states: LinkStates) -> list[Array]:
    """The parts of an arm's states in an observation, in order; batch axes come first.

    Of a hand these are its x- and z-axes: its position, its velocity and its y-axis follow from them and the last link.
    """
    parts = [values for name, values in vars(states).items() if name != "hand" and values is not None]
    if states.hand is None:
        return parts
    axes = states.hand.axes
    return [*parts, axes.reshape(*axes.shape[:-2], -1, 3, 3)[..., ::2, :]]


def observation_layout(
    expert: Embodiment, learner: Embodiment, preview: int, terms: Mapping[str, int]
) -> list[dict[str, Any]]:
    """The parts of an observation, in order: name, shape, unit, and the indices where they start and stop.

    Args:
      expert: whose links are observed.
      learner: whose links and joints are observed.
      preview: see `EnvConfig`.
      terms: length of each observation term by its name.
    """
    observed = [("learner", learner), ("expert", expert)]
    observed += [(f"expert {ahead} steps ahead", expert) for ahead in range(1, preview + 1)]
    parts = []
    for arm_name, arm in observed:
        of_links = ("position", "chain lengths"), ("direction", "1")
        of_links += ("linear_velocity", "chain lengths/s"), ("angular_velocity", "rad/s")
        parts += [(f"{arm_name}: {name}", [arm.num_links, 3], unit) for name, unit in of_links]
        if arm.hand_joint:
            parts.append((f"{arm_name}: hand x- and z-axes", [2 * len(arm.hand_joint), 3], "1"))
    of_joints = ("sines of the angles", "1"), ("cosines of the angles", "1"), ("joint velocities", "rad/s")
    parts += [(f"learner: {name}", [learner.num_joints], unit) for name, unit in of_joints]
    parts += [(f"term: {name}", [size], "") for name, size in terms.items()]
    return _laid_out(parts)


def _laid_out(parts: Sequence[tuple[str, list[int], str]]) -> list[dict[str, Any]]:
    """Parts of names, shapes and units that follow each other, as in `observation_layout`."""
    layout, start = [], 0
    for name, shape, unit in parts:
        stop = start + math.prod(shape)
        layout.append({"name": name, "shape": shape, "unit": unit, "start": start, "stop": stop})
        start = stop
    return layout


def layout_of(env: ImitationEnv) -> list[dict[str, Any]]:
    """The parts of an environment's observation, as in `observation_layout`, or the one part of its own class."""
    if env._has_own_observation:
        return _laid_out([(f"observation of {type(env).__name__}", [env.observation_size], "")])

    def size(name: str, term: ObservationTerm) -> int:
        return jax.eval_shape(lambda: observed(name, term, env, env.start(jax.random.PRNGKey(0)))).size

    terms = {name: size(name, term) for name, term in env.observation_terms}
    return observation_layout(env.expert, env.learner, env.config.preview, terms)


def training_and_held_out(config: EnvConfig, expert: Arm | None = None) -> tuple[Demonstrations, Demonstrations]:
    """The demonstrations of a config: the first `count` are for training, the next `held_out` for evaluation.

    Raises:
      ValueError: a file or source that cannot be read, does not fit the expert, exceeds its limits, or has too few
        demonstrations.
    """
    expert = expert or config.build_arm("expert")
    settings = config.demonstrations
    if settings.path or settings.source:
        loaded, label = _demonstrations_of_others(config, expert)
        loaded.check_fits(expert.embodiment, config.control_dt, config.horizon)
        check_effort(loaded, expert.embodiment, RECORDED_SPEED if loaded.torque is None else 1.0)
        if loaded.count < settings.count + settings.held_out:
            held_out = math.ceil(loaded.count / 10)
            key = "env.demonstrations"
            raise ValueError(
                f"demonstrations: {label!r} has {loaded.count}, expected at least "
                f"count + held_out = {settings.count} + {settings.held_out}"
                + f"; as with {key}.count={loaded.count - held_out} {key}.held_out={held_out}"
                * (loaded.count > 1)
            )
    else:
        loaded = recorded_demonstrations(config, expert, settings.count + settings.held_out)
    training = loaded.select(slice(0, settings.count))
    held_out = loaded.select(slice(settings.count, settings.count + settings.held_out))
    return training, held_out


def recorded_demonstrations(
    config: EnvConfig,
    expert: Arm,
    count: int,
    *,
    kind: str = "",
    test: bool = False,
    on_recorded: Callable[[int], None] = lambda redrawn: None,
) -> Demonstrations:
    """Demonstrations of a config's expert in simulation, within the limits of its manufacturer.

    Args:
      config: the config.
      expert: its expert.
      count: number of demonstrations.
      kind: see `record_demonstrations`; that of the config where empty.
      test: whether they are of the test set.
      on_recorded: see `record_demonstrations`.
    """
    settings = config.demonstrations
    return record_demonstrations(
        expert,
        count,
        kind=kind or settings.kind,
        seed=0 if test else settings.seed,
        horizon=config.horizon,
        dt=config.control_dt,
        substeps=config.recording_substeps,
        max_acceleration=drives_of(config.expert, expert).limits.acceleration,
        test=test,
        on_recorded=on_recorded,
    )


def test_demonstrations(config: EnvConfig) -> Demonstrations:
    """The test set of a config: five sets of 128 demonstrations of each kind, from seeds that no other set has.

    Settings must not be chosen by it.

    Raises:
      ValueError: demonstrations that are not recorded, or an arm whose limits allow no goal.
    """
    settings = config.demonstrations
    if settings.path or settings.source:
        raise ValueError(
            f"split: expected none where the demonstrations are those of {settings.path or settings.source!r}, got "
            "test; demonstrations=FILE evaluates others"
        )
    expert = config.build_arm("expert")
    return recorded_demonstrations(config, expert, TEST_SETS * TEST_COUNT * len(KINDS), kind=MIXED, test=True)


def _demonstrations_of_others(config: EnvConfig, expert: Arm) -> tuple[Demonstrations, str]:
    """The demonstrations of a file or of a registered source, and its name."""
    settings = config.demonstrations
    if settings.path:
        return load_demonstrations(Path(settings.path).expanduser()), settings.path
    made = registry.find("demonstrations", settings.source, "demonstrations.source")(expert, config)
    if not isinstance(made, Demonstrations):
        raise ValueError(f"demonstrations: source {settings.source!r}: expected Demonstrations, got {made!r:.80}")
    return made, settings.source
