"""What `python -m mimic.export` does: a trained policy or pose mapper as a file that runs without mimic."""

import dataclasses
import importlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal, cast

import jax
import jax.numpy as jnp
from rich.console import Console

from mimic.arms.embodiment import Embodiment
from mimic.commands.config import EXPORT_FORMATS, ExportConfig
from mimic.config import check_choice, new_file
from mimic.envs import env_config
from mimic.envs.imitation import observation_layout, torque_scale
from mimic.runs.checkpoints import check_checkpoint, load_checkpoint
from mimic.runs.files import write_atomically
from mimic.runs.provenance import versions
from mimic.trainers.config import PPOConfig, TrainConfig
from mimic.trainers.pose_mapper.model import PoseMapper
from mimic.trainers.ppo import training
from mimic.trainers.run_config import load_config

_NEEDS = {"onnx": "onnx", "jax": "flatbuffers"}  # the package that each format is written with
_JAX_PLATFORMS = ("cpu", "cuda")


@dataclasses.dataclass(frozen=True)
class Portable:
    """What is exported.

    Attributes:
      function: of one float32 vector; gives a vector for each output, by name.
      kind: "policy" or "pose_mapper".
      input_name: of its input.
      input_size: length of its input.
      metadata: what the numbers mean.
    """

    function: Callable[[jax.Array], dict[str, jax.Array]]
    kind: str
    input_name: str
    input_size: int
    metadata: dict[str, Any]


def export_run(
    run: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    format: Literal["onnx", "jax"] = "onnx",
    learner: str = "",
    checkpoint: int | None = None,
) -> Path:
    """Writes the policy or the pose mapper of a run as a file that other programs can run, without mimic.

    A policy takes `observation` [batch, observations] and gives `action` [batch, joints] in [-1, 1], without
    exploration, and `torque` [N m]. A pose mapper takes `expert_qpos` [batch, joints] and gives `learner_qpos`, in rad.
    What turns observations and poses into inputs of the network, and its outputs into actions and poses, is inside.

    Args:
      run: the run directory.
      out: the file; must not exist.
      format: "onnx", or "jax" for `jax.export.deserialize`, with the metadata in a file beside it that ends in .json.
      learner: name of the environment whose arms it is meant for; any where empty.
      checkpoint: steps of the checkpoint; the last one where None.

    Returns:
      The file.

    Raises:
      ValueError: no such run or checkpoint, a run of other arms, a file that cannot be written, an unknown format, or
        a package that the format needs and that is not installed.
    """
    config = ExportConfig(os.fspath(run), os.fspath(out), format, learner, checkpoint)
    _write(_portable(config), _file(config), format)
    return Path(out).expanduser()


def prepare_export(config: ExportConfig) -> Callable[[], None]:
    """An export, ready to be written.

    Raises:
      ValueError: see `export_run`.
    """
    out = _file(config)
    portable = _portable(config)

    def run() -> None:
        _write(portable, out, config.format)
        console = Console()
        made = f"{portable.kind.replace('_', ' ')} of {portable.metadata['env']}"
        outputs = ", ".join(portable.metadata["outputs"])
        console.print(f"{made}: {portable.input_name} [batch, {portable.input_size}] -> {outputs}", markup=False)
        console.print(f"results: {out}", soft_wrap=True, highlight=False)

    return run


def _file(config: ExportConfig) -> Path:
    """Where it goes."""
    check_choice("format", config.format, EXPORT_FORMATS)
    out = new_file("out", config.out)
    if config.format == "jax":
        new_file("out", str(_beside(out)))
    if not os.access(out.parent, os.W_OK):
        raise ValueError(f"out: {str(out)!r}: the folder cannot be written to")
    package = _NEEDS[config.format]
    try:
        importlib.import_module(package)
    except ImportError as error:
        raise ValueError(
            f"format={config.format} needs the package {package}: pip install 'mimic-mjx[export]'"
        ) from error
    return out


def _beside(out: Path) -> Path:
    return out.with_name(out.name + ".json")


