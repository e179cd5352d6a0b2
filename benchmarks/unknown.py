"""Policies and model-based controllers on an arm whose masses, load, friction and delay are unknown.

    python -m benchmarks.unknown --out FILE --runs RUN [RUN ...] --names NAME [NAME ...] [--sets NAME ...] [--count 64]

RUN is a run directory of `python -m mimic.train env=panda7dof world=unknown`; runs that differ in nothing but their
seed are one policy, named by `--names`. Each set of episodes has one of the world's ranges at full width and the others
as the data sheet says; "all" has all of them. The motions are the test set's, `--count` of each kind. Runs of
`env.world.expert=links` or `points` are measured with a noisy or partly hidden expert too.

The controllers are computed torque along the poses of the kinematic bound, which know the motion in advance. They
predict the state at which their torque will act, from the same measurements and actions that the policy observes, by a
model: that of the data sheet with a delay of one tick ("nominal"), the same with a correction by the mean difference
between the torques that were commanded and those that explain the measured motion of the last ticks ("observer"), or
the arm as it is drawn, with its delay ("true"). Where the expert is measured they know the measurements of the whole
motion in advance, and follow the expert's angles that explain them, see `estimated_angles`. Each has the best of
several frequencies on the training demonstrations.
"""

import argparse
import copy
import dataclasses
import functools
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State

from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, collect
from benchmarks.motions import policies_of, test_motions
from mimic.base.compilation import use_compilation_cache
from mimic.control.joint_control import Reference, friction_torque
from mimic.envs.imitation import arm_state
from mimic.envs.world_env import HardwareEnv
from mimic.envs.world_state import HardwareState
from mimic.evaluation.evaluator import Evaluator
from mimic.evaluation.rollout_metrics import gap_interval
from mimic.evaluation.tracking_controllers import best_setting, reference_motions
from mimic.metric.kinematics import LinkStates, link_states
from mimic.motions.demonstrations import Demonstrations
from mimic.physics import dynamics
from mimic.physics.inner_loop import LoopState
from mimic.physics.joint_numbers import NUMBERS, joint_of
from mimic.physics.plant import Draw
from mimic.physics.world import WorldConfig
from mimic.runs.checkpoints import load_checkpoint
from mimic.trainers.config import TrainConfig
from mimic.trainers.make import make_ppo_trainer
from mimic.trainers.ppo.trainer import PPOTrainer

Array = Any
FREQUENCIES = (2.0, 4.0, 6.0, 8.0)  # candidates [rad/s]
PRIOR, GAUSS_NEWTON_STEPS = 1e-3, 5  # weight of the tick before [1/rad^2]; angles change little in a tick
SMOOTHING = 3.0  # ticks, width of the local parabolas
COLUMNS = "env set controller gap:.2% low:.2% high:.2% seeds demonstrations frequency"
DATA_SHEET = WorldConfig(gravity=True, friction=[1.0, 1.0], action_delay=[1, 1], stops=True)
RANGES = {
    "none": (),
    "mass": ("link_mass",),
    "payload": ("payload", "payload_lever"),
    "compensation": ("gravity_error",),
    "friction": ("friction",),
    "delay": ("action_delay",),
    "noisy expert": ("expert_noise",),
    "hidden expert": ("expert_loss", "hidden_links"),
}


def worlds(trained: WorldConfig) -> Iterator[tuple[str, WorldConfig]]:
    """The world of each set: ranges of the training's world, the others as in the data sheet; without known ones."""
    unknown = {name for names in RANGES.values() for name in names}
    for set_name, ranges in RANGES.items():
        if ranges and all(getattr(trained, name) == getattr(DATA_SHEET, name) for name in ranges):
            continue
        known = {name: getattr(DATA_SHEET, name) for name in unknown.difference(ranges)}
        yield set_name, dataclasses.replace(trained, **known)
    yield "all", trained


def data_sheet(env: HardwareEnv) -> Draw:
    """The model that a controller has without measuring the arm."""
    ones, zero = jnp.ones(env.learner.num_joints), jnp.zeros(())
    delay = jnp.asarray(DATA_SHEET.action_delay[0])
    return Draw(ones, zero, zero, zero, ones, ones, 0 * ones, 0 * delay, delay)


def model_torque(env: HardwareEnv, draw: Draw, qpos: Array, qvel: Array, qacc: Array) -> Array:
    """The commanded torque that makes an acceleration by a model [N m]."""
    episode = env.plant.episode(draw)
    joints = [joint_of(episode.numbers[NUMBERS * i : NUMBERS * (i + 1)], i - 1) for i in range(len(qpos))]
    torque = jnp.stack(dynamics.inverse(joints, list(qpos), list(qvel), list(qacc), tuple(episode.base)))
    return (torque + friction_torque(qvel, episode.friction, env.plant.constants.friction_rate, jnp)) / episode.gain


