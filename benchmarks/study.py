"""The study of all policies: those of the default settings, of unknown arms, by brax's loop, and of the paper.

    python -m benchmarks.study --runs DIR --out FILE [--preset paper] [--only GROUP ...] [--jobs N]

Trains each case by `python -m mimic.train -m` over its seeds, and evaluates runs by `python -m mimic.evaluate`, several
in parallel. Then other benchmarks measure the runs of some groups, each into a results file next to FILE. What DIR
contains is not repeated, so that an interrupted study can be continued. Prints the table of
`python -m mimic.collect DIR`, writes a results file, and figures next to it.
"""

import csv
import itertools
import json
import os
import sys
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import yaml

from benchmarks.common.parser import make_parser
from benchmarks.common.processes import run_parallel
from benchmarks.common.record import WIDTH, Row, write_results
from benchmarks.figures import study_figures
from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.named_arms import named_arms
from mimic.base.overrides import setting
from mimic.commands.collect.collect import prepare_collection
from mimic.commands.collect.finished_runs import find_runs
from mimic.commands.config import CollectConfig
from mimic.motions.recording import record_demonstrations
from mimic.runs.files import REPORT

STUDY = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text())
LOCKS = [locks for count in range(3, 7) for locks in itertools.combinations("1234567", count)]
UNSEEN_SEED, UNSEEN, UNSEEN_FILE = 1000, 32, "unseen.npz"  # demonstrations that no run is trained on


class Case(NamedTuple):
    """Training runs that differ only in their seed."""

    group: str
    name: str
    arguments: list[str]
    seeds: int

    def command(self, folder: Path) -> list[str]:
        """The sweep that trains them, each in folder/NAME/SEED."""
        seeds, sweep = ",".join(map(str, range(self.seeds))), folder / self.name
        paths = setting("run_dir", f"{sweep}/${{seed}}"), setting("hydra.sweep.dir", str(sweep))
        return [sys.executable, "-m", "mimic.train", "-m", *self.arguments, f"seed={seeds}", *paths]

    def done(self, folder: Path) -> bool:
        return all((folder / self.name / str(seed) / REPORT).is_file() for seed in range(self.seeds))


def cases(preset: str) -> list[Case]:
    extent = {**STUDY["presets"][preset], "locks": ",".join(map("+".join, LOCKS))}
    return [
        Case(group, name.format(**values), f"{settings} {arguments}".format(**extent, **values).split(), seeds)
        for group, named in STUDY["cases"].items()
        for settings in [f"{extent['arguments']} {extent['one_kind'] if group in STUDY['one_kind'] else ''}"]
        for seeds in [1 if group in STUDY["one_seed"] else extent["seeds"]]
        for name, arguments in named.items()
        for values in _values(name)
    ]


def _values(name: str) -> list[dict[str, str]]:
    """The values of the placeholder in a name."""
    if "{arm}" in name:
        return [{"arm": arm} for arm in STUDY["arms"]]
    if "{real}" in name:
        return [
            {"real": arm, "others": ",".join(other for other in STUDY["real"] if other != arm)} for arm in STUDY["real"]
        ]
    return [{}]


def evaluations(chosen: Sequence[Case], folder: Path) -> dict[Path, list[str]]:
    """Commands that evaluate policies on other demonstrations and arms, and other controllers, by their new folders."""
    seeds, commands = {case.name: case.seeds for case in chosen}, {}
    unseen = setting("demonstrations", str(folder / UNSEEN_FILE))
    for pattern, kinds in STUDY["evaluations"].items():
        for values in _values(pattern):
            name = pattern.format(**values)
            for kind, arguments in kinds.items():
                for seed in range(seeds.get(name, 0) if kind == "unseen" else min(seeds.get(name, 0), 1)):
                    run, out = folder / name / str(seed), folder / f"{name}--{kind}" / str(seed)
                    paths = setting("run", str(run)), setting("out", str(out))
                    overrides = [
                        unseen if argument == "{unseen}" else argument.format(**values)
                        for argument in arguments.split()
                    ]
                    commands[out] = [sys.executable, "-m", "mimic.evaluate", *paths, *overrides]
    return commands


