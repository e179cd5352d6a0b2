"""`python -m mimic.export`: writes a trained policy or pose mapper to a file that runs without mimic."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from rich.console import Console

from mimic.base.config import check_choice, new_path
from mimic.base.distribution import import_extra
from mimic.runs.checkpoints import check_checkpoint
from mimic.trainers.export.config import CONTROLLER, EXPORT_FORMATS, ExportConfig
from mimic.trainers.export.export_controller import prepare_controller
from mimic.trainers.export.functions import ExportedFunction, make_function
from mimic.trainers.export.onnx_model import to_onnx
from mimic.trainers.run_config import given_run

_PACKAGES = ("jax2onnx", "onnxruntime")


def export_run(
    run: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    format: Literal["onnx", "controller"] = "onnx",
    checkpoint: int | None = None,
) -> Path:
    """Writes the policy of one arm or the pose mapper of a run to a file that other programs can run without mimic.

    A policy maps `observation` [batch, observations] to `action` [batch, joints] in [-1, 1], without exploration, and
    to `torque` [N m]. A pose mapper maps `expert_qpos` [batch, joints] to `learner_qpos` [batch, learner_joints], both
    in rad. The file includes the normalisation of inputs and the
    scaling of outputs.

    Args:
      run: run directory.
      out: exported file; must not exist.
      format: "onnx", or "controller", a folder for `mimic.deploy`, see `prepare_controller`.
      checkpoint: steps of the checkpoint. Default None: the last checkpoint.

    Returns:
      Path of the file.

    Raises:
      ValueError: the run or the checkpoint does not exist, it is a policy of many arms, the file cannot be written, the
        format is unknown, or a package that it needs is not installed.
    """
    write, _ = _writer(ExportConfig(os.fspath(run), os.fspath(out), format, checkpoint))
    write()
    return Path(out).expanduser()


def prepare_export(config: ExportConfig) -> Callable[[], None]:
    """Checks the config of an export and restores the run.

    Raises:
      ValueError: see `export_run`.
    """
    write, summary = _writer(config)

    def run() -> None:
        write()
        console = Console()
        if summary:
            console.print(summary, markup=False)
        console.print(f"results: {Path(config.out).expanduser()}", soft_wrap=True, highlight=False)

    return run


def _writer(config: ExportConfig) -> tuple[Callable[[], None], str]:
    """Writes the controller or the network of a run; and the inputs and outputs as text."""
    check_choice("format", config.format, EXPORT_FORMATS)
    if config.format == CONTROLLER:
        _check_packages(config.format)
        out = new_path("out", config.out)
        write = prepare_controller(given_run(config.run)[0], config.checkpoint)
        return lambda: write(out), ""
    out = new_path("out", config.out, "file")
    if out.suffix != ".onnx":
        raise ValueError(f"out: expected a file that ends in .onnx, got {str(out)!r}")
    if not os.access(out.parent, os.W_OK):
        raise ValueError(f"out: {str(out)!r}: the folder cannot be written to")
    _check_packages(config.format)
    exported = exported_function(config)
    inputs = ", ".join(f"{name} [batch, {size}]" for name, size in exported.inputs.items())
    title = f"{exported.kind.replace('_', ' ')} of {exported.metadata['env']}"
    summary = f"{title}: {inputs} -> {', '.join(exported.metadata['outputs'])}"
    return lambda: _write(exported, out), summary


def _check_packages(format: str) -> None:
    """Raises a `ValueError` where a package that writes a format is not installed."""
    for package in _PACKAGES:
        import_extra(package, "export", f"format={format}")


def exported_function(config: ExportConfig) -> ExportedFunction:
    """The function of a run's network. Raises a `ValueError` for a policy with an inner loop, or of many arms."""
    run_dir, trained = given_run(config.run)
    if trained.trainer.name == "ppo" and trained.env.kind == "inner_loop":
        raise ValueError(f"format: expected {CONTROLLER} for a run with an inner loop, got {config.format}")
    if trained.trainer.name == "ppo" and trained.env.kind == "sampled_arms":
        raise ValueError(
            f"run: expected a policy of one arm, or a pose mapper, got a policy of many arms, env={trained.env.name}; "
            "train one for your arm with env=pair env.learner=ARM"
        )
    return make_function(trained, run_dir, check_checkpoint(run_dir, config.checkpoint))


def _write(exported: ExportedFunction, out: Path) -> None:
    texts = {key: value if isinstance(value, str) else json.dumps(value) for key, value in exported.metadata.items()}
    content = to_onnx(exported.function, name=exported.kind, inputs=exported.inputs, metadata=texts)
    partial = out.with_name(out.name + ".partial")
    partial.write_bytes(content)
    os.replace(partial, out)
