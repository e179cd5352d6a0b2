"""`python -m mimic.evaluate robot=virtual_panda`: a run's policy on virtual robots, and what makes them abort."""

import dataclasses
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import jax
import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from mimic.base.config import new_path
from mimic.commands.config import EvaluateConfig
from mimic.commands.printed import say
from mimic.deploy.bundle import MOTIONS
from mimic.deploy.safety import COLLISION, LATE, check_supported
from mimic.envs import env_config
from mimic.envs.world_env import HardwareEnv
from mimic.evaluation.evaluator import Evaluator
from mimic.evaluation.rollout_metrics import gaps
from mimic.evaluation.tracking_controllers import run_tracking
from mimic.evaluation.virtual_robot.arm_model import RobotModel, robot_model
from mimic.evaluation.virtual_robot.draws import draw_world, edge_cases
from mimic.evaluation.virtual_robot.episodes import Episodes, TrackingPolicy
from mimic.evaluation.virtual_robot.robots import LIMIT_CAUSES, SELF_CONTACT
from mimic.evaluation.virtual_robot.runs import Task, run_tasks
from mimic.metric.kinematics import link_state_table
from mimic.physics.world import WorldConfig
from mimic.retargeting.exact_chunks import by_chunks
from mimic.runs.checkpoints import check_checkpoint
from mimic.runs.files import write_report
from mimic.runs.provenance import hardware, versions
from mimic.trainers.config import TrainConfig
from mimic.trainers.ppo.trainer import PPOTrainer

ALL = "all ranges"
_CHUNK = 500  # episodes, at most, whose distances are computed together


def prepare_robot_evaluation(
    config: EvaluateConfig, trained: TrainConfig, trainer: Any, run_dir: Path
) -> Callable[[], None]:
    """Checks the config of an evaluation on virtual robots.

    Raises:
      ValueError: options that such an evaluation does not have, or a run whose robot is another one.
    """
    _check(config, trained)
    assert isinstance(trainer, PPOTrainer)
    out = new_path("out", config.out) if config.out else None
    steps = check_checkpoint(run_dir, config.checkpoint)
    own = cast(WorldConfig, trained.env.world)
    world = cast(WorldConfig, env_config("panda7dof", world=config.robot_world).world) if config.robot_world else own
    floor_height = own.floor_height  # where the robot stands, whatever its world is
    world, robot = dataclasses.replace(world, floor_height=floor_height), robot_model(trained.env.learner, floor_height)

    def run() -> None:
        console = Console()
        with tempfile.TemporaryDirectory(prefix="mimic-") as folder:
            policy = _bundle(trainer.evaluator, run_dir, steps, Path(folder))
            if config.controller == "tracking":
                policy = _tracking(trainer.evaluator, policy)
            cases = _cases(world, config)
            tasks = [_task(robot, policy, trainer.evaluator, case, config) for case in cases]
            results = _run(tasks, console)
        rows = {name: summary(trainer.evaluator, result) for (name, *_), result in zip(cases, results, strict=True)}
        report = {
            "robot": config.robot,
            "robot_loop": config.robot_loop,
            "run": config.run,
            "env": trained.env.name,
            "env_steps": steps,
            "control": trained.env.control,
            "controller": config.controller,
            **({"lead_ticks": policy.lead} if isinstance(policy, TrackingPolicy) else {}),
            "world": dataclasses.asdict(world),
            "cases": rows,
            "hardware": hardware(),
            "versions": versions(),
        }
        show(console, config.robot, rows)
        if out:
            out.mkdir()
            write_report(out, report)
            say(console, f"results: {config.out}")

    return run


def _check(config: EvaluateConfig, trained: TrainConfig) -> None:
    """Raises a `ValueError` for what virtual robots or the safety layer do not have."""
    if trained.trainer.name != "ppo" or trained.env.kind == "sampled_arms":
        raise ValueError(f"robot: expected a run of trainer=ppo with one learner, got env={trained.env.name} and "
                         f"trainer={trained.trainer.name}")  # fmt: skip
    if trained.env.kind != "inner_loop":
        raise ValueError("robot: expected a run with an inner loop, as of world=hardware, got one without")
    if config.robot == "virtual_panda" and trained.env.learner.model != "panda":
        raise ValueError("robot: expected virtual_robot for another learner than a Panda, got virtual_panda")
    check_supported(trained.env.control, trained.env.control_dt)


def _cases(world: WorldConfig, config: EvaluateConfig) -> list[tuple[str, WorldConfig, str]]:
    """Name, ranges and edge of each case."""
    cases = [(ALL, world, "")]
    return [*cases, *edge_cases(world)] if config.edges else cases


def _task(
    robot: RobotModel,
    policy: Path | TrackingPolicy,
    evaluator: Evaluator,
    case: tuple[str, WorldConfig, str],
    config: EvaluateConfig,
) -> Task:
    """The episodes of a case: the held-out motions in turn."""
    _, world, edge = case
    held_out = evaluator.parts["held_out"]
    first, count = held_out.start, evaluator.env.demonstrations.count - held_out.start
    motion = first + np.arange(config.episodes) % count
    drawn = draw_world(world, config.episodes, robot.num_joints, np.random.default_rng(config.seed), edge)
    return Task(
        robot, policy, drawn, motion, np.asarray(evaluator.env.start_poses)[motion], config.seed, config.robot_loop
    )


