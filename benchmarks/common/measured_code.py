"""The code that a benchmark measures: hashes that its results keep, and the table of what has changed since."""

import functools
import hashlib
import io
import tokenize
from collections.abc import Mapping
from pathlib import Path

from benchmarks.common.cells import Cells, Results, device

PACKAGE = Path(__file__).resolve().parents[2] / "mimic"
# Folders of the package that numbers depend on, each above those that it imports, see tests/test_layers.py.
FOLDERS = (
    *("xml", "base", "control", "arms", "metric", "physics", "motions"),
    *("retargeting", "envs", "evaluation", "trainers", "conf"),
)
SUFFIXES = ".py", ".xml", ".yaml"  # of code and presets; the networks that come with mimic are neither
# Benchmarks that measure up to a folder; all others measure trained policies, and so all folders.
HIGHEST = {
    "hands": "arms",
    "kernel": "metric",
    **dict.fromkeys(
        ("bound", "exact_hands", "pose", "similarity", "teleoperation", "transfer", "transfer_throughput"),
        "retargeting",
    ),
    "physics": "envs",
}


def hashes(benchmark: str, package: Path = PACKAGE) -> dict[str, str]:
    """A hash of each folder that a benchmark measures, by name."""
    measured = FOLDERS[: FOLDERS.index(HIGHEST.get(benchmark, FOLDERS[-1])) + 1]
    return {name: hash_of(package / name) for name in measured if (package / name).is_dir()}


def changed_code(files: Mapping[str, Results]) -> list[Cells]:
    """The table of all results files: what they were measured on, and which folders have changed since."""
    rows: list[Cells] = [("file", "commit", "date", "hardware", "changed since")]
    for path, results in files.items():
        commit = results["commit"].partition(" ")[0][:8]
        now, name = hashes(results["benchmark"]), Path(path).name
        changed = [folder for folder in now if results.get("code", {}).get(folder) != now[folder]]
        text = "everything" if len(changed) == len(now) else ", ".join(changed) or "nothing"
        rows.append((f"[{name}]({name})", commit, results["date"][:10], device(results), text))
    return rows


@functools.cache
def hash_of(folder: Path) -> str:
    files = sorted(path for path in folder.rglob("*") if path.suffix in SUFFIXES and "networks" not in path.parts)
    texts = (f"{path.relative_to(folder).as_posix()}\n{_without_words(path)}\n" for path in files)
    return hashlib.sha256("".join(texts).encode()).hexdigest()[:8]


def _without_words(path: Path) -> str:
    """A file without comments, docstrings and blank lines, which change no number."""
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines()
    if path.suffix == ".py":
        before = tokenize.NEWLINE
        for token in tokenize.generate_tokens(io.StringIO(text).readline):
            is_statement = before in (tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT)
            if token.type == tokenize.COMMENT or (token.type == tokenize.STRING and is_statement):
                (first, column), (last, _) = token.start, token.end
                lines[first - 1 : last] = [lines[first - 1][:column], *[""] * (last - first)]
            if token.type not in (tokenize.COMMENT, tokenize.NL):
                before = token.type
    return "\n".join(line.rstrip() for line in lines if line.strip())
