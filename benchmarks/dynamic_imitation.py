"""The paper's dynamic motion imitation, and what lies beyond it: every number of docs/dynamic_imitation.md.

    python -m benchmarks.dynamic_imitation --runs DIR --out FILE [--preset paper] [--only GROUP ...] [--jobs N]

Trains and evaluates every case as a user does, by `python -m mimic.train` and `python -m mimic.evaluate`, several at
once. What is in DIR is not done again, so that an interrupted study goes on where it was. Prints tables, writes a file
of results, and figures beside it.
"""

import argparse
import dataclasses
import itertools
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
from rich.console import Console

from benchmarks import study_results
from benchmarks.processes import Task, run_tasks
from benchmarks.record import write_results
from mimic.arms.arm import ArmConfig, build_arm
from mimic.envs.recording import KINDS, record_demonstrations
from mimic.metric.config import MetricConfig

ARMS = ("panda7dof", "panda4dof", "panda3dof")
_PAPER = ("metric=paper", "env.preview=0", "trainer.discounting=0.4", "trainer.crossovers=0")
_ONE = ("env=panda7dof", "env.demonstrations.count=1")
_RANDOM = (
    "env.randomization.mass=[0.8,1.2]",
    "env.randomization.damping=[0.8,1.2]",
    "env.randomization.torque_noise=0.1",
)
_LOADS = {
    "nominal": ("mass=1", "damping=1", "torque_noise=0"),
    "mass-20": ("mass=0.8", "damping=1", "torque_noise=0"),
    "mass+20": ("mass=1.2", "damping=1", "torque_noise=0"),
    "damping-20": ("mass=1", "damping=0.8", "torque_noise=0"),
    "damping+20": ("mass=1", "damping=1.2", "torque_noise=0"),
    "noise10": ("mass=1", "damping=1", "torque_noise=0.1"),
}
_UNSEEN_SEED, _UNSEEN = 1000, 32  # demonstrations that no run has trained on, the same for all


@dataclasses.dataclass(frozen=True)
class Preset:
    """How much of it.

    Attributes:
      arguments: of all training runs.
      short: of the many runs of the sweeps, besides.
      seeds: of the paper's simulations.
    """

    arguments: tuple[str, ...]
    short: tuple[str, ...]
    seeds: int