def predicted(env: HardwareEnv, draw: Draw, episode: HardwareState) -> tuple[Array, Array]:
    """Angles and velocities at which the next action will act, by a model from the last measurement."""
    qpos, qvel, *_ = jnp.split(episode.measured[0], 4)
    still = Reference(qpos, 0 * qvel, 0 * qvel)
    before = 0 * qpos
    for age in reversed(range(max(env.world.action_delay))):  # the action that acts first is the oldest
        torque = episode.sent[jnp.minimum(age + 1, len(episode.sent) - 1)] * env.parameters.torque_scale
        after, _ = env.tick(draw, LoopState(qpos, qvel, still, torque), before, episode.sent[age])
        acts = age < draw.action_delay
        qpos, qvel = jnp.where(acts, after.qpos, qpos), jnp.where(acts, after.qvel, qvel)
    return qpos, qvel


def missing_torque(env: HardwareEnv, draw: Draw, episode: HardwareState) -> Array:
    """Mean torque of the last ticks that a model lacks to explain the measured motion [N m]."""
    ticks = len(episode.sent) - int(DATA_SHEET.action_delay[0])
    qpos, qvel, *_ = jnp.split(episode.measured[: ticks + 1], 4, axis=1)
    qacc = (qvel[:-1] - qvel[1:]) / env.config.control_dt
    middle_qpos, middle_qvel = ((x[:-1] + x[1:]) / 2 for x in (qpos, qvel))
    needed = jax.vmap(functools.partial(model_torque, env, draw))(middle_qpos, middle_qvel, qacc)
    commanded = episode.sent[int(DATA_SHEET.action_delay[0]) :] * env.parameters.torque_scale
    return (commanded - needed).mean(axis=0)


@jax.default_matmul_precision("highest")  # not TF32
def estimated_angles(env: HardwareEnv) -> Array:
    """Angles [demonstrations, ticks, joints] of the expert that explain what the episodes of an evaluation measure.

    Least squares of the visible positions, directions and hands at each tick, near the angles of the tick before; then
    local parabolas over time, in which a tick counts as much as it has visible links.
    """
    ticks = env.config.horizon + 1

    def of_tick(before: Array, measured: tuple[LinkStates, Array]) -> tuple[Array, Array]:
        states, visible = measured

        def residual(qpos: Array) -> Array:
            now = link_states(env.expert, qpos, jnp.zeros_like(qpos))
            terms = [visible[:, None] * (now.position - states.position)]
            if states.direction is not None and now.direction is not None:
                terms.append(visible[:, None] * (now.direction - states.direction))
            if states.hand is not None and now.hand is not None:  # of a roll, which no link shows
                terms.append(visible[-1] * (now.hand.axes - states.hand.axes))
            return jnp.concatenate([term.ravel() for term in terms])

        def improve(qpos: Array, _: None) -> tuple[Array, None]:
            slope, prior = jax.jacfwd(residual)(qpos), PRIOR * jnp.eye(len(qpos))
            gradient = slope.T @ residual(qpos) + PRIOR * (qpos - before)
            return qpos - jnp.linalg.solve(slope.T @ slope + prior, gradient), None

        qpos, _ = jax.lax.scan(improve, before, None, length=GAUSS_NEWTON_STEPS)
        return qpos, qpos

    def of_motion(demonstration: Array) -> Array:
        start = env.start(jax.random.fold_in(jax.random.PRNGKey(0), demonstration), demonstration)
        seen = env.seen_expert(start, 0, ticks)
        home = jnp.asarray(env.expert.home, jnp.float32)
        return smoothed(jax.lax.scan(of_tick, home, (seen.states, seen.visible))[1], seen.visible.sum(axis=1))

    return jax.jit(jax.vmap(of_motion))(jnp.arange(env.demonstrations.count))


def smoothed(values: Array, weights: Array) -> Array:
    """Values [ticks, numbers] of parabolas that are fitted around each tick."""
    time = jnp.arange(len(values), dtype=jnp.float32)

    def at(tick: Array) -> Array:
        powers = (time - tick)[:, None] ** jnp.arange(3)
        near = weights * jnp.exp(-(((time - tick) / SMOOTHING) ** 2) / 2)
        square = powers.T @ (near[:, None] * powers) + 1e-6 * jnp.eye(3)
        return jnp.linalg.solve(square, powers.T @ (near[:, None] * values))[0]

    return jax.vmap(at)(time)


