"""Controller bundles without a training, for Pandas with policies of a line."""

import functools
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from mimic.arms.arm import Arm, ArmConfig, build_arm
from mimic.arms.capsules import fit_capsules
from mimic.arms.drives import drives_of
from mimic.control.clearance import ClearanceConstants
from mimic.control.joint_control import JointParameters
from mimic.deploy.bundle import load_bundle, write_bundle
from mimic.envs import env_config
from mimic.metric.capsule_distances import clearance_constants
from mimic.physics.plant import make_plant
from mimic.trainers.export.onnx_model import to_onnx

ON_FLOOR = np.array([0, 1.7, 0, -0.9, 0, 1.57, 0.785])  # poses in which a Panda touches the floor, and itself
FOLDED = np.array([0, 0.6, 0, -3.05, 2.8, 3.7, 0])
PREVIEW, PAST, LINKS, TICKS, CONTROL_DT = 2, 3, 7, 40, 0.05
EXPERT = (PREVIEW + 1) * LINKS * 12


@functools.cache
def panda(locked: tuple[int, ...] = ()) -> Arm:
    """The Panda with the manufacturer's limits."""
    return build_arm(ArmConfig(locked=list(locked)), "hardware")


@functools.cache
def panda_clearance(locked: tuple[int, ...] = ()) -> ClearanceConstants:
    """The constants of the clearance of a Panda."""
    return clearance_constants(panda(locked).embodiment, fit_capsules(ArmConfig(locked=list(locked)), "hardware"))


@functools.cache
def parameters() -> JointParameters:
    """The parameters of the inner loop of a Panda in the hardware world."""
    config = env_config("panda7dof", world="hardware")
    scales = {"action_scale": config.action_scale, "control_dt": config.control_dt}
    assert config.world is not None
    plant = make_plant(config.learner, panda(), config.world, **scales)
    return JointParameters(*(np.asarray(x, float) for x in plant.constants.parameters))


@functools.cache
def policy(joints: int, size: int, action: Any) -> bytes:
    """A policy as ONNX; `action` gives the action of the six inputs by name."""
    inputs = {name: joints for name in ("qpos", "qvel", "reference_qpos", "reference_qvel")}
    inputs |= {"past_actions": PAST * size, "expert": EXPERT}
    names = list(inputs)

    def function(*values: Any) -> dict[str, Any]:
        by_name = dict(zip(names, values, strict=True))
        unused = 0 * sum(jnp.sum(value) for value in values)  # keeps all inputs in the graph
        return {"action": jnp.clip(action(by_name) + unused, -1, 1)}

    return to_onnx(function, name="policy", inputs=inputs)


def sine(values: dict[str, Any]) -> Any:
    """A motion of all joints: the first number of the expert is its phase."""
    phase = values["expert"][0]
    return 0.4 * jnp.sin(phase + jnp.arange(values["qpos"].shape[0]))


@functools.cache
def constant(*numbers: float) -> Any:
    """The policy that always gives these numbers."""
    return lambda values: jnp.asarray(numbers, jnp.float32)


def make_bundle(
    folder: Path,
    action: Any = sine,
    *,
    mode: str = "joint_velocity",
    ticks: int = TICKS,
    clearance: ClearanceConstants | None = None,
    network: bytes | None = None,
) -> Any:
    """Writes a bundle for a Panda and loads it."""
    arm = panda()
    limits = drives_of(ArmConfig(), arm).limits
    home, joints = np.asarray(arm.embodiment.home), arm.embodiment.num_joints
    start_poses = np.stack([home, home])
    expert = np.zeros((len(start_poses), ticks + 1, LINKS * 12))
    expert[:, :, 0] = 2 * np.pi * CONTROL_DT * np.arange(ticks + 1)  # one cycle a second
    write_bundle(
        folder,
        policy=network or policy(joints, joints, action),
        clearance=clearance or panda_clearance(),
        controller={
            "mimic_version": "test",
            "robot": "panda",
            "mode": mode,
            "control_dt": CONTROL_DT,
            "joint_names": list(arm.embodiment.joint_names),
            "limits": limits.as_lists(),
            "parameters": {name: x.tolist() for name, x in parameters()._asdict().items()},
            "preview": PREVIEW,
            "past_actions": PAST,
            "expert_numbers": 12 * LINKS,
        },
        expert=expert,
        start_poses=start_poses,
        names=[f"motion {i}" for i in range(len(start_poses))],
    )
    return load_bundle(folder)
