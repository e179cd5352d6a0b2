"""What of a MuJoCo model the arm leaves out, in words."""

import mujoco
import numpy as np

from mimic.arms.kinematic_tree import ChainIds, find_chain, joint_kind

_SHOWN = 6  # names in a list, then a count
_AFFINE = int(mujoco.mjtBias.mjBIAS_AFFINE)


def ignored_elements(model: mujoco.MjModel, base: str | None = None, tip: str | None = None) -> tuple[str, ...]:
    """One line for each kind of thing that a model has and the simulated arm has not.

    Args:
      model: of an arm.
      base: see `find_chain`.
      tip: see `find_chain`.

    Raises:
      ValueError: what `find_chain` refuses.
    """
    chain_ids = find_chain(model, base, tip)
    lines = [
        _joints(model, chain_ids.before, "before the base, held"),
        _joints(
            model, chain_ids.beyond, "beyond the tip, held where the model has them; what they carry stays as mass"
        ),
        _joints(model, chain_ids.elsewhere, "elsewhere in the model, not of this arm"),
        _actuators(model, chain_ids),
        _counted({"equality constraints": model.neq, "tendons": model.ntendon, "keyframes": model.nkey}),
        _springs(model, chain_ids),
        "gravity, contacts and joint stops are not simulated",
    ]
    return tuple(line for line in lines if line)


def _joints(model: mujoco.MjModel, joints: tuple[int, ...], where: str) -> str:
    names = [f"{model.joint(joint).name} ({joint_kind(model, joint)})" for joint in joints]
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return f"joints {where}: {', '.join(names[:_SHOWN])}{more}" if names else ""


def _actuators(model: mujoco.MjModel, chain_ids: ChainIds) -> str:
    """Each joint gets a torque motor; of the model's own actuators only the limits count."""
    if not model.nu:
        return f"the model has no actuators: torque motors are added to its {len(chain_ids.joints)} hinges"
    affine = model.actuator_biastype == _AFFINE
    on_position = affine & (model.actuator_biasprm[:, 1] != 0)
    on_speed = affine & ~on_position & (model.actuator_biasprm[:, 2] != 0)
    kinds = {"on position": int(np.sum(on_position)), "on speed": int(np.sum(on_speed))}
    servos = ", ".join(f"{count} servos {kind}" for kind, count in kinds.items() if count)
    return f"{model.nu} actuators{f' ({servos})' if servos else ''}: torque motors with their limits take their place"


def _counted(things: dict[str, int]) -> str:
    found = [f"{count} {name}" for name, count in things.items() if count]
    return f"{', '.join(found)}: left out" if found else ""


def _springs(model: mujoco.MjModel, chain_ids: ChainIds) -> str:
    joints = list(chain_ids.joints)
    dofs = model.jnt_dofadr[joints]
    names = {
        "springs": np.any(model.jnt_stiffness[joints] != 0),
        "dry friction": np.any(model.dof_frictionloss[dofs] != 0),
    }
    found = [name for name, present in names.items() if present]
    return f"{' and '.join(found)} of the joints: left out; damping and armature are kept" if found else ""