def _run(tasks: list[Task], console: Console) -> list[Episodes]:
    total = sum(len(task.motion) for task in tasks)
    with Progress(console=console, transient=True) as progress:
        bar = progress.add_task("episodes", total=total)
        return run_tasks(tasks, lambda count: progress.advance(bar, count))


def _bundle(evaluator: Evaluator, run_dir: Path, steps: int, folder: Path) -> Path:
    """The policy as a bundle, with the motions of the evaluation."""
    from mimic.trainers.export.export_controller import expert_table, prepare_controller

    bundle = folder / "bundle"
    prepare_controller(run_dir, steps)(bundle)
    count = evaluator.env.demonstrations.count
    np.savez(  # the motions of the evaluation, in its order
        bundle / MOTIONS,
        expert=expert_table(cast(HardwareEnv, evaluator.env)),
        start_poses=np.asarray(evaluator.env.start_poses, float),
        names=np.array([f"motion {i}" for i in range(count)]),
    )
    return bundle


def _tracking(evaluator: Evaluator, bundle: Path) -> TrackingPolicy:
    """The controller "tracking", with the best lead in the environment of the run."""
    _, lead = run_tracking(evaluator)
    return TrackingPolicy(bundle, np.asarray(evaluator.nearest_poses, float), lead)


def summary(evaluator: Evaluator, episodes: Episodes) -> dict[str, Any]:
    """The numbers of a case. The gap is that of `Evaluator`, over the motions of these episodes."""
    distance = _distances(evaluator, episodes)
    bound, hold = (x[episodes.motion].mean() for x in (evaluator.lower_bound, evaluator.hold_distance))
    aborts, stops = Counter(episodes.aborts.tolist()), Counter(episodes.stops.tolist())
    completed = (episodes.aborts == "") & (episodes.stops == "")
    return {
        "episodes": len(episodes.motion),
        "optimality_gap": float(gaps(distance.mean(), bound, hold)),
        "mean_distance": float(distance.mean()),
        "lower_bound": float(bound),
        "hold_distance": float(hold),
        "completed": int(completed.sum()),
        "aborts": {cause: count for cause, count in sorted(aborts.items()) if cause},
        "stops": {cause: count for cause, count in sorted(stops.items()) if cause},
        "limit_violations": sum(aborts[cause] for cause in LIMIT_CAUSES),
        "self_contacts": aborts[SELF_CONTACT],
        "interventions": {name: int(count.sum()) for name, count in episodes.interventions.items()},
        "episodes_with_interventions": {name: int((count > 0).sum()) for name, count in episodes.interventions.items()},
        "tracking_error": float(episodes.tracking_error.max()),
        "clearance": float(episodes.clearance.min()),
    }


def _distances(evaluator: Evaluator, episodes: Episodes) -> np.ndarray:
    """The embodiment distance after each tick, [episodes, ticks]."""
    env = evaluator.env
    distance = jax.jit(jax.vmap(jax.vmap(env.states_distance)))
    expert = jax.tree.map(lambda x: np.asarray(x)[:, 1 : env.config.horizon + 1], env.expert_states)

    def of_chunk(motion: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> tuple[jax.Array]:
        return (distance(jax.tree.map(lambda x: x[motion], expert), link_state_table(env.learner, qpos, qvel)),)

    motions = episodes.motion, episodes.qpos.astype(np.float32), episodes.qvel.astype(np.float32)
    return by_chunks(of_chunk, *motions, size=min(len(episodes.motion), _CHUNK))[0]


def show(console: Console, robot: str, rows: dict[str, dict[str, Any]]) -> None:
    """Prints a column of numbers for one case, and a row for each of several."""
    if len(rows) == 1:
        (row,) = rows.values()
        table = Table("", "", title=f"{row['episodes']:,} episodes on {robot}", show_header=False)
        for label, value in _lines(row):
            table.add_row(label, value)
    else:
        header = ("case", "episodes", "gap", "aborts", "stops", "rejected", "late", "clearance")
        table = Table(*header, title=f"each range of the world at its ends, on {robot}")
        for name, row in rows.items():
            aborts, stops = (sum(cast(dict[str, int], row[key]).values()) for key in ("aborts", "stops"))
            numbers = aborts, stops, row["interventions"][COLLISION], row["interventions"][LATE]
            clearance = f"{row['clearance'] * 1e3:.0f} mm"
            table.add_row(name, f"{row['episodes']:,}", f"{row['optimality_gap']:.2%}", *map(str, numbers), clearance)
    console.print(table)


def _lines(row: dict[str, Any]) -> Iterator[tuple[str, str]]:
    yield "optimality gap, held out", f"{row['optimality_gap']:.2%}"
    yield "episodes completed", f"{row['completed']:,}"
    yield "aborts of the robot", _counted(row["aborts"])
    yield "stops of the safety layer", _counted(row["stops"])
    yield "limit violations", str(row["limit_violations"])
    yield "self-contacts", str(row["self_contacts"])
    yield "interventions of the safety layer", _counted(row["interventions"])
    yield "largest tracking error", f"{row['tracking_error']:.3f} rad"
    if np.isfinite(row["clearance"]):
        yield "smallest clearance", f"{row['clearance'] * 1e3:.1f} mm"


def _counted(counts: dict[str, int]) -> str:
    return ", ".join(f"{cause} {count:,}" for cause, count in counts.items() if count) or "none"
