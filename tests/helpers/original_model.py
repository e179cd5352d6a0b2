"""Generated models to load, and models of other packages."""

import os
import pathlib
from importlib.util import find_spec
from typing import Any

import mujoco
import numpy as np
import pytest

_UR_LIKE = (  # offset of the body in its parent [m], axis, mass [kg]: a shoulder, two long links, three wrist joints
    ("pan", "0 0 0.16", "0 0 1", 3.7),
    ("lift", "0 0.14 0", "0 1 0", 8.4),
    ("elbow", "0 -0.12 0.42", "0 1 0", 2.3),
    ("wrist_1", "0 0 0.39", "0 1 0", 1.2),
    ("wrist_2", "0 0.1 0", "0 0 1", 1.2),
    ("wrist_3", "0 0 0.1", "0 1 0", 0.2),
)
GRIPPER = """<body name="palm" pos="0 0.1 0"><geom size="0.03" mass="0.3"/><site name="pinch" pos="0 0.08 0"/>
  <body name="left" pos="0.03 0.06 0"><joint name="left" type="slide" axis="1 0 0" range="0 0.04"/>
    <geom size="0.01" mass="0.05"/></body>
  <body name="right" pos="-0.03 0.06 0"><joint name="right" type="slide" axis="-1 0 0" range="0 0.04"/>
    <geom size="0.01" mass="0.05"/></body></body>"""


def ur_like(*, gripper: str = GRIPPER, actuators: str = "motor", named: bool = True, armature: float = 0.1) -> str:
    """MJCF of a six-joint arm with a gripper, gravity, contacts, a coupling of its fingers and a keyframe."""
    opened = ""
    ends = [offset for _, offset, _, _ in _UR_LIKE[1:]] + ["0 0.1 0"]
    for (name, offset, axis, mass), end in zip(_UR_LIKE, ends, strict=True):
        joint = f'name="{name}"' if named else ""
        opened += f"""<body {f'name="{name}_link"' if named else ""} pos="{offset}">
          <joint {joint} axis="{axis}" range="-6.2 6.2" armature="{armature}" damping="{10 * armature}"/>
          <geom type="capsule" size="0.04" fromto="0 0 0 {end}" mass="{mass}"/>"""
    kinds = {
        "motor": '<motor joint="{}" ctrlrange="-150 150"/>',
        "position": '<position joint="{}" kp="2000" kv="400" forcerange="-150 150" ctrlrange="-6 6"/>',
        "none": "",
    }
    acting = "".join(kinds[actuators].format(name) for name, *_ in _UR_LIKE) if named else ""
    coupled = '<equality><joint joint1="left" joint2="right"/></equality>' if gripper == GRIPPER else ""
    return f"""<mujoco model="ur_like"><compiler angle="radian" autolimits="true"/>
      <worldbody><geom type="plane" size="1 1 0.1"/><body name="table" pos="0.2 0.1 0.3" euler="0 0 0.5">
        <geom type="box" size="0.1 0.1 0.05"/>{opened}{gripper}{"</body>" * (len(_UR_LIKE) + 1)}
      </worldbody>{coupled}<actuator>{acting}</actuator></mujoco>"""


def ur_file(folder: pathlib.Path, **options: Any) -> pathlib.Path:
    """A file of `ur_like` in a folder."""
    file = folder / "arm.xml"
    file.write_text(ur_like(**options))
    return file


def urdf(*, mesh: str = "") -> str:
    """URDF of the same kind of arm: four joints, with efforts, speeds and a fixed tool."""
    text, parent = '<robot name="four"><link name="base"/>', "base"
    for number, axis in enumerate(("0 0 1", "0 1 0", "0 1 0", "1 0 0"), start=1):
        shape = f'<collision><geometry><mesh filename="{mesh}"/></geometry></collision>' if mesh else ""
        text += f"""<link name="l{number}">{shape}<inertial><origin xyz="0 0 0.1"/><mass value="2"/>
            <inertia ixx="0.02" iyy="0.02" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
          <joint name="j{number}" type="revolute"><parent link="{parent}"/><child link="l{number}"/>
            <origin xyz="0.02 0 0.25" rpy="0 0.1 0"/><axis xyz="{axis}"/>
            <limit lower="-2.5" upper="2.5" effort="{40 - number}" velocity="{number / 2}"/></joint>"""
        parent = f"l{number}"
    return (
        f'{text}<link name="tool"/><joint name="flange" type="fixed"><parent link="{parent}"/><child link="tool"/>'
        '<origin xyz="0 0 0.15"/></joint></robot>'
    )


def at_rest(model: mujoco.MjModel) -> np.ndarray:
    """Revolute joints at 0, other joints where the model places them."""
    qpos = model.qpos0.copy()
    for joint in range(model.njnt):
        if model.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_HINGE):
            qpos[model.jnt_qposadr[joint]] = 0
    return qpos


def addresses(model: mujoco.MjModel, joint_names: tuple[str, ...]) -> tuple[list[int], list[int]]:
    """Indices of joints in qpos and in qvel."""
    joints = [model.joint(name) for name in joint_names]
    return [int(joint.qposadr[0]) for joint in joints], [int(joint.dofadr[0]) for joint in joints]


def package_file(path: str) -> pathlib.Path:
    """A file of a package, or of the folder MIMIC_ARMS; skips where neither has it."""
    package, _, inside = path.partition("/")
    found = find_spec(package)
    folders = [pathlib.Path(os.environ["MIMIC_ARMS"]) / package] if "MIMIC_ARMS" in os.environ else []
    folders += [pathlib.Path(folder) for folder in (found.submodule_search_locations or [] if found else [])]
    file = next((folder / inside for folder in folders if (folder / inside).is_file()), None)
    if file is None:
        pytest.skip(f"no {path}: install {package}, or unpack its wheel in a folder and name that with MIMIC_ARMS")
    return file
