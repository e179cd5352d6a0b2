"""Targets of mimic, and how far the results files of a folder reach them."""

import dataclasses
import json
import math
import statistics
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

Results = dict[str, Any]  # content of a results file
_FORMS = {"": "{:,.4g}", "%": "{:.2%}", "s": "{:,.1f} s", "mm": "{:.2f} mm"}


@dataclasses.dataclass(frozen=True)
class Target:
    """A quantity and the value to reach.

    Attributes:
      quantity: its label.
      backend: "gpu" or "cpu"; either if empty.
      benchmark: whose results files contain it.
      value: reads it from a file; raises a `LookupError`, `TypeError` or `ValueError` if the file does not contain it.
      target: what it must reach.
      unit: "", "%", "s" or "mm".
      is_minimum: whether larger is better.
    """

    quantity: str
    backend: str
    benchmark: str
    value: Callable[[Results], float]
    target: float
    unit: str = ""
    is_minimum: bool = True

    def met(self, value: float) -> bool:
        """Whether a value reaches the target."""
        return value >= self.target if self.is_minimum else value <= self.target

    def text(self, value: float) -> str:
        """A value with its unit."""
        return _FORMS[self.unit].format(value)


def rows(
    path: str, entry: str, reduce: Callable[[Iterable[float]], float] = max, **selected: Any
) -> Callable[[Results], float]:
    """Reads an entry of the rows with these values, leaving out rows that failed.

    Args:
      path: of the list of rows, with dots.
      entry: of a row, with dots; None counts as infinite, as a goal that was never reached.
      reduce: the value of several rows.
      selected: values of the rows.
    """

    def read(results: Results) -> float:
        chosen = [row for row in _entry(results, path) if "failed" not in row]
        chosen = [row for row in chosen if all(row.get(key) == value for key, value in selected.items())]
        return reduce([math.inf if (value := _entry(row, entry)) is None else value for row in chosen])

    return read


def _entry(values: Any, path: str) -> Any:
    for key in path.split("."):
        values = values[key]
    return values


def _beyond_jax(results: Results) -> float:
    jax, mimic = (rows("rows", "median_s", what=what)(results) for what in ("import jax", "import mimic"))
    return mimic - jax


def _tip(results: Results) -> float:
    (environment,) = (row for row in results["results"] if row["env"] == "panda7dof")
    return rows("candidates", "error_mm.end.p95", engine="fused", integrator="rk4", substeps=10)(environment)


_PAIRS = {"sweep": "batch", "method": "mimic"}
_PHYSICS = {"env": "panda7dof", "group": "physics", "case": "fused"}
_QUALITY = (
    ("7-DOF, one trajectory", "one_demonstration", "train", 0.01),
    ("7-DOF", "panda7dof", "train", 0.02),
    ("4-DOF", "panda4dof", "train", 0.03),
    ("3-DOF", "panda3dof", "train", 0.03),
    *((f"{arm[5]}-DOF, held out", arm, "held_out", 0.04) for arm in ("panda7dof", "panda4dof", "panda3dof")),
)


def _maximum(quantity: str, backend: str, benchmark: str, value: Any, target: float, unit: str = "s") -> Target:
    return Target(quantity, backend, benchmark, value, target, unit, is_minimum=False)


def _to_goal(start: str) -> Callable[[Results], float]:
    return rows("runs", "to_goal_s", statistics.median, case="one_demonstration", start=start)


TARGETS = (
    _maximum("import of mimic beyond jax", "cpu", "startup", _beyond_jax, 1.5),
    _maximum("mimic.train --help", "cpu", "startup", rows("rows", "median_s", what="mimic.train --help"), 3),
    Target("kernel, pairs/s", "gpu", "kernel", rows("results", "pairs_per_s", quantity="value", **_PAIRS), 10e9),
    Target(
        "kernel with gradient, pairs/s", "gpu", "kernel",
        rows("results", "pairs_per_s", quantity="gradient", **_PAIRS), 4e9,
    ),
    *(
        Target(
            f"physics of {arms} arms, steps/s", "gpu", "rollout", rows("rows", "steps_per_s", arms=arms, **_PHYSICS),
            target,
        )
        for arms, target in ((8192, 60e6), (65536, 100e6))
    ),
    _maximum("tip after 5 s, 95 of 100", "", "physics", _tip, 1.0, "mm"),
    Target("PPO with learning, env steps/s", "gpu", "ppo", rows("rows", "steps_per_s", case="mimic, fused"), 2e6),
    _maximum("to 2 % gap, cold", "gpu", "training", _to_goal("cold"), 20),
    _maximum("to 2 % gap, warm", "gpu", "training", _to_goal("warm"), 10),
    _maximum("to 2 % gap, cold", "cpu", "training", _to_goal("cold"), 180),
    Target(
        "optimal poses/s, slowest pair", "gpu", "pose", rows("results", "methods.newton.poses_per_second", min), 1e6
    ),
    *(
        _maximum("pose mapper within 2 %, slowest", backend, "pose_mapper", rows("runs", "to_goal_s", preset="large"), s)
        for backend, s in (("gpu", 10), ("cpu", 60))
    ),
    Target("PPO on 8 GPUs, efficiency", "gpu", "scaling", rows("rows", "efficiency", scaling="weak", devices=8), 0.9, "%"),
    *(
        _maximum(
            f"gap, {name}", "", "dynamic_imitation",
            rows(f"results.{case}", f"optimality_gap.{split}", statistics.fmean), goal, "%",
        )
        for name, case, split, goal in _QUALITY
    ),
)  # fmt: skip


def read_folder(folder: Path) -> dict[Path, Results]:
    """The results files of a folder, the newest last; other files are ignored."""
    files = {}
    for path in sorted(folder.glob("*.json")):
        try:
            results = json.loads(path.read_text())
        except ValueError:
            continue
        if isinstance(results, dict) and "benchmark" in results:
            files[path] = results
    return dict(sorted(files.items(), key=lambda entry: entry[1].get("date", "")))


def find(target: Target, files: dict[Path, Results]) -> tuple[float, Path] | None:
    """The value in the newest file that contains it, and that file."""
    for path, results in reversed(files.items()):
        backend = results.get("hardware", {}).get("backend")
        if results["benchmark"] == target.benchmark and target.backend in ("", backend):
            try:
                return float(target.value(results)), path
            except (LookupError, TypeError, ValueError):  # another case of the benchmark, or null
                continue
    return None


def table(files: dict[Path, Results], targets: Sequence[Target] = TARGETS) -> list[dict[str, str]]:
    """A row for each target with the file it was read from, or with the command that measures it."""
    shown = []
    for target in targets:
        goal = f"{'>=' if target.is_minimum else '<='} {target.text(target.target)}"
        row = {"quantity": target.quantity, "on": target.backend or "any", "target": goal}
        if (known := find(target, files)) is None:
            row |= {"measured": "-", "met": "", "from": f"python -m benchmarks.run {target.benchmark}"}
        else:
            met = "met" if target.met(known[0]) else "missed"
            row |= {"measured": target.text(known[0]), "met": met, "from": known[1].name}
        shown.append(row)
    return shown
