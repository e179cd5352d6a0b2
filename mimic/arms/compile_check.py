"""Compiles a model in a process of its own, with limits on time and memory, and checks its magnitudes.

That process runs this file: it must import nothing of mimic at its start.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Any

SECONDS = 10  # CPU time; a Panda with meshes needs 1 s
VELOCITY_LIMIT = "velocity_limit"  # custom numeric with the velocity limit of each joint [rad/s]

# What a model may have of each element; some robots with scenes have a few hundred.
MAX_COUNTS = {"nbody": 1000, "njnt": 1000, "nu": 1000, "neq": 1000, "nsite": 2000, "ngeom": 5000, "nkey": 1000}
# Magnitudes that no arm exceeds, for finite simulations in float32: fields of a compiled model by what they are.
MAX_VALUES = {
    "mass [kg]": (1e5, ("body_mass", "body_subtreemass")),
    "inertia [kg m^2]": (1e7, ("body_inertia",)),
    "position [m]": (1e4, ("body_pos", "body_ipos", "jnt_pos", "site_pos", "geom_pos")),
    "orientation": (2.0, ("body_quat", "body_iquat", "site_quat", "geom_quat", "jnt_axis")),
    "size [m]": (1e4, ("site_size",)),
    "joint position [rad or m]": (1e4, ("qpos0", "qpos_spring", "key_qpos")),
    "joint range [rad or m]": (1e4, ("jnt_range",)),
    "rotor inertia [kg m^2]": (1e6, ("dof_armature",)),
    "damping [N m s/rad]": (1e12, ("dof_damping",)),  # Fetch's base is held by 1e11
    "stiffness [N m/rad]": (1e8, ("jnt_stiffness",)),
    "dry friction [N m]": (1e8, ("dof_frictionloss",)),
    "torque limit [N m]": (1e10, ("jnt_actfrcrange",)),
    "actuator parameter": (1e10, ("actuator_forcerange", "actuator_ctrlrange", "actuator_gear", "actuator_gainprm")),
}
MAX_VELOCITY = 1e4  # rad/s; a motor of 100,000 rpm has this speed without a gear


def check_magnitudes(model: Any) -> None:
    """Rejects a compiled model with more elements than an arm has, or with values that are not finite or implausible.

    Raises:
      ValueError: names the quantity, its value and the maximum.
    """
    import numpy as np

    for name, maximum in MAX_COUNTS.items():
        if getattr(model, name) > maximum:
            raise ValueError(f"the model has {name} = {getattr(model, name)}; expected at most {maximum}")
    for quantity, (maximum, names) in MAX_VALUES.items():
        for name in names:
            values = np.asarray(getattr(model, name))
            for place in np.argwhere(~(np.abs(values) <= maximum))[:1]:
                owner, value = _owner(model, name, int(place[0])), values[tuple(place)]
                raise ValueError(
                    f"the model has a {quantity} of {value:g}{owner} ({name}); expected at most {maximum:g}"
                )
    for name in ("body_mass", "body_inertia", "dof_armature", "dof_damping"):
        for place in np.argwhere(np.asarray(getattr(model, name)) < 0)[:1]:
            owner = _owner(model, name, int(place[0]))
            raise ValueError(f"the model has a negative {name}{owner}; expected at least 0")
    for joint, limit in joint_numbers(model, VELOCITY_LIMIT).items():
        if not (0 < limit <= MAX_VELOCITY or limit == math.inf):
            raise ValueError(
                f"the model has a velocity limit of {limit:g} rad/s{_owner(model, 'jnt_range', joint)}; expected a "
                f"number above 0 and of at most {MAX_VELOCITY:g}, or inf for a joint without a limit"
            )


def _owner(model: Any, field: str, index: int) -> str:
    """The element with an entry of a field, as " in joint 'elbow'"; "" where it has no name."""
    kind, _, _ = field.partition("_")
    if kind == "dof":
        kind, index = "jnt", int(model.dof_jntid[index])
    kinds = {"body": "body", "jnt": "joint", "site": "site", "geom": "geom", "actuator": "actuator"}
    name = getattr(model, kinds[kind])(index).name if kind in kinds else ""
    return f" in {kinds[kind]} {name!r}" if name else ""


def joint_numbers(model: Any, name: str) -> dict[int, float]:
    """What a model's custom numerics of a name state for its joints, by joint.

    A numeric has a number for each joint, or for each revolute one. That of an attached model keeps its prefix, and is
    for the joints with this prefix.

    Raises:
      ValueError: another number of numbers.
    """
    import mujoco

    names = [model.joint(joint).name for joint in range(model.njnt)]
    numerics = [model.numeric(number) for number in range(model.nnumeric)]
    stated: dict[int, float] = {}
    for numeric in sorted((x for x in numerics if x.name.endswith(name)), key=lambda x: -len(x.name)):
        prefix = numeric.name.removesuffix(name)
        joints = [joint for joint in range(model.njnt) if names[joint].startswith(prefix)]
        if prefix and not joints:
            continue
        revolute = [joint for joint in joints if model.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_HINGE)]
        own = [joint for joint in joints if joint not in stated]
        data = list(map(float, numeric.data))
        matching = next((ids for ids in (joints, revolute, own) if len(ids) == len(data)), None)
        if matching is None:
            raise ValueError(
                f"the model has {len(data)} numbers in {numeric.name}; expected one for each of {len(joints)} joints, "
                f"or for each of the {len(revolute)} revolute ones"
            )
        stated.update(zip(matching, data, strict=True))
    return stated


def check_in_process(text: str, attached: Mapping[str, str] | None = None, meshes: Iterable[str] = ()) -> list[str]:
    """Compiles a model in a process with limits, before this one does, and checks its magnitudes.

    Args:
      text: the model's XML, which names its files by absolute paths.
      attached: the XML of the models that it attaches, by name.
      meshes: files of meshes without which the model may be read.

    Returns:
      Those of `meshes` that MuJoCo cannot use. Where there are any, the model was not compiled.

    Raises:
      ValueError: MuJoCo rejects the model, crashes, or exceeds a limit; or what `check_magnitudes` rejects.
    """
    from mimic.base.limited_process import call_limited

    arguments = text, dict(attached or {}), list(meshes)
    return call_limited(__file__, "compile_model", *arguments, library="mujoco", what="the model", seconds=SECONDS)


def compile_model(text: str, attached: dict[str, str], meshes: list[str]) -> list[str]:
    """What `check_in_process` runs there."""
    try:
        _compile(text, attached)
    except ValueError:
        unusable = [mesh for mesh in meshes if not _is_usable(mesh)]
        if not unusable:
            raise
        return unusable
    return []


def _is_usable(mesh: str) -> bool:
    """Whether MuJoCo reads a mesh: flat ones, and files of another kind than their names say, it rejects."""
    import mujoco

    spec = mujoco.MjSpec()
    spec.add_mesh(name="mesh", file=mesh)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh")
    try:
        spec.compile()
    except ValueError:
        return False
    return True


def _compile(text: str, attached: dict[str, str]) -> None:
    import mujoco

    warnings: list[str] = []
    mujoco.set_mju_user_warning(warnings.append)
    spec = mujoco.MjSpec.from_string(text, include={name: part.encode() for name, part in attached.items()})
    spec.compiler.usethread = False
    model = spec.compile()
    if any("NaN" in warning for warning in warnings):  # in whatever attribute it is
        raise ValueError("the model has a number that is not a number: NaN")
    check_magnitudes(model)
    mujoco.mj_kinematics(model, mujoco.MjData(model))