def controllers(env: HardwareEnv) -> dict[str, Callable[[Array], Callable[[State], Array]]]:
    """Functions from a frequency to each controller."""
    known = env
    if env.world.expert != "exact":
        known = copy.copy(env)
        known.demonstrations = dataclasses.replace(env.demonstrations, qpos=np.asarray(estimated_angles(env), float))
    qpos, qvel = (jnp.asarray(x, jnp.float32) for x in reference_motions(known))
    nominal, dt = data_sheet(env), env.config.control_dt

    def make(name: str, frequency: Array) -> Callable[[State], Array]:
        def controller(state: State) -> Array:
            episode = cast(HardwareState, arm_state(state))
            model = episode.draw if name == "true" else nominal
            angles, velocities = predicted(env, model, episode)
            now = jnp.minimum(episode.step + model.action_delay, env.config.horizon - 1)
            motion, later = episode.demonstration, now + 1
            acceleration = (qvel[motion, later] - qvel[motion, now]) / dt
            error, rate_error = qpos[motion, now] - angles, qvel[motion, now] - velocities
            desired = acceleration + frequency**2 * error + 2 * frequency * rate_error
            torque = model_torque(env, model, angles, velocities, desired)
            if name == "observer":
                torque = torque + missing_torque(env, model, episode)
            return torque / env.parameters.torque_scale

        return controller

    return {name: functools.partial(make, name) for name in ("nominal", "observer", "true")}


def rows(options: argparse.Namespace) -> Iterator[Row]:
    """The rows of all sets."""
    groups = policies_of(options.runs)
    if len({cast(WorldConfig, policies[0][1].env.world).expert == "exact" for policies in groups}) > 1:
        sys.exit("error: --runs: expected runs of exact experts, or of measured ones, got both")
    histories = [cast(WorldConfig, policies[0][1].env.world).history for policies in groups]
    run, config = groups[int(np.argmax(histories))][0]
    unseen = test_motions(config.env, options.count)
    for set_name, world in worlds(cast(WorldConfig, config.env.world)):
        if set_name not in options.sets:
            continue
        for name, policies in zip(options.names, groups, strict=True):
            trainer = _trainer(*policies[0], world, unseen)
            params = [load_checkpoint(run, trainer.params_template(), None)[1] for run, _ in policies]
            distances = [np.asarray(trainer.evaluate(of_seed).distance) for of_seed in params]
            yield _row(set_name, name, trainer.evaluator, distances)
        evaluator = _trainer(run, config, world, unseen).evaluator
        for name, make in controllers(cast(HardwareEnv, evaluator.env)).items():
            rollouts, frequency = best_setting(evaluator, make, FREQUENCIES)
            yield {**_row(set_name, name, evaluator, [np.asarray(rollouts.distance)]), "frequency": frequency}


def _trainer(run: Path, config: TrainConfig, world: WorldConfig, unseen: Demonstrations) -> PPOTrainer:
    """The trainer of a run in another world, with what the run's policy observes."""
    trained = cast(WorldConfig, config.env.world)
    own = dataclasses.replace(world, history=trained.history, expert=trained.expert)
    changed = dataclasses.replace(config, env=dataclasses.replace(config.env, world=own))
    return make_ppo_trainer(changed, run, unseen, None)


def _row(set_name: str, controller: str, evaluator: Evaluator, distances: list[Array]) -> Row:
    part = evaluator.parts["held_out"]
    distance = np.stack([x[part].mean(axis=1, dtype=float) for x in distances])
    bound, hold = (x[part].mean(axis=1, dtype=float) for x in (evaluator.lower_bound, evaluator.hold_distance))
    gap, low, high = gap_interval(distance, bound, hold)
    env = evaluator.env.config.name
    numbers = {"gap": gap, "low": low, "high": high, "seeds": len(distance), "demonstrations": distance.shape[1]}
    return {"env": env, "set": set_name, "controller": controller, **numbers}


def main() -> None:
    """Measures and prints."""
    parser = make_parser("unknown", __doc__, sets=(*RANGES, "all"), count=64)
    parser.add_argument("--runs", nargs="+", type=Path, required=True, metavar="RUN")
    parser.add_argument("--names", nargs="+", required=True, metavar="NAME", help="of the policies, in order")
    options = parser.parse_args()
    use_compilation_cache("~/.cache/mimic/jax")
    collect(options, rows(options), "rows", COLUMNS)


if __name__ == "__main__":
    main()
