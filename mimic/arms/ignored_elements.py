"""Elements of a MuJoCo model that the simulated arm ignores, in words."""

import mujoco
import numpy as np

from mimic.arms.kinematic_tree import ChainIds, Tip, find_chain
from mimic.arms.model_tree import joint_kind

_MAX_NAMES = 6  # in a list; the others are counted
_AFFINE = int(mujoco.mjtBias.mjBIAS_AFFINE)


def ignored_elements(model: mujoco.MjModel, base: str | None = None, tip: Tip = None) -> tuple[str, ...]:
    """One line for each kind of element that the model has and the simulated arm lacks.

    Args:
      model: of an arm.
      base: see `find_chain`.
      tip: see `find_chain`.

    Raises:
      ValueError: what `find_chain` rejects.
    """
    chain_ids = find_chain(model, base, tip)
    lines = [
        _joints(model, chain_ids.proximal, "between world and base, fixed"),
        _joints(model, chain_ids.distal, "distal to the tip, fixed; their bodies stay as mass"),
        _joints(model, chain_ids.other, "elsewhere in the model, not part of this arm"),
        _actuators(model, chain_ids),
        _counted({"equality constraints": model.neq, "tendons": model.ntendon, "keyframes": model.nkey}),
        _springs(model, chain_ids),
        "gravity, contacts and joint stops are not simulated",
    ]
    return tuple(line for line in lines if line)


def _joints(model: mujoco.MjModel, joints: tuple[int, ...], where: str) -> str:
    names = [f"{model.joint(joint).name} ({joint_kind(model, joint)})" for joint in joints]
    more = f" and {len(names) - _MAX_NAMES} more" if len(names) > _MAX_NAMES else ""
    return f"joints {where}: {', '.join(names[:_MAX_NAMES])}{more}" if names else ""


def _actuators(model: mujoco.MjModel, chain_ids: ChainIds) -> str:
    """Each joint gets a torque motor; only the limits of the model's own actuators are used."""
    if not model.nu:
        return f"the model has no actuators: torque motors are added to its {len(chain_ids.joints)} joints"
    affine = model.actuator_biastype == _AFFINE
    on_position = affine & (model.actuator_biasprm[:, 1] != 0)
    on_speed = affine & ~on_position & (model.actuator_biasprm[:, 2] != 0)
    kinds = {"on position": int(np.sum(on_position)), "on speed": int(np.sum(on_speed))}
    servos = ", ".join(f"{count} servos {kind}" for kind, count in kinds.items() if count)
    return f"{model.nu} actuators{f' ({servos})' if servos else ''}: replaced by torque motors with their limits"


def _counted(elements: dict[str, int]) -> str:
    present = [f"{count} {name}" for name, count in elements.items() if count]
    return f"{', '.join(present)}: ignored" if present else ""


def _springs(model: mujoco.MjModel, chain_ids: ChainIds) -> str:
    joints = list(chain_ids.joints)
    dofs = model.jnt_dofadr[joints]
    is_present = {
        "springs": np.any(model.jnt_stiffness[joints] != 0),
        "dry friction": np.any(model.dof_frictionloss[dofs] != 0),
    }
    present = [name for name in is_present if is_present[name]]
    return f"{' and '.join(present)} of the joints: ignored; damping and armature are kept" if present else ""