PRESETS = {
    "paper": Preset(("env.physics=fused",), ("trainer.num_timesteps=30000000",), 3),
    # Of no value but to see that everything runs.
    "quick": Preset(
        (
            "env.physics=fused", "env.demonstrations.count=4", "env.demonstrations.held_out=2", "trainer.preset=cpu",
            "trainer.num_timesteps=20000", "trainer.num_envs=32", "trainer.batch_size=32", "trainer.num_minibatches=4",
            "trainer.evaluations=2", "trainer.crossovers=8",
        ),
        (), 1,
    ),
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Case:
    """Training runs that differ in their seed alone."""

    group: str
    name: str
    arguments: tuple[str, ...]
    seeds: int


def cases(preset: Preset) -> list[Case]:
    """Everything that is trained."""
    many, short = preset.seeds, preset.short
    learner = "env=panda7dof"
    locked = [*itertools.combinations(range(1, 8), 1), *itertools.combinations(range(1, 8), 2)]
    variants = {
        "preview0": ("env.preview=0",),
        "discount0.4": ("trainer.discounting=0.4",),
        "discount0.8": ("trainer.discounting=0.8",),
        "discount0.9": ("trainer.discounting=0.9",),
        "no_velocities": ("env.metric.linear_velocity=0", "env.metric.angular_velocity=0"),
        "no_positions": ("env.metric.translation=0",),
        "positions_x4": (f"env.metric.translation={4 * MetricConfig().translation}",),
        "velocities_x10": ("env.metric.linear_velocity=0.01", "env.metric.angular_velocity=0.1"),
        "adaptive": ("env.metric.adaptive=true",),
        "overlap": ("env.metric.correspondence=overlap",),
        "hard": ("env.metric.correspondence=hard",),
        "soft": ("env.metric.correspondence=soft",),
        "paper_metric": ("metric=paper",),  # links merged, W by overlap, directions and velocities
        "reference": (),
    }
    return [
        Case("simulations", "one_demonstration", (*_ONE, *short), many),
        Case("simulations", "panda7dof", ("env=panda7dof",), many),
        Case("simulations", "panda4dof", ("env=panda4dof",), many),
        Case("simulations", "panda3dof", ("env=panda3dof",), many),
        Case("paper_setting", "one_demonstration-paper", (*_ONE, *_PAPER, *short), many),
        *(Case("paper_setting", f"{arm}-paper", (f"env={arm}", *_PAPER, *short), many) for arm in ARMS),
        *(Case("given_only", f"{arm}-given", (f"env={arm}", "trainer.crossovers=0"), 1) for arm in ARMS),
        *(Case("hardware", f"{arm}-hardware", (f"env={arm}", "env.limits=hardware"), 1) for arm in ARMS),
        *(Case("reaches", f"{arm}-reach", (f"env={arm}", "env.demonstrations.kind=reach"), 1) for arm in ARMS),
        Case("loads", "panda4dof-random", ("env=panda4dof", *_RANDOM), 1),
        Case("mjx", "panda4dof-mjx", ("env=panda4dof", "env.physics=mjx", *short), 1),
        *(
            Case("variants", f"variant-{name}", ("env=panda4dof", *short, *change), 1)
            for name, change in variants.items()
        ),
        *(
            Case("locked", f"locked-{'-'.join(map(str, joints))}", (learner, *short, _locked(joints), _SCALE), 1)
            for joints in locked
        ),
    ]  # fmt: skip


_SCALE = "env.action_scale=2"  # between the 7-joint arm's and the 4-joint arm's


def _locked(joints: Sequence[int]) -> str:
    return f"env.learner.locked=[{','.join(map(str, joints))}]"


def training_tasks(chosen: Sequence[Case], preset: Preset, folder: Path) -> list[Task]:
    """One for each seed of each case."""
    return [
        Task(folder / f"{case.name}-{seed}", (*preset.arguments, *case.arguments, f"seed={seed}"))
        for case in chosen
        for seed in range(case.seeds)
    ]


def unseen_demonstrations(folder: Path) -> dict[str, Path]:
    """Files of demonstrations of each kind that no run is trained on."""
    files = {kind: folder / f"unseen-{kind}.npz" for kind in KINDS}
    for kind, path in files.items():
        if not path.exists():
            record_demonstrations(build_arm(ArmConfig()), _UNSEEN, kind=kind, seed=_UNSEEN_SEED).save(path)
    return files


def evaluation_tasks(chosen: Sequence[Case], folder: Path, unseen: Mapping[str, Path]) -> list[Task]:
    """The same policies on other demonstrations and arms, and other controllers in their place."""
    names = {case.name: case for case in chosen}
    tasks = []

    def evaluate(run: str, kind: str, *arguments: str) -> None:
        tasks.append(Task(folder / f"{run}--{kind}", arguments, of=folder / run))

    for name in ("one_demonstration", "panda7dof"):
        for seed in range(names[name].seeds) if name in names else ():
            evaluate(f"{name}-{seed}", "unseen", f"demonstrations={unseen['pd']}")
    for arm in ARMS:
        if arm in names:
            for controller in ("hold", "pd", "computed_torque"):
                evaluate(f"{arm}-0", controller, f"controller={controller}")
            evaluate(f"{arm}-0", "searched", "controller=searched")  # how near any torques come, as far as is known
            evaluate(f"{arm}-0", "mjx", "physics=mjx")
            evaluate(f"{arm}-0", "reaches", f"demonstrations={unseen['reach']}")
        if f"{arm}-reach" in names:
            evaluate(f"{arm}-reach-0", "goals", f"demonstrations={unseen['pd']}")
    for kind, load in _LOADS.items():
        for name in ("panda4dof", "panda4dof-random"):
            if name in names:
                evaluate(f"{name}-0", kind, *load)
        if "panda4dof" in names:
            evaluate("panda4dof-0", f"computed_torque-{kind}", "controller=computed_torque", *load)
    return tasks


def _arguments() -> argparse.Namespace:
    summary = (__doc__ or "").split("\n")[0]
    parser = argparse.ArgumentParser(prog="python -m benchmarks.dynamic_imitation", description=summary)
    parser.add_argument("--runs", type=Path, required=True, metavar="DIR", help="where the runs are, or go")
    parser.add_argument("--out", type=Path, metavar="FILE", help="file of results; figures go beside it")
    parser.add_argument("--preset", choices=PRESETS, default="paper")
    groups = sorted({case.group for case in cases(PRESETS["quick"])})
    parser.add_argument("--only", nargs="+", choices=groups, default=groups, metavar="GROUP", help=", ".join(groups))
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="processes on each device at once")
    parser.add_argument("--collect", action="store_true", help="run nothing more: results of what is there")
    parser.add_argument("--commit", help="what the results are of, where this is no git checkout")
    return parser.parse_args()


def main() -> None:
    """Trains, evaluates, and collects."""
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # the card is for the runs
    options = _arguments()
    preset = PRESETS[options.preset]
    chosen = [case for case in cases(preset) if case.group in options.only]
    options.runs.mkdir(parents=True, exist_ok=True)
    unseen = unseen_demonstrations(options.runs)
    tasks = [*training_tasks(chosen, preset, options.runs), *evaluation_tasks(chosen, options.runs, unseen)]
    devices = jax.device_count() if jax.default_backend() == "gpu" else 0
    failed = [] if options.collect else run_tasks(tasks, jobs=options.jobs, devices=devices)
    results = study_results.collect(options.runs)
    study_results.show(results, Console())
    if options.out:
        write_results(options.out, "dynamic_imitation", options.commit, preset=options.preset, results=results)
        study_results.draw(json.loads(options.out.read_text())["results"], options.out.with_suffix(""))
    if failed:
        raise SystemExit(
            f"error: {len(failed)} of {len(tasks)} runs failed: {', '.join(t.folder.name for t in failed)}"
        )


if __name__ == "__main__":
    main()