def _portable(config: ExportConfig) -> Portable:
    """The network of a run as a function."""
    if not config.run:
        raise ValueError("run: expected the run directory to export, as in run=runs/NAME")
    run_dir = Path(config.run).expanduser()
    trained = load_config(run_dir)
    steps = check_checkpoint(run_dir, config.checkpoint)
    expert, learner = trained.env.build_arms().embodiments
    if config.learner:
        _check_meant_for(config.learner, expert, learner)
    common = {
        "mimic_version": versions()["mimic-mjx"],
        "env": trained.env.name,
        "trainer": trained.trainer.name,
        "checkpoint": steps,
        "expert": expert.name,
        "expert_joints": list(expert.joint_names),
        "learner": learner.name,
        "learner_joints": list(learner.joint_names),
    }
    if trained.trainer.name == "ppo":
        return _policy(trained, run_dir, steps, common)
    return _mapper(PoseMapper.load(run_dir, steps), common)


def _check_meant_for(name: str, expert: Embodiment, learner: Embodiment) -> None:
    meant = env_config(name).build_arms().embodiments
    for role, own, other in zip(("expert", "learner"), (expert, learner), meant, strict=True):
        if (own.name, own.joint_names) != (other.name, other.joint_names):
            raise ValueError(
                f"learner: {name} has the {role} {other.name} with joints {', '.join(other.joint_names)}, "
                f"but the run's is {own.name} with joints {', '.join(own.joint_names)}"
            )


def _policy(trained: TrainConfig, run_dir: Path, steps: int, common: Mapping[str, Any]) -> Portable:
    arms = trained.env.build_arms()
    expert, learner = arms.embodiments
    layout = observation_layout(expert, learner, trained.env.preview)
    size = layout[-1]["stop"]
    config = cast(PPOConfig, trained.trainer).resolve()  # saved with all values: the machine does not matter
    params = load_checkpoint(run_dir, training.params_template(config, size, learner.num_joints), steps)[1]
    controller = training.make_controller(config, size, learner.num_joints)(jax.device_get(params))
    scale = jnp.asarray(torque_scale(arms.learner, trained.env.action_scale, trained.env.control_dt))

    def function(observation: jax.Array) -> dict[str, jax.Array]:
        action = controller(SimpleNamespace(obs=observation))  # type: ignore[arg-type]
        return {"action": action, "torque": action * scale}

    metadata = {
        **common,
        "inputs": {"observation": "see observation_layout"},
        "outputs": {
            "action": "share of the largest torque of each joint, in [-1, 1]",
            "torque": "N m, beside what carries the arm's weight; to be held for control_dt",
        },
        "observation_layout": layout,
        "torque_scale": [float(torque) for torque in scale],
        "control_dt": trained.env.control_dt,
    }
    return Portable(function, "policy", "observation", size, metadata)


def _mapper(mapper: PoseMapper, common: Mapping[str, Any]) -> Portable:
    params = jax.device_get(mapper.params)

    def function(qpos: jax.Array) -> dict[str, jax.Array]:
        return {"learner_qpos": mapper.model(params, qpos)}

    metadata = {
        **common,
        "inputs": {"expert_qpos": "rad, in the order of expert_joints"},
        "outputs": {"learner_qpos": "rad, in the order of learner_joints"},
        "expert_range": _range(mapper.expert),
        "learner_range": _range(mapper.learner),
    }
    return Portable(function, "pose_mapper", "expert_qpos", mapper.expert.num_joints, metadata)


def _range(arm: Embodiment) -> Sequence[Sequence[float]]:
    return [[float(bound) for bound in bounds] for bounds in arm.joint_range]


def _write(portable: Portable, out: Path, format: str) -> None:
    written = {"onnx": _onnx_bytes, "jax": _jax_bytes}[format](portable)
    partial = out.with_name(out.name + ".partial")
    partial.write_bytes(written)
    if format == "jax":
        write_atomically(_beside(out), json.dumps(portable.metadata, indent=2) + "\n")
    os.replace(partial, out)


def _onnx_bytes(portable: Portable) -> bytes:
    from mimic.commands.onnx_graph import to_onnx  # of an extra

    texts = {key: value if isinstance(value, str) else json.dumps(value) for key, value in portable.metadata.items()}
    model = to_onnx(
        portable.function,
        name=portable.kind,
        input_name=portable.input_name,
        input_size=portable.input_size,
        metadata=texts,
    )
    return model.SerializeToString()


def _jax_bytes(portable: Portable) -> bytes:
    from jax import export  # no attribute of jax until it is imported

    (batch,) = export.symbolic_shape("batch")
    shape = jax.ShapeDtypeStruct((batch, portable.input_size), jnp.float32)
    exported = export.export(jax.jit(jax.vmap(portable.function)), platforms=_JAX_PLATFORMS)(shape)
    return bytes(exported.serialize())
