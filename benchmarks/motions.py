"""Gaps of policies, and of controllers without learning, on motions that no training has seen, kind by kind.

    python -m benchmarks.motions --out FILE --runs RUN [RUN ...] [--sets test new long] [--controllers NAME ...]

RUN is a run directory of `python -m mimic.train`; runs that differ in nothing but their seed are one policy.

- test: the test set of the runs' environment, `--count` motions of each kind.
- new: kinds that no training has. "circle": the hand draws a circle. "figure_eight": two joints move as sines of one
  and of two periods. "backwards": splines played backwards. "person": `--person FILE`, demonstrations of the runs'
  expert, from `python -m mimic.retarget`.
- long: 30 s of splines and of steps; the gap in the first and in the last 5 s.

"whole_motion" is not a controller but a search: the torques of the policy's first seed, improved by iLQR with the whole
motion and the exact dynamics known. It says how much of a gap there is to learn; better torques may exist.

`excess` is the mean distance above the bound [chain lengths], also where it saves too little over holding for a gap.
The interval is a 95 % hierarchical bootstrap over seeds and demonstrations. Centre line and hand are measures of
similarity that nothing optimises, in chain lengths: means over all motions of a set, of the first seed.
"""

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import mink
import numpy as np
from brax.envs.base import State

from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, collect
from mimic.arms.arm import Arm
from mimic.base.compilation import use_compilation_cache
from mimic.base.config import to_dict
from mimic.envs.arm_state import arm_state
from mimic.envs.config import EnvConfig
from mimic.envs.imitation import recorded_demonstrations, test_demonstrations
from mimic.evaluation.evaluator import Evaluator, Rollouts
from mimic.evaluation.predictive_controller import DAMPING, improved, problem
from mimic.evaluation.rollout_metrics import gap_interval, gaps
from mimic.metric.kinematics import LinkStates
from mimic.motions.demonstrations import Demonstrations, load_demonstrations
from mimic.motions.experts import KINDS
from mimic.runs.checkpoints import load_checkpoint
from mimic.trainers.config import PPOConfig, TrainConfig
from mimic.trainers.make import make_ppo_trainer
from mimic.trainers.ppo.trainer import PPOTrainer
from mimic.trainers.run_config import load_config

SETS = "test", "new", "long"
CONTROLLERS = "copy_joints", "pd", "computed_torque", "one_step", "nearest_pose", "mpc", "whole_motion"
COLUMNS = "env set kind controller gap:.2% low:.2% high:.2% seeds demonstrations centre_line:.4f hand:.3f"
LONG, WINDOW = 300, 50  # steps
RADIUS, PERIOD = 0.08, 4.0  # m and s, of the circle
AMPLITUDE = 0.4  # rad, of the figure of eight
ITERATIONS, CHUNK = 60, 64  # of iLQR for a whole motion; motions at a time


def circles(arm: Arm, count: int, horizon: int, dt: float) -> Demonstrations:
    """Demonstrations whose hand draws a circle around a random axis, one a period after a rest."""
    motions: list[np.ndarray] = []
    rng = np.random.default_rng(7)
    while len(motions) < count:
        path = _circle(arm, rng, horizon, dt)
        if np.all(np.abs(np.gradient(path, dt, axis=0)) <= arm.embodiment.velocity_limit):
            motions.append(path)
    return _from_paths(arm, np.array(motions), dt, "circle")


def _circle(arm: Arm, rng: np.random.Generator, horizon: int, dt: float) -> np.ndarray:
    """Joint angles [horizon + 1, joints] of one circle from a random pose."""
    model, home = arm.model, np.asarray(arm.embodiment.home)
    task = mink.FrameTask(model.nbody - 1, "body", position_cost=1.0, orientation_cost=0.1)
    posture = mink.PostureTask(model, 1e-3)
    ends = np.asarray(arm.embodiment.joint_range)[np.arange(len(home)), rng.integers(2, size=len(home))]
    start = home + rng.uniform(0.25, 0.45, len(home)) * (ends - home)
    configuration = mink.Configuration(model, start)
    frame = configuration.get_transform_frame_to_world(model.nbody - 1, "body")
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]  # random, orthogonal
    posture.set_target(start)
    path = [start]
    for step in range(1, horizon + 1):
        time = step * dt
        angle = 2 * np.pi * (time / PERIOD) * min(1.0, time / 1.0)  # from rest
        offset = RADIUS * (axes[0] * (np.cos(angle) - 1) + axes[1] * np.sin(angle))
        task.set_target(mink.SE3.from_rotation_and_translation(frame.rotation(), frame.translation() + offset))
        for _ in range(3):
            velocity = mink.solve_ik(configuration, [task, posture], dt, solver="daqp", damping=1e-4)
            configuration.integrate_inplace(velocity, dt)
        path.append(configuration.q.copy())
    return np.array(path)


