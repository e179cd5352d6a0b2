"""Sweeps: their runs, the run directory of each, and the outcome of each.

Hydra's own sweeper stops at the first run that fails, and writes files before all runs are composed.
"""

import dataclasses
import itertools
import json
import os
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hydra.plugins.sweeper
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf

from mimic.base.config import check_writable
from mimic.base.config_files import check_references
from mimic.base.files import read_json
from mimic.base.overrides import setting, shell_words
from mimic.runs.files import CONFIG, REPORT
from mimic.runs.signals import exit_hook
from mimic.runs.sweeps.hydra_plugins import register, target

SWEEP, LOGS = "sweep.json", "logs"
FAILED = 1
MAX_RUNS = 1000  # each is composed before the first one starts, in a tenth of a second


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Outcome of a run: its exit code, and the reason in one line if that is not 0."""

    exit_code: int = 0
    reason: str = ""


@dataclasses.dataclass(frozen=True)
class PlannedRun:
    """A run of a sweep.

    Attributes:
      label: overrides that distinguish the run from the others.
      overrides: all overrides, including the run directory.
      run_dir: run directory; "" if the command has none.
    """

    label: str
    overrides: list[str]
    run_dir: str


@dataclasses.dataclass
class SweeperConf:
    """The default sweeper."""

    _target_: str = target("Sweeper")


class Sweeper(hydra.plugins.sweeper.Sweeper):
    """Runs every combination of the values. If runs failed, it prints one line for each and exits with 1."""

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """See Hydra's Sweeper."""
        self.hydra_context, self.config = hydra_context, config
        self.launcher: Launcher = Plugins.instance().instantiate_launcher(
            hydra_context=hydra_context, task_function=task_function, config=config
        )

    def sweep(self, arguments: list[str]) -> None:
        """Composes all runs, writes `SWEEP` into the folder of the sweep, launches, and prints the outcome of each.

        A folder with the same sweep continues it: runs with a report are done, others resume from their checkpoint.

        Raises:
          HydraException: a run that cannot be composed, or a folder with a sweep of other runs; nothing is written.
          SystemExit: with 1 if a run failed.
        """
        assert self.config is not None
        folder = Path(self.config.hydra.sweep.dir)
        check_writable("hydra.sweep.dir", folder)
        planned = self.plan(arguments, folder)
        remaining = _remaining(folder, planned)
        folder.mkdir(parents=True, exist_ok=True)
        OmegaConf.save(self.config, folder / "multirun.yaml")
        _write_sweep(folder, planned, [])
        try:
            with exit_hook(lambda _: _report_stop(folder)):
                returned = self.launcher.launch(list(remaining.values()), initial_job_idx=0) if remaining else []
        except SystemExit:
            _report_stop(folder)
            raise
        launched = dict(zip(remaining, (job.return_value for job in returned), strict=True))
        outcomes = [launched.get(number, Outcome()) for number in range(len(planned))]
        _write_sweep(folder, planned, outcomes)
        self._report(folder, planned, outcomes)

    def plan(self, arguments: list[str], folder: Path) -> list[PlannedRun]:
        """Composes the runs of a sweep; writes nothing.

        Raises:
          HydraException: a run cannot be composed, or several have one run directory.
        """
        assert self.config is not None and self.hydra_context is not None
        loader = self.hydra_context.config_loader
        parsed = OverridesParser.create(config_loader=loader).parse_overrides(arguments)
        _check_count(parsed)
        (combinations,) = BasicSweeper.split_arguments(parsed, max_batch_size=None)
        shared = set(combinations[0]).intersection(*combinations)
        width = len(str(len(combinations) - 1))
        runs = []
        for number, overrides in enumerate(combinations):
            config = loader.load_sweep_config(self.config, overrides)
            check_references(OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"]))
            run_dir, added = _run_dir(config, folder, f"{number:0{width}d}")
            label = " ".join(override for override in overrides if override not in shared)
            runs.append(PlannedRun(label or f"run {number}", [*overrides, *added], run_dir))
        counts = Counter(run.run_dir for run in runs if run.run_dir)
        for path in [path for path, count in counts.items() if count > 1]:
            raise HydraException(
                f"run_dir: expected a folder of its own for each run, got {path!r} for {counts[path]} of them; "
                "hydra.sweep.dir=DIR is the folder of a sweep"
            )
        return runs

    def _report(self, folder: Path, planned: Sequence[PlannedRun], outcomes: Sequence[Outcome]) -> None:
        failed = [(run, outcome) for run, outcome in zip(planned, outcomes, strict=True) if outcome.exit_code]
        print(f"sweep: {len(planned) - len(failed)} of {len(planned)} runs done; results: {folder}")
        if any(run.run_dir for run in planned) and len(failed) < len(planned):
            words = shell_words([setting("folder", str(folder))])
            print(f"one table and plot of them: python -m mimic.collect {words}")
        for run, outcome in failed:
            print(f"failed: {run.label}: {outcome.reason}", file=sys.stderr)
        if failed:
            sys.exit(FAILED)


def _report_stop(folder: Path) -> None:
    print(f"the sweep was stopped; its results so far: {folder}", file=sys.stderr)


def _check_count(overrides: Sequence[Override]) -> None:
    """Raises a HydraException if a sweep has too many runs; counted without listing them."""
    count = 1
    for override in overrides:
        if override.is_sweep_override():
            count *= sum(1 for _ in itertools.islice(override.sweep_iterator(), MAX_RUNS + 1))
    if count == 0:
        raise HydraException("expected at least 1 run in a sweep, got none")
    if count > MAX_RUNS:
        raise HydraException(f"expected at most {MAX_RUNS:,} runs in a sweep, got at least {count:,}")


def _run_dir(config: DictConfig, folder: Path, number: str) -> tuple[str, list[str]]:
    """Run directory of a run, and the override that sets it, unless the run sets it itself."""
    if OmegaConf.select(config, "run_dir") is None:
        return "", []
    for key in ("resume", "run_dir"):
        if config[key]:
            return config[key], []
    env, trainer = (OmegaConf.select(config, f"{group}.name") for group in ("env", "trainer"))
    path = str(folder / f"{number}-{env}-{trainer}-seed{config.seed}")
    return path, [setting("run_dir", path)]


def path_of(override: str) -> str:
    """The path in an override made by `setting`."""
    value = OverridesParser.create().parse_override(override).value()
    return str(getattr(value, "text", value))  # a quoted string has its text apart


def _remaining(folder: Path, planned: Sequence[PlannedRun]) -> dict[int, list[str]]:
    """By number, the overrides that start each run, or resume it if the folder has this sweep; none for runs done."""
    if not (folder / SWEEP).exists():
        return {number: run.overrides for number, run in enumerate(planned)}
    try:
        known = [entry["overrides"] for entry in read_json(folder / SWEEP)["runs"]]
    except (ValueError, LookupError, TypeError):
        known = []
    if known != [run.overrides for run in planned]:
        raise HydraException(
            f"hydra.sweep.dir: {str(folder)!r} has a sweep already, of other runs; name another folder"
        )
    return {
        number: _resumed(run)
        for number, run in enumerate(planned)
        if not run.run_dir or not (Path(run.run_dir) / REPORT).is_file()
    }


def _resumed(run: PlannedRun) -> list[str]:
    run_dir = Path(run.run_dir)
    if not run.run_dir or not (run_dir / CONFIG).is_file():
        return run.overrides
    of_process = [override for override in run.overrides if override.startswith(("compilation_cache=", "logger="))]
    return [setting("resume", run.run_dir), *of_process]


def _write_sweep(folder: Path, planned: Sequence[PlannedRun], outcomes: Sequence[Outcome]) -> None:
    """Writes the runs of a sweep, and what became of each where that is known."""
    runs = []
    for number, run in enumerate(planned):
        known = dataclasses.asdict(outcomes[number]) if number < len(outcomes) else {}
        entry: dict[str, Any] = {"label": run.label, "overrides": run.overrides}
        # Relative, so that the folder can be taken elsewhere.
        runs.append({**entry, "run_dir": run.run_dir and os.path.relpath(run.run_dir, folder), **known})
    (folder / SWEEP).write_text(json.dumps({"runs": runs}, indent=2) + "\n")


def register_sweeper() -> None:
    """Replaces Hydra's default sweeper by ours."""
    register(Sweeper, SweeperConf, "hydra/sweeper", "basic")
