"""`python -m mimic.export`: writes a trained policy or pose mapper to a file that runs without mimic."""

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
from mimic.base.config import check_choice, new_file, new_folder
from mimic.base.distribution import VERSION, install_command
from mimic.base.files import write_atomically
from mimic.envs import env_config
from mimic.envs.imitation import layout_of, observation_layout, torque_scale
from mimic.runs.checkpoints import check_checkpoint, load_checkpoint
from mimic.trainers.config import PPOConfig, TrainConfig
from mimic.trainers.export.config import CONTROLLER, EXPORT_FORMATS, ExportConfig
from mimic.trainers.export.export_any_arm import any_arm_function, description_writer
from mimic.trainers.export.export_controller import prepare_controller
from mimic.trainers.export.exported_function import ExportedFunction, joint_ranges
from mimic.trainers.pose_mapper.model import PoseMapper
from mimic.trainers.ppo import ppo
from mimic.trainers.ppo.trainer import run_environment
from mimic.trainers.run_config import load_config

_PACKAGES = {"onnx": "onnx", "jax": "flatbuffers", CONTROLLER: "onnx"}  # the package that writes each format
_JAX_PLATFORMS = ("cpu", "cuda")


def export_run(
    run: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    format: Literal["onnx", "jax", "controller"] = "onnx",
    learner: str = "",
    locked: Sequence[int | str] = (),
    checkpoint: int | None = None,
) -> Path:
    """Writes the policy or the pose mapper of a run to a file that other programs can run without mimic.

    A policy maps `observation` [batch, observations] to `action` [batch, joints] in [-1, 1], without exploration, and
    to `torque` [N m]. A pose mapper maps `expert_qpos` [batch, joints] to `learner_qpos` [batch, learner_joints], both
    in rad. The file includes the normalisation of inputs and the scaling of outputs.

    Of a run whose learner is any arm, the function has an input `learner`: the description of an arm, which this
    function writes too. With the metadata's `learner_layout` it can also be made without mimic, see `ArmArrays` in
    mimic/arms/arrays.py. Angles and torques are then [batch, 8], with those of locked joints, and 0 where the arm
    has no joint. A policy of any arm is a step of its controller, with the poses that it follows as an input and an
    output; the metadata says what the inputs are.

    Args:
      run: run directory.
      out: exported file; must not exist.
      format: "onnx", or "jax" for `jax.export.deserialize`, with the metadata in a second file named `out` + ".json";
        or "controller", a folder for `mimic.deploy`, see `export_controller`.
      learner: name of the environment that the run's arms must equal. Default "": not checked. Of a run whose learner
        is any arm, an arm (see `ArmConfig.model`) whose description is written to `out`, a .json or .npz file, instead
        of the network.
      locked: numbers or names of the joints of this arm that are locked.
      checkpoint: steps of the checkpoint. Default None: the last checkpoint.

    Returns:
      Path of the file.

    Raises:
      ValueError: the run or the checkpoint does not exist, the run has other arms, the file cannot be written, the
        format is unknown, or a package that it needs is not installed.
    """
    config = ExportConfig(os.fspath(run), os.fspath(out), format, learner, list(locked), checkpoint)
    if export := _folder_writer(config) or _description_writer(config):
        export()
    else:
        _write(exported_function(config), _file(config), format)
    return Path(out).expanduser()


def prepare_export(config: ExportConfig) -> Callable[[], None]:
    """Checks the config of an export and restores the run.

    Raises:
      ValueError: see `export_run`.
    """
    if export := _folder_writer(config) or _description_writer(config):
        return export
    out = _file(config)
    exported = exported_function(config)

    def run() -> None:
        _write(exported, out, config.format)
        console = Console()
        title = f"{exported.kind.replace('_', ' ')} of {exported.metadata['env']}"
        inputs = ", ".join(f"{name} [batch, {size}]" for name, size in exported.inputs.items())
        outputs = ", ".join(exported.metadata["outputs"])
        console.print(f"{title}: {inputs} -> {outputs}", markup=False)
        console.print(f"results: {out}", soft_wrap=True, highlight=False)

    return run


def _folder_writer(config: ExportConfig) -> Callable[[], None] | None:
    """Writes the controller of a run; None for another format."""
    if config.format != CONTROLLER:
        return None
    _check_package(config.format)
    out, run_dir = new_folder("out", config.out), _run_dir(config)
    if config.learner:
        _check_arms(config, *load_config(run_dir).env.build_arms().embodiments)
    write = prepare_controller(run_dir, config.checkpoint)

    def run() -> None:
        write(out)
        Console().print(f"results: {out}", soft_wrap=True, highlight=False)

    return run


def _run_dir(config: ExportConfig) -> Path:
    if not config.run:
        raise ValueError("run: expected the run directory to export, as in run=runs/NAME")
    return Path(config.run).expanduser()


def _check_package(format: str) -> None:
    """Raises a `ValueError` where the package that writes a format is not installed."""
    package = _PACKAGES[format]
    try:
        importlib.import_module(package)
    except ImportError as error:
        raise ValueError(f"format={format} needs the package {package}: {install_command('export')}") from error


def _file(config: ExportConfig) -> Path:
    """The new file of the export."""
    check_choice("format", config.format, EXPORT_FORMATS)
    out = new_file("out", config.out)
    if config.format == "jax":
        new_file("out", str(_metadata_file(out)))
    if not os.access(out.parent, os.W_OK):
        raise ValueError(f"out: {str(out)!r}: the folder cannot be written to")
    _check_package(config.format)
    return out


