"""Compiles a model in a process of its own, with limits on time and memory, and checks its magnitudes.

That process runs this file: it must import nothing of mimic at its start.
"""

import math
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
            wrong = values[~(np.abs(values) <= maximum)]
            if wrong.size:
                raise ValueError(f"the model has a {quantity} of {wrong[0]:g} ({name}); expected at most {maximum:g}")
    for name in ("body_mass", "body_inertia", "dof_armature", "dof_damping"):
        if np.any(np.asarray(getattr(model, name)) < 0):
            raise ValueError(f"the model has a negative {name}; expected at least 0")
    for limit in velocity_limits(model):
        if not (0 < limit <= MAX_VELOCITY or limit == math.inf):
            raise ValueError(
                f"the model has a velocity limit of {limit:g} rad/s; expected a number above 0 and of at most "
                f"{MAX_VELOCITY:g}, or inf for a joint without a limit"
            )


def velocity_limits(model: Any) -> list[float]:
    """The velocity limit of each joint of a model [rad/s]; empty where it states none."""
    import mujoco

    numeric = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, VELOCITY_LIMIT)
    return list(map(float, model.numeric(numeric).data)) if numeric >= 0 else []


def check_in_process(text: str) -> None:
    """Compiles a model in a process with limits, before this one does, and checks its magnitudes.

    Args:
      text: the model's XML, which names its files by absolute paths.

    Raises:
      ValueError: MuJoCo rejects the model, crashes, or exceeds a limit; or what `check_magnitudes` rejects.
    """
    from mimic.base.limited_process import call_limited

    call_limited(__file__, "compile_model", text, library="mujoco", what="the model", seconds=SECONDS)


def compile_model(text: str) -> None:
    """What `check_in_process` runs there."""
    import mujoco

    warnings: list[str] = []
    mujoco.set_mju_user_warning(warnings.append)
    spec = mujoco.MjSpec.from_string(text)
    spec.compiler.usethread = False
    model = spec.compile()
    if any("NaN" in warning for warning in warnings):  # in whatever attribute it is
        raise ValueError("the model has a number that is not a number: NaN")
    check_magnitudes(model)
    mujoco.mj_kinematics(model, mujoco.MjData(model))
