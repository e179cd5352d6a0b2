"""A training that evaluates often, for hours: memory, open files, disk and speed over time, with their slopes.

    python -m benchmarks.soak [--hours 0.05] [--out FILE] [--arguments KEY=VALUE ...]

The picture of the results stands next to FILE. `--arguments` replace those of the tiny training, which writes several
checkpoints a second; on a GPU e.g. env=panda4dof trainer.evaluations=100000 trainer.num_timesteps=100000000000.
"""

import argparse
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from benchmarks.common.parser import make_parser
from benchmarks.common.process_samples import sample_process, trends
from benchmarks.common.processes import read_metrics
from benchmarks.common.record import Row, print_table, write_results
from mimic.runs.checkpoints import checkpoint_steps
from mimic.runs.signals import STOPPED_BY_SIGNAL

ARGUMENTS = (
    "env=planar4dof", "env.demonstrations.count=4", "env.demonstrations.held_out=2",
    "trainer.num_envs=64", "trainer.batch_size=32", "trainer.num_minibatches=4", "trainer.num_updates_per_batch=1",
    "trainer.hidden_layers=[16]", "trainer.num_timesteps=1000000000", "trainer.evaluations=200000",
)  # fmt: skip
SAMPLED = ["memory_mib", "handles", "threads", "disk_mib", "files"]
_HOUR = 3600.0
_SAMPLES = 720  # at most, so that the results are small
_PATIENCE_S = 300  # until the training has stopped at its next checkpoint


def soak(run_dir: Path, seconds: float, arguments: list[str]) -> Row:
    """Samples of a training that is stopped after a time [s], and its metrics."""
    command = [sys.executable, "-m", "mimic.train", f"run_dir={run_dir}", *arguments]
    log = run_dir.with_suffix(".log")
    with log.open("w") as file:
        process = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT, text=True)
        try:
            samples = sample_process(process, seconds, max(1.0, seconds / _SAMPLES), run_dir)
            process.send_signal(signal.SIGTERM)
            exit_code = process.wait(_PATIENCE_S)
        finally:
            process.kill()
    if exit_code != STOPPED_BY_SIGNAL + signal.SIGTERM:
        sys.exit(f"error: the training ended with {exit_code}: {log.read_text(errors='replace')[-2000:]}")
    speeds = [
        {"time_s": time, "steps_per_s": sps} for time, sps in read_metrics(run_dir, "wall_time_s", "training/sps")
    ]
    began = speeds[0]["time_s"]  # samples before are of imports and compilation
    return {"samples": [row for row in samples if row["time_s"] >= began], "speeds": speeds}


def summary(measured: Row, run_dir: Path) -> Row:
    """Trends of all values, and how many evaluations and checkpoints there were."""
    samples, speeds = measured["samples"], measured["speeds"]
    rows = [*trends(samples, SAMPLED), *trends(speeds, ["steps_per_s"])]
    hours = (speeds[-1]["time_s"] - speeds[0]["time_s"]) / _HOUR
    memory = next(row for row in rows if row["what"] == "memory_mib")
    per_evaluation = memory["per_hour"] * hours / len(speeds) * 1024
    steps = checkpoint_steps(run_dir)
    return {
        "trends": rows, "evaluations": len(speeds), "checkpoints_kept": len(steps), "hours": hours,
        "memory_kib_per_evaluation": per_evaluation,
    }  # fmt: skip


def draw(measured: Row, path: Path) -> None:
    """One panel for each value, over hours."""
    panels = [*((name, "samples") for name in ("memory_mib", "handles", "disk_mib")), ("steps_per_s", "speeds")]
    figure, axes = plt.subplots(len(panels), 1, figsize=(7, 8), sharex=True)
    for axis, (name, series) in zip(axes, panels, strict=True):
        rows = measured[series]
        axis.plot([row["time_s"] / _HOUR for row in rows], [row[name] for row in rows], ".", markersize=2)
        axis.set_ylabel(
            {"memory_mib": "memory [MiB]", "disk_mib": "disk [MiB]", "steps_per_s": "steps/s"}.get(name, name)
        )
    axes[-1].set_xlabel("time [h]")
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    plt.close(figure)


def run(options: argparse.Namespace) -> Row:
    with tempfile.TemporaryDirectory() as folder:
        run_dir = Path(folder) / "run"
        measured = soak(run_dir, options.hours * _HOUR, options.arguments or list(ARGUMENTS))
        result = summary(measured, run_dir)
    thinned = measured["speeds"][:: max(1, len(measured["speeds"]) // _SAMPLES)]
    write_results(options, arguments=options.arguments, **result, samples=measured["samples"], speeds=thinned)
    if options.out:
        draw(measured, options.out.with_suffix(".png"))
    return result


def main() -> None:
    parser = make_parser("soak", __doc__, hours=0.05)
    parser.add_argument("--arguments", nargs="+", metavar="KEY=VALUE", help="of the training")
    result = run(parser.parse_args())
    columns = "what first:,.1f last:,.1f maximum:,.1f per_hour:,.2f low:,.2f high:,.2f flat"
    print_table(result["trends"], columns)
    counts = f"{result['evaluations']} evaluations, {result['checkpoints_kept']} checkpoints kept"
    print(f"{counts}; memory per evaluation: {result['memory_kib_per_evaluation']:.2f} KiB")


if __name__ == "__main__":
    main()