def figures_of_eight(arm: Arm, count: int, horizon: int, dt: float) -> Demonstrations:
    """Demonstrations in which two joints move as sines of one and of two periods from the home pose."""
    time = np.arange(horizon + 1) * dt
    home, joints = np.asarray(arm.embodiment.home), arm.embodiment.num_joints
    motions = np.tile(home, (count, horizon + 1, 1))
    for index in range(count):
        rng = np.random.default_rng([8, index])
        first, second = rng.choice(joints, 2, replace=False)
        phase = 2 * np.pi * time / rng.uniform(3.0, 5.0)
        ramp = 1 - np.exp(-((time / 0.8) ** 2))
        motions[index, :, first] += AMPLITUDE * ramp * np.sin(phase)
        motions[index, :, second] += AMPLITUDE * ramp * np.sin(2 * phase) / 2
    return _from_paths(arm, motions, dt, "figure_eight")


def backwards(demonstrations: Demonstrations) -> Demonstrations:
    """The same motions, played backwards."""
    qpos, qvel = demonstrations.qpos[:, ::-1], -demonstrations.qvel[:, ::-1]
    kinds = ("backwards",) * demonstrations.count
    return dataclasses.replace(demonstrations, qpos=qpos, qvel=qvel, torque=None, kinds=kinds)


def _from_paths(arm: Arm, qpos: np.ndarray, dt: float, kind: str) -> Demonstrations:
    names = arm.embodiment.name, arm.embodiment.joint_names
    qvel = np.gradient(qpos, dt, axis=1)
    return Demonstrations(qpos, qvel, qpos[:, -1], dt, *names, kinds=(kind,) * len(qpos))


