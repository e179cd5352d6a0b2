"""What mimic is to reach, and what the files of results in a folder say of it."""

import dataclasses
import json
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

Results = dict[str, Any]  # a file of results
_FORMS = {"": "{:,.4g}", "%": "{:.2%}", "s": "{:,.1f} s", "mm": "{:.2f} mm"}


@dataclasses.dataclass(frozen=True)
class Target:
    """A quantity and what it is to be.

    Attributes:
      quantity: for people.
      backend: that it is measured on: "gpu" or "cpu"; any where empty.
      benchmark: whose files say it.
      measured: of a file; raises `LookupError` or `ValueError` where that does not hold it.
      target: what it is to reach.
      unit: "", "%", "s" or "mm".
      least: whether larger is better.
    """

    quantity: str
    backend: str
    benchmark: str
    measured: Callable[[Results], float]
    target: float
    unit: str = ""
    least: bool = True

    def met(self, measured: float) -> bool:
        """Whether it is reached."""
        return measured >= self.target if self.least else measured <= self.target

    def text(self, value: float) -> str:
        """With its unit."""
        return _FORMS[self.unit].format(value)


def _start(what: str, beyond: str | None = None) -> Callable[[Results], float]:
    """Seconds of a process, less those of another."""

    def seconds(results: Results) -> float:
        median = {row["what"]: row["median_s"] for row in results["rows"]}
        return median[what] - (median[beyond] if beyond else 0.0)

    return seconds


def _rows(results: Results, key: str, **wanted: Any) -> list[dict[str, Any]]:
    """Rows with these entries that were measured; at least one."""
    rows = [row for row in results[key] if "failed" not in row]
    rows = [row for row in rows if all(row.get(name) == value for name, value in wanted.items())]
    if not rows:
        raise LookupError(wanted)
    return rows


def _pairs(quantity: str) -> Callable[[Results], float]:
    wanted = {"sweep": "batch", "method": "mimic", "quantity": quantity}
    return lambda results: max(row["pairs_per_s"] for row in _rows(results, "results", **wanted))


def _physics(arms: int) -> Callable[[Results], float]:
    wanted = {"env": "panda7dof", "group": "physics", "case": "fused", "arms": arms}
    return lambda results: _rows(results, "rows", **wanted)[0]["steps_per_s"]


def _learning(results: Results) -> float:
    return _rows(results, "rows", case="mimic, fused")[0]["steps_per_s"]


def _to_goal(start: str) -> Callable[[Results], float]:
    def measured(results: Results) -> float:
        seconds = [row["to_goal_s"] for row in _rows(results, "runs", case="one_demonstration", start=start)]
        return statistics.median(float("inf") if value is None else value for value in seconds)

    return measured


def _poses(results: Results) -> float:
    return min(row["methods"]["newton"]["poses_per_second"] for row in _rows(results, "results"))


def _mapper(results: Results) -> float:
    """The slowest."""
    seconds = [row["to_goal_s"] for row in _rows(results, "runs", preset="large")]
    return max(float("inf") if value is None else value for value in seconds)


def _weak(devices: int) -> Callable[[Results], float]:
    wanted = {"scaling": "weak", "devices": devices}
    return lambda results: max(row["efficiency"] for row in _rows(results, "rows", **wanted))


def _tip(results: Results) -> float:
    candidates = _rows(results, "results", env="panda7dof")[0]
    return _rows(candidates, "candidates", engine="fused", integrator="rk4", substeps=10)[0]["error_mm"]["end"]["p95"]


def _gap(case: str, split: str) -> Callable[[Results], float]:
    return lambda results: statistics.fmean(run["optimality_gap"][split] for run in results["results"][case])


_QUALITY = (
    ("7-DOF, one trajectory", "one_demonstration", "train", 0.01),
    ("7-DOF", "panda7dof", "train", 0.02),
    ("4-DOF", "panda4dof", "train", 0.03),
    ("3-DOF", "panda3dof", "train", 0.03),
    *((f"{arm[5]}-DOF, held out", arm, "held_out", 0.04) for arm in ("panda7dof", "panda4dof", "panda3dof")),
)
TARGETS = (
    Target("import of mimic beyond jax", "cpu", "startup", _start("import mimic", "import jax"), 1.5, "s", least=False),
    Target("mimic.train --help", "cpu", "startup", _start("mimic.train --help"), 3, "s", least=False),
    Target("kernel, pairs/s", "gpu", "kernel", _pairs("value"), 10e9),
    Target("kernel with gradient, pairs/s", "gpu", "kernel", _pairs("gradient"), 4e9),
    Target("physics of 8192 arms, steps/s", "gpu", "rollout", _physics(8192), 60e6),
    Target("physics of 65536 arms, steps/s", "gpu", "rollout", _physics(65536), 100e6),
    Target("tip after 5 s, 95 of 100", "", "physics", _tip, 1.0, "mm", least=False),
    Target("PPO with learning, env steps/s", "gpu", "ppo", _learning, 2e6),
    Target("to 2 % gap, cold", "gpu", "training", _to_goal("cold"), 20, "s", least=False),
    Target("to 2 % gap, warm", "gpu", "training", _to_goal("warm"), 10, "s", least=False),
    Target("to 2 % gap, cold", "cpu", "training", _to_goal("cold"), 180, "s", least=False),
    Target("optimal poses/s, slowest pair", "gpu", "pose", _poses, 1e6),
    Target("pose mapper within 2 %, slowest", "gpu", "pose_mapper", _mapper, 10, "s", least=False),
    Target("pose mapper within 2 %, slowest", "cpu", "pose_mapper", _mapper, 60, "s", least=False),
    Target("PPO on 8 GPUs, efficiency", "gpu", "scaling", _weak(8), 0.9, "%"),
    *(
        Target(f"gap, {name}", "", "dynamic_imitation", _gap(case, split), goal, "%", least=False)
        for name, case, split, goal in _QUALITY
    ),
)


def read_folder(folder: Path) -> dict[Path, Results]:
    """All files of results in a folder, the newest last; what is none of them is left out."""
    found = {}
    for path in sorted(folder.glob("*.json")):
        try:
            results = json.loads(path.read_text())
        except ValueError:
            continue
        if isinstance(results, dict) and "benchmark" in results:
            found[path] = results
    return dict(sorted(found.items(), key=lambda entry: entry[1].get("date", "")))


def find(target: Target, files: dict[Path, Results]) -> tuple[float, Path] | None:
    """What the newest file that holds it says, and that file."""
    for path, results in reversed(files.items()):
        backend = results.get("hardware", {}).get("backend")
        if results["benchmark"] == target.benchmark and target.backend in ("", backend):
            try:
                return float(target.measured(results)), path
            except (LookupError, TypeError, ValueError):  # another case of it, or null
                continue
    return None


def table(files: dict[Path, Results], targets: Sequence[Target] = TARGETS) -> Table:
    """A row for each target, and which file says it; where none does, what makes one."""
    shown = Table("quantity", "on", "measured", "target", "", "from")
    for target in targets:
        goal = f"{'>=' if target.least else '<='} {target.text(target.target)}"
        found = find(target, files)
        if found is None:
            command = f"python -m benchmarks.run {target.benchmark}"
            shown.add_row(target.quantity, target.backend or "any", "-", goal, "", command)
            continue
        measured, path = found
        met = "met" if target.met(measured) else "missed"
        shown.add_row(target.quantity, target.backend or "any", target.text(measured), goal, met, path.name)
    return shown
