"""What `python -m mimic.demonstrations` does: records an expert or reads motions, plots them, says what they take."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from mimic.arms.arm import Arm, build_arm
from mimic.arms.embodiment import Embodiment
from mimic.commands.config import RecordingConfig
from mimic.commands.demonstrations_plot import peak, plot_demonstrations, with_share
from mimic.config import new_file
from mimic.envs.config import EnvConfig
from mimic.envs.demonstrations import Demonstrations, check_effort
from mimic.envs.importing import import_demonstrations
from mimic.envs.recording import record_demonstrations

_PLOT_SUFFIXES = (".png", ".pdf", ".svg")


def prepare_recording(config: RecordingConfig) -> Callable[[], None]:
    """Records, and gives what writes and shows the result.

    Only the recording tells whether the arm's limits leave a goal, so that it comes before the work.

    Raises:
      ValueError: files that exist or have no folder, an arm that cannot be built, or limits that leave no goal.
    """
    out, plot = _files(config)
    env, console = config.resolve(), Console()
    arm = build_arm(env.expert, env.limits)
    if config.source:
        return _prepare_import(config, env, arm, out, plot)
    if config.joints:
        raise ValueError("joints: expected only with source=FILE, whose joints they are")
    recorded, redrawn = _record(arm, env, console)
    check_effort(recorded, arm.embodiment)  # what the recorder promises, of what is written

    def run() -> None:
        recorded.save(out)
        wanted = env.demonstrations
        title = f"{arm.embodiment.name}, {wanted.kind} demonstrations: {wanted.count}, seed {wanted.seed}"
        plot_demonstrations(recorded, arm.embodiment, plot, title=title)
        console.print(_table(recorded, arm.embodiment))
        console.print(_verdict(recorded, arm.embodiment), soft_wrap=True, highlight=False)
        console.print(f"goals drawn anew because a limit was broken: {redrawn}", highlight=False)
        console.print(f"plot: {plot}", soft_wrap=True, highlight=False)
        console.print(f"results: {out}", soft_wrap=True, highlight=False)

    return run


def _prepare_import(config: RecordingConfig, env: EnvConfig, arm: Arm, out: Path, plot: Path) -> Callable[[], None]:
    """Reads motions, and gives what writes and shows them."""
    if given := [key for key in ("kind", "count", "seed") if getattr(config, key) is not None]:
        raise ValueError(f"{given[0]}: expected none with source=FILE, whose motions are taken as they are")
    source = Path(config.source).expanduser()
    imported, differentiated = import_demonstrations(
        source, arm.embodiment, dt=env.control_dt, horizon=env.horizon, joints=config.joints
    )

    def run() -> None:
        console = Console()
        imported.save(out)
        plot_demonstrations(imported, arm.embodiment, plot, title=f"{arm.embodiment.name}, {source.name}")
        console.print(_table(imported, arm.embodiment))
        said = "differentiated, since the file has none" if differentiated else "as in the file"
        length = f"{imported.horizon} steps of {imported.dt:g} s"
        console.print(f"{source.name}: {imported.count} demonstrations, {length}; velocities: {said}", soft_wrap=True)
        console.print(f"all stay within the rated speeds of {arm.embodiment.name}; torques are not known")
        console.print(f"plot: {plot}", soft_wrap=True, highlight=False)
        console.print(f"results: {out}", soft_wrap=True, highlight=False)

    return run


def _files(config: RecordingConfig) -> tuple[Path, Path]:
    """The files of the demonstrations and of their plot."""
    out = new_file("out", config.out)
    if out.suffix != ".npz":
        raise ValueError(f"out: expected a file that ends in .npz, got {str(out)!r}")
    plot = new_file("plot", config.plot or str(out.with_suffix(".png")))
    if plot.suffix not in _PLOT_SUFFIXES:
        raise ValueError(f"plot: expected a file that ends in {', '.join(_PLOT_SUFFIXES)}, got {str(plot)!r}")
    return out, plot


def _record(arm: Arm, env: EnvConfig, console: Console) -> tuple[Demonstrations, int]:
    """The demonstrations, and how many goals were drawn anew; with a bar on a terminal."""
    wanted, redrawn = env.demonstrations, 0
    columns = TextColumn("[bold]recording"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("record", total=wanted.count)

        def count_up(redrawn_for_it: int) -> None:
            nonlocal redrawn
            redrawn += redrawn_for_it
            bar.advance(task)

        recorded = record_demonstrations(
            arm,
            wanted.count,
            kind=wanted.kind,
            seed=wanted.seed,
            horizon=env.horizon,
            dt=env.control_dt,
            substeps=env.substeps,
            on_recorded=count_up,
        )
    return recorded, redrawn


def _table(recorded: Demonstrations, arm: Embodiment) -> Table:
    title = f"{arm.name}, demonstrations: {recorded.count} of {recorded.horizon * recorded.dt:g} s"
    table = Table(title=title, title_justify="left", caption="in brackets: share of the limit", caption_justify="left")
    table.add_column("joint")
    for header in ("angles\n[rad]", "peak speed\n[rad/s]", "peak torque\n[N m]", "RMS torque\n[N m]"):
        table.add_column(escape(header), justify="right")  # a unit in brackets is no style
    torque = np.full((1, 1, arm.num_joints), np.nan) if recorded.torque is None else recorded.torque
    least, most = recorded.qpos.min(axis=(0, 1)), recorded.qpos.max(axis=(0, 1))
    rms_torque = np.sqrt(np.mean(torque**2, axis=(0, 1)))
    for joint, name in enumerate(arm.joint_names):
        table.add_row(
            name,
            f"{least[joint]:.2f} to {most[joint]:.2f} ({(most - least)[joint] / np.ptp(arm.joint_range[joint]):.0%})",
            with_share(peak(recorded.qvel)[joint], arm.velocity_limit[joint]),
            with_share(peak(torque)[joint], arm.torque_limit[joint]),
            with_share(rms_torque[joint], arm.torque_limit[joint]),
        )
    return table


def _verdict(recorded: Demonstrations, arm: Embodiment) -> str:
    """In words, what `check_effort` has found."""
    limits = {"torque limits": arm.torque_limit, "rated speeds": arm.velocity_limit}
    kept = [name for name, limit in limits.items() if np.isfinite(limit).any()]
    missing = [name for name in limits if name not in kept]
    if not kept:
        return f"{arm.name} has no torque limits and no rated speeds to stay within"
    lacking = f", which has no {missing[0]}" if missing else ""
    return f"all stay within the {' and '.join(kept)} of {arm.name}{lacking}"