def run(chosen: Sequence[Case], folder: Path, jobs: int) -> list[Path]:
    """Trains and evaluates what is not done yet; the logs of what failed."""
    devices = jax.device_count() if jax.default_backend() == "gpu" else 0
    logs = folder / "logs"
    logs.mkdir(exist_ok=True)
    sweeps = {logs / f"{case.name}.log": case.command(folder) for case in chosen if not case.done(folder)}
    failed = run_parallel(sweeps, jobs=jobs, devices=devices)
    commands = {}
    if not (folder / UNSEEN_FILE).is_file():
        record_demonstrations(build_arm(ArmConfig()), UNSEEN, kind="pid", seed=UNSEEN_SEED).save(folder / UNSEEN_FILE)
    for out, command in evaluations(chosen, folder).items():
        trained = folder / out.parent.name.partition("--")[0] / out.name
        if (trained / REPORT).is_file() and not (out / REPORT).is_file():
            out.parent.mkdir(exist_ok=True)
            commands[logs / f"{out.parent.name}-{out.name}.log"] = command
    return failed + run_parallel(commands, jobs=jobs, devices=devices)


def measurements(chosen: Sequence[Case], folder: Path, out: Path, count: int) -> dict[Path, list[str]]:
    """Commands that measure all runs of a group, by their new results files next to that of the study."""
    commands = {}
    for name, (benchmark, group, arguments) in STUDY["measurements"].items():
        cases_of_group = [case for case in chosen if case.group == group]
        runs = [str(folder / case.name / str(seed)) for case in cases_of_group for seed in range(case.seeds)]
        results = out.with_name(f"{name}_{out.stem.rpartition('_')[2]}.json")
        if runs and all(case.done(folder) for case in cases_of_group) and not results.is_file():
            options = *arguments.split(), "--count", str(count), "--out", str(results), "--runs", *runs
            commands[results] = [sys.executable, "-m", f"benchmarks.{benchmark}", *options]
    return commands


def collect(folder: Path) -> dict[str, list[Row]]:
    """The reports by case: `NAME` of the runs, `NAME--KIND` of their evaluations; a list over seeds."""
    results = defaultdict(list)
    for run in find_runs(folder)[0]:
        run_dir = folder / run.name
        report = json.loads((run_dir / REPORT).read_text())
        entry = {"seed": run.seed, **{key: report[key] for key in STUDY["entries"] if key in report}}
        if gaps := list(run.curves["train"].values()):
            entry |= {"best_gap": min(gaps), "final_gap": gaps[-1], "env_steps": report["env_steps"]}
        entry |= {key: report[key] for key in ("frequency_rad_s", "starts", "similarity") if report.get(key)}
        case = run_dir.parent.name
        curves = run_dir / "quality.csv"
        if case.partition("--")[0] in study_figures.CURVES and run.seed == 0 and curves.is_file():
            with curves.open(newline="") as file:
                rows = [row for row in csv.DictReader(file) if row.pop("split") == "held_out"]
            entry["curves"] = {key: [round(float(row[key]), 6) for row in rows] for key in rows[0]}
        results[case].append(entry)
    return dict(results)


def main() -> None:
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # the GPU is for the runs
    parser = make_parser("study", __doc__, only=STUDY["cases"], jobs=2, collect=False)
    parser.add_argument("--runs", type=Path, required=True, metavar="DIR", help="folder of the runs")
    parser.add_argument("--preset", choices=STUDY["presets"], default="paper")
    options = parser.parse_args()
    chosen = [case for case in cases(options.preset) if case.group in options.only]
    if missing := sorted(set(STUDY["real"]) - set(named_arms())):
        chosen = [case for case in chosen if case.group != "unseen_arms"]
        print(f"unseen_arms: left out, because this machine has no {', '.join(missing)}, see docs/own_arm.md")
    options.runs.mkdir(parents=True, exist_ok=True)
    failed = [] if options.collect else run(chosen, options.runs, options.jobs)
    if options.out and not options.collect:
        commands = measurements(chosen, options.runs, options.out, STUDY["presets"][options.preset]["count"])
        logs = {options.runs / "logs" / f"{results.stem}.log": command for results, command in commands.items()}
        failed += run_parallel(logs, jobs=1, devices=jax.device_count() if jax.default_backend() == "gpu" else 0)
    os.environ.setdefault("COLUMNS", str(WIDTH))  # also without a terminal
    prepare_collection(CollectConfig(str(options.runs)))()
    results = collect(options.runs)
    write_results(options, preset=options.preset, results=results)
    if options.out:
        study_figures.draw(results, options.out.with_suffix(""))
    if failed:
        sys.exit(f"error: {len(failed)} commands failed; logs: {', '.join(map(str, failed))}")


if __name__ == "__main__":
    main()