def _metadata_file(out: Path) -> Path:
    """The file of the metadata, for the format "jax"."""
    return out.with_name(out.name + ".json")


def exported_function(config: ExportConfig) -> ExportedFunction:
    """The function of a run's network."""
    run_dir = _run_dir(config)
    trained = load_config(run_dir)
    if trained.env.kind == "inner_loop" and trained.trainer.name == "ppo":
        raise ValueError(f"format: expected {CONTROLLER} for a run with an inner loop, got {config.format}")
    steps = check_checkpoint(run_dir, config.checkpoint)
    if trained.env.kind == "sampled_arms":
        return any_arm_function(trained, run_dir, steps)
    expert, learner = trained.env.build_arms().embodiments
    if config.learner:
        _check_arms(config, expert, learner)
    common = {
        "mimic_version": VERSION,
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


def _description_writer(config: ExportConfig) -> Callable[[], None] | None:
    """Writes the description of the arm `learner` for a run whose learner is any arm; None for another export."""
    run_dir = Path(config.run).expanduser()
    if not config.learner or not config.run:
        return None
    trained = load_config(run_dir)
    if trained.env.kind != "sampled_arms":
        return None
    check_checkpoint(run_dir, config.checkpoint)
    return description_writer(trained, config.learner, config.locked, config.out)


def _check_arms(config: ExportConfig, expert: Embodiment, learner: Embodiment) -> None:
    """Raises a `ValueError` unless the arms of a run are those of the environment `learner`."""
    name = config.learner
    if config.locked:
        raise ValueError(f"locked: expected none for a run of one learner, got {config.locked}")
    required_arms = env_config(name).build_arms().embodiments
    for role, arm, required in zip(("expert", "learner"), (expert, learner), required_arms, strict=True):
        if (arm.name, arm.joint_names) != (required.name, required.joint_names):
            raise ValueError(
                f"learner: {name} has the {role} {required.name} with joints {', '.join(required.joint_names)}, "
                f"but the run's is {arm.name} with joints {', '.join(arm.joint_names)}"
            )


def _policy(trained: TrainConfig, run_dir: Path, steps: int, common: Mapping[str, Any]) -> ExportedFunction:
    arms = trained.env.build_arms()
    expert, learner = arms.embodiments
    if trained.env.observation.terms or trained.env.environment:
        layout = layout_of(run_environment(trained.env, run_dir)[0])
    else:
        layout = observation_layout(expert, learner, trained.env.preview)
    size = layout[-1]["stop"]
    config = cast(PPOConfig, trained.trainer)
    params = load_checkpoint(run_dir, ppo.params_template(config, size, learner.num_joints), steps)[1]
    controller = ppo.make_controller(config, size, learner.num_joints)(jax.device_get(params))
    scale = jnp.asarray(torque_scale(arms.learner, trained.env.action_scale, trained.env.control_dt))

    def function(observation: jax.Array) -> dict[str, jax.Array]:
        action = controller(SimpleNamespace(obs=observation))  # type: ignore[arg-type]
        return {"action": action, "torque": action * scale}

    metadata = {
        **common,
        "inputs": {"observation": "see observation_layout"},
        "outputs": {
            "action": "fraction of the maximum torque of each joint, in [-1, 1]",
            "torque": "N m, in addition to gravity compensation; constant for control_dt",
        },
        "observation_layout": layout,
        "torque_scale": [float(torque) for torque in scale],
        "control_dt": trained.env.control_dt,
    }
    return ExportedFunction(function, "policy", {"observation": size}, metadata)


def _mapper(mapper: PoseMapper, common: Mapping[str, Any]) -> ExportedFunction:
    params = jax.device_get(mapper.params)

    def function(qpos: jax.Array) -> dict[str, jax.Array]:
        return {"learner_qpos": mapper.model(params, qpos)}

    metadata = {
        **common,
        "inputs": {"expert_qpos": "rad, in the order of expert_joints"},
        "outputs": {"learner_qpos": "rad, in the order of learner_joints"},
        "expert_range": joint_ranges(mapper.expert),
        "learner_range": joint_ranges(mapper.learner),
    }
    return ExportedFunction(function, "pose_mapper", {"expert_qpos": mapper.expert.num_joints}, metadata)


def _write(exported: ExportedFunction, out: Path, format: str) -> None:
    content = {"onnx": _onnx_bytes, "jax": _jax_bytes}[format](exported)
    partial = out.with_name(out.name + ".partial")
    partial.write_bytes(content)
    if format == "jax":
        write_atomically(_metadata_file(out), json.dumps(exported.metadata, indent=2) + "\n")
    os.replace(partial, out)


def _onnx_bytes(exported: ExportedFunction) -> bytes:
    from mimic.trainers.export.onnx_graph import to_onnx  # needs the extra "export"

    texts = {key: value if isinstance(value, str) else json.dumps(value) for key, value in exported.metadata.items()}
    model = to_onnx(
        exported.function,
        name=exported.kind,
        inputs=exported.inputs,
        metadata=texts,
    )
    return model.SerializeToString()


def _jax_bytes(exported: ExportedFunction) -> bytes:
    from jax import export  # jax.export must be imported explicitly

    (batch,) = export.symbolic_shape("batch")
    shapes = [jax.ShapeDtypeStruct((batch, size), jnp.float32) for size in exported.inputs.values()]
    serializable = export.export(jax.jit(jax.vmap(exported.function)), platforms=_JAX_PLATFORMS)(*shapes)
    return bytes(serializable.serialize())
