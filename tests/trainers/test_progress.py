"""Progress bars at different widths of a terminal, and lines in pipes and notebooks."""

import io
import re
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from mimic.trainers import progress
from mimic.trainers.progress import TrainingProgress, report_table

STATUS = "distance 0.1139  gap 234.6%, held out 255.2%"


class Terminal(io.StringIO):
    """A file that says that it is a terminal."""

    def isatty(self):
        return True


def terminal(width):
    return Console(file=Terminal(), width=width, force_terminal=True, color_system=None)


def written(console):
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def final_lines(console):
    """What a terminal shows at the end."""
    frames = re.split(r"\r?\x1b\[2K(?:\x1b\[1A\x1b\[2K)*|\r", written(console))
    text = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", [frame for frame in frames if frame.strip()][-1])
    return [line.rstrip() for line in text.splitlines() if line.strip()]


@pytest.fixture
def clock(monkeypatch):
    """The time [s], which a test changes."""
    now = [1000.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    monkeypatch.delenv("JPY_PARENT_PID", raising=False)  # the tests may run in a notebook
    return now


@pytest.mark.parametrize("width", [40, 80, 200])
@pytest.mark.parametrize("total", [3_000_000, 150_000_000])
def test_a_bar_shows_everything_at_every_width(clock, width, total):
    console = terminal(width)
    with TrainingProgress(console, total) as bar:
        clock[0] += 3700
        bar.update(total // 3, STATUS, 17_400.0)
    shown = final_lines(console)
    assert all(len(line) <= width for line in shown) and "━" in shown[0]
    left = progress._duration((total - total // 3) / 17_400)
    text = " ".join(" ".join(shown).split())
    for part in (f"{total // 3:,}/{total:,}", "elapsed 1:01:40", f"left {left}", "17,400 steps/s", *STATUS.split("  ")):
        assert part in text


def test_the_remaining_time_counts_down_between_evaluations(clock):
    console = terminal(80)
    with TrainingProgress(console, 1000) as bar:
        clock[0] += 10
        bar.update(500, STATUS, 10.0)
        clock[0] += 20
    assert "elapsed 0:30  left 0:30" in final_lines(console)[1]


def test_a_bar_says_that_it_compiles(clock):
    console = terminal(80)
    with TrainingProgress(console, 1000):
        clock[0] += 5
    assert final_lines(console) == ["training  0/1,000  elapsed 0:05  compiling"]


def as_pipe(monkeypatch):
    """By FORCE_COLOR, which notebooks set, rich takes every file for a terminal."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    return Console(file=io.StringIO(), width=80)


def in_notebook(monkeypatch):
    """`!command` in a notebook runs in a pseudo-terminal."""
    monkeypatch.setenv("JPY_PARENT_PID", "1")
    return Console(file=Terminal(), width=80)


def on_dumb_terminal(monkeypatch):
    monkeypatch.setenv("TERM", "dumb")
    return Console(file=Terminal(), width=80, force_terminal=True)


@pytest.mark.parametrize("make_console", [as_pipe, in_notebook, on_dumb_terminal])
def test_without_a_terminal_there_is_a_line_for_compiling_and_each_evaluation(monkeypatch, clock, make_console):
    console = make_console(monkeypatch)
    assert console.is_terminal
    with TrainingProgress(console, 1000) as shown:
        for step in (0, 500, 1000):
            clock[0] += 60
            shown.update(step, STATUS, 10.0)
    assert written(console).splitlines() == [
        "compiling",
        f"step           0  {STATUS}  10 steps/s  elapsed 1:00  left 1:40",
        f"step         500  {STATUS}  10 steps/s  elapsed 2:00  left 0:50",
        f"step       1,000  {STATUS}  10 steps/s  elapsed 3:00  left 0:00",
    ]


def test_a_report_is_readable_in_80_columns():
    """Rows of a policy that has hardly learned are the longest."""
    rows = ["  kinematic bound (gap 0)", "0.1888", "0.1852"], ["worst", "53: 775%  36: 650%  30: 591%", "0: 1203%"]
    trainer: Any = SimpleNamespace(columns=("training", "held out"), rows=lambda metrics: rows, unit="env_steps")
    seconds = {"import": 2.3, "build": 11.6, "compile": 59.4, "train": 8.4, "evaluate": 7.4, "total": 93.7}
    report = {"env": "planar4dof", "trainer": "ppo", "seed": 0, "env_steps": 40960, "steps_per_second": 4902.0}
    console = Console(file=io.StringIO(), width=80)
    console.print(report_table({**report, "wall_time_s": seconds}, trainer))
    lines = written(console).splitlines()
    assert any("  kinematic bound (gap 0) " in line for line in lines)
    assert lines[-1].strip() == "seconds: import 2, build 12, compile 59, train 8, evaluate 7, total 94"
