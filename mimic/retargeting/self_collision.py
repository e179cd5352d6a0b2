"""Motions in which links touch each other or the floor."""

from collections.abc import Callable, Iterator

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from mimic.arms.arm import ArmConfig, arm_spec, build_arm
from mimic.arms.capsules import Capsules
from mimic.arms.embodiment import Embodiment
from mimic.arms.mujoco_chain import data_at_zero
from mimic.control.clearance import clearance
from mimic.metric.capsule_distances import clearance_constants


def smallest_clearances(
    arm: Embodiment, capsules: Capsules, qpos: Float[np.ndarray, "motions time joints"], floor_height: float = 0.0
) -> Float[np.ndarray, " motions"]:
    """The smallest clearance of each motion [m], negative where capsules of links touch each other or the floor.

    Args:
      arm: embodiment of the joints.
      capsules: from `fit_capsules`, of the same arm. They contain its shapes, so that a small negative clearance need
        not be a contact of the shapes.
      qpos: joint angles [rad].
      floor_height: see `WorldConfig`.
    """
    constants = clearance_constants(arm, capsules, floor_height)
    return np.stack([clearance(np.asarray(motion, np.float32), constants).min() for motion in qpos])


def make_contacts(
    config: ArmConfig, limits: str = "none"
) -> Callable[[Float[np.ndarray, "poses joints"]], Bool[np.ndarray, " poses"]]:
    """Makes the function from joint angles [rad] to whether collision geoms of the arm's model touch, by MuJoCo.

    Meshes count as their convex hulls. Bodies that are joined, and those that touch in the home pose, are left out.

    Raises:
      ValueError: what `build_arm` rejects.
    """
    arm, spec = build_arm(config, limits), arm_spec(config)

    def touching(model: mujoco.MjModel, poses: np.ndarray) -> Iterator[np.ndarray]:
        """Pairs of geoms that touch in each pose."""
        data = data_at_zero(model)
        for name, angle in arm.locked.items():
            data.qpos[model.joint(name).qposadr[0]] = angle
        address = np.array([model.joint(name).qposadr[0] for name in arm.embodiment.joint_names])
        for pose in poses:
            data.qpos[address] = pose
            for compute in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_collision):  # what collisions need
                compute(model, data)
            yield data.contact.geom[data.contact.dist < 0] if data.ncon else _NOTHING

    model = spec.compile()
    (always,) = touching(model, np.asarray(arm.embodiment.home, float)[None])
    names = {}
    for body in spec.bodies:
        body.name = names[body.id] = body.name or f"body {body.id} of {len(spec.bodies)}"
    for one, other in {tuple(sorted(bodies)) for bodies in model.geom_bodyid[always].tolist()}:
        spec.add_exclude(bodyname1=names[one], bodyname2=names[other])
    others = spec.compile() if len(always) else model
    return lambda qpos: np.array([len(pairs) > 0 for pairs in touching(others, qpos)], bool)


def touching_line(clearances: Float[np.ndarray, " motions"], noun: str = "demonstrations") -> str:
    """What `smallest_clearances` tell, as a sentence."""
    touching, smallest = np.flatnonzero(clearances < 0), f"{1e3 * clearances.min():.0f} mm"
    if not len(touching):
        return f"links touch neither each other nor the floor; smallest clearance: {smallest}"
    shown = ", ".join(map(str, touching[:_SHOWN])) + (", ..." if len(touching) > _SHOWN else "")
    return (
        f"warning: links touch each other or the floor in {len(touching)} of {len(clearances)} {noun}: {shown}; "
        f"smallest clearance: {smallest}"
    )


_SHOWN = 8  # numbers of motions
_NOTHING = np.zeros((0, 2), int)