def motions(name: str, config: TrainConfig, count: int, person: Path | None) -> Iterator[Demonstrations]:
    """The sets of motions."""
    env, expert = config.env, config.env.build_arms().expert
    if name == "test":
        yield test_motions(env, count)
    elif name == "long":
        for kind in ("splines", "steps"):
            longer = dataclasses.replace(env, horizon=LONG)
            yield recorded_demonstrations(longer, expert, max(1, count // 8), kind=kind, test=True)
    else:
        few, horizon, dt = max(1, count // 4), env.horizon, env.control_dt
        yield backwards(recorded_demonstrations(env, expert, few, kind="splines", test=True))
        yield circles(expert, few, horizon, dt)
        yield figures_of_eight(expert, few, horizon, dt)
        if person is not None:
            loaded = load_demonstrations(person)
            yield dataclasses.replace(loaded, kinds=("person",) * loaded.count)


def rows(name: str, unseen: Demonstrations, policies: list[tuple[Path, TrainConfig]],
         controllers: list[str]) -> Iterator[Row]:  # fmt: skip
    """Rows of the policy of several seeds, and of each controller, on a set of motions."""
    run, config = policies[0]
    settings = dataclasses.replace(cast(PPOConfig, config.trainer), crossovers=0)  # none is evaluated
    config = dataclasses.replace(config, trainer=settings)
    trainer = make_ppo_trainer(config, run, unseen, None)
    evaluator = trainer.evaluator
    part = evaluator.parts["held_out"]
    kinds = np.array(evaluator.env.demonstrations.kinds)[part]
    windows = {"": slice(None)}
    if name == "long":
        windows = {", first 5 s": slice(0, WINDOW), ", last 5 s": slice(-WINDOW, None)}
    for controller in ("policy", *controllers):
        seeds = policies if controller == "policy" else policies[:1]
        if controller == "whole_motion":
            outcomes = [whole_motion(evaluator, trainer.evaluate(_params(trainer, run)))]
        else:
            outcomes = [trainer.run_controller(controller, _params(trainer, path))[0] for path, _ in seeds]
        similarity = {
            key: float(x[part].mean()) for key, x in evaluator.similarity(np.asarray(outcomes[0].qpos)).items()
        }
        distance = np.stack([np.asarray(outcome.distance)[part] for outcome in outcomes]).astype(float)
        bound, hold = evaluator.lower_bound[part].astype(float), evaluator.hold_distance[part].astype(float)
        for label, window in windows.items():
            for kind in dict.fromkeys(kinds.tolist()):
                of_kind = kinds == kind
                means = [x[..., of_kind, window].mean(axis=-1) for x in (distance, bound, hold)]
                gap, low, high = gap_interval(*means)
                mean, best, held = (float(x.mean()) for x in means)
                yield {
                    "env": config.env.name, "set": name, "kind": f"{kind}{label}", "controller": controller,
                    "gap": gap, "low": low, "high": high, "seeds": len(seeds), "demonstrations": int(of_kind.sum()),
                    "excess": mean - best, "excess_of_holding": held - best,
                    "largest": float(np.nanmax(_gaps(distance, bound, hold)[:, of_kind])),
                    "centre_line": similarity["centre_line_distance"], "hand": similarity["hand_position_error"],
                }  # fmt: skip


def whole_motion(evaluator: Evaluator, rollouts: Rollouts) -> Rollouts:
    """Rollouts whose torques are improved by iLQR over the whole motion."""
    env = evaluator.env
    advance, cost = problem(env, env.config.substeps)
    expert = jax.tree.map(lambda x: x[:, 1 : env.config.horizon + 1], env.expert_states)
    start = jnp.asarray(cast(Any, rollouts.start))
    still = jnp.concatenate([start, jnp.zeros_like(start)], axis=1)

    def of_motion(motion: tuple[Any, LinkStates, Any]) -> Any:
        first, shown, actions = motion
        weights = jnp.ones(len(actions))

        def iterate(carry: tuple[Any, Any], _: None) -> tuple[tuple[Any, Any], None]:
            before, damping = carry
            after = improved(advance, cost, first, shown, weights, damping, before)
            return (after, damping * jnp.where(jnp.all(after == before), 8.0, 0.5)), None

        return jax.lax.scan(iterate, (actions, jnp.asarray(DAMPING)), None, length=ITERATIONS)[0][0]

    motions = still, expert, rollouts.torque / env.torque_scale
    actions = jax.jit(lambda x: jax.lax.map(of_motion, x, batch_size=CHUNK))(motions)

    def play(state: State) -> Any:
        arm = arm_state(state)
        return actions[arm.demonstration, jnp.minimum(arm.step, actions.shape[1] - 1)]

    return jax.jit(lambda: evaluator.rollout(play))()


def _gaps(distance: np.ndarray, bound: np.ndarray, hold: np.ndarray) -> np.ndarray:
    """Gap of each motion [seeds, demonstrations]; NaN where holding the start pose is at the bound."""
    return gaps(distance.mean(axis=-1), bound.mean(axis=-1), hold.mean(axis=-1))


def _params(trainer: PPOTrainer, run: Path) -> object:
    return load_checkpoint(run, trainer.params_template(), None)[1]


def _key(config: TrainConfig) -> str:
    return json.dumps(to_dict(dataclasses.replace(config, seed=0, run_dir="")), sort_keys=True, default=str)


def policies_of(runs: list[Path]) -> list[list[tuple[Path, TrainConfig]]]:
    """Runs and configs of each policy: runs that differ in nothing but their seed are one."""
    groups: dict[str, list[tuple[Path, TrainConfig]]] = {}
    for run in runs:
        config = load_config(run)
        groups.setdefault(_key(config), []).append((run, config))
    return list(groups.values())


def test_motions(env: EnvConfig, count: int) -> Demonstrations:
    """The first motions of each kind of the test set."""
    return test_demonstrations(env).select(slice(0, count * len(KINDS)))


def main() -> None:
    parser = make_parser("motions", __doc__, sets=SETS, controllers=CONTROLLERS, count=640, person=Path)
    parser.add_argument("--runs", nargs="+", type=Path, required=True, metavar="RUN")
    options = parser.parse_args()
    use_compilation_cache("~/.cache/mimic/jax")

    def measured() -> Iterator[Row]:
        for policies in policies_of(options.runs):
            for name in options.sets:
                for unseen in motions(name, policies[0][1], options.count, options.person):
                    yield from rows(name, unseen, policies, options.controllers)

    collect(options, measured(), "rows", COLUMNS)


if __name__ == "__main__":
    main()
