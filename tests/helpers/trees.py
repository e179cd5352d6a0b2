"""Models with several chains, and where MuJoCo sees their links."""

import mujoco
import numpy as np

from mimic.arms.embodiment import Embodiment
from mimic.arms.kinematic_tree import find_chain
from mimic.arms.mujoco_chain import data_at_zero

TORSO_TIPS = ["left_hand", "right_hand"]


def torso(joints: int = 3) -> str:
    """A torso that turns, with two arms of this many joints each and a head that is no part of them."""

    def arm(side: str, y: float) -> str:
        text = ""
        for number in range(joints):
            place = f"0 {y} 0.4" if number == 0 else "0.05 0.02 0.2"
            axis = ("0 1 0", "1 0 0.3", "0 0 1")[number % 3]
            text += (
                f'<body name="{side}_{number}" pos="{place}" quat="1 0.1 {0.2 * y} 0">'
                f'<joint name="{side}_joint{number}" axis="{axis}" pos="0.01 0 0.02" range="-2 2" limited="true"/>'
                '<geom type="capsule" fromto="0 0 0 0.05 0.02 0.2" size="0.03" mass="1"/>'
            )
        length = 0.1 if side == "left" else 0.15
        return text + f'<site name="{side}_hand" pos="0 0 {length}"/>' + "</body>" * joints

    return f"""<mujoco model="torso"><compiler angle="radian"/><worldbody><body name="stand" pos="0.3 0 0.5">
      <geom type="box" size="0.1 0.1 0.1"/>
      <body name="torso" pos="0 0 0.1" quat="1 0 0 0.2"><joint name="waist" axis="0 0.1 1"/>
        <geom type="capsule" fromto="0 0 0 0 0 0.4" size="0.08" mass="5"/>
        {arm("left", 0.2)}{arm("right", -0.2)}
        <body name="head" pos="0 0 0.5"><joint name="neck" axis="0 1 0"/><geom size="0.1" mass="2"/></body>
      </body></body></worldbody></mujoco>"""


def hand(fingers: int = 3, joints: int = 6) -> str:
    """A wrist with fingers of several joints, whose ends have no names of their own."""
    names = ("thumb", "index", "middle", "ring")[:fingers]
    text = ""
    for place, name in enumerate(names):
        text += f'<body name="{name}" pos="0.02 {0.03 * place} 0.1"><joint name="{name}_0" axis="0 1 0.2"/>'
        for number in range(1, joints):
            text += (
                '<geom size="0.005" mass="0.1"/>'
                f'<body name="{name}_{number}" pos="0 0.002 0.03"><joint name="{name}_{number}" axis="0 1 0"/>'
            )
        text += f'<geom type="capsule" fromto="0 0 0 0 0.01 {0.03 + 0.005 * place}" size="0.004" mass="0.1"/>'
        text += "</body>" * joints
    return (
        '<mujoco model="hand"><compiler angle="radian"/><worldbody><body name="forearm"><geom size="0.02" mass="1"/>'
        '<body name="palm" pos="0 0 0.2"><joint name="wrist" axis="1 0 0"/><geom size="0.02" mass="1"/>'
        f"{text}</body></body></worldbody></mujoco>"
    )


def largest_error(model: mujoco.MjModel, arm: Embodiment, tips: list[str], locked: dict[str, float], states) -> float:
    """Maximum error of link states in random poses, against the bodies of MuJoCo to which the links are fixed.

    Args:
      model: of the tree.
      arm: its embodiment.
      tips: of its chains.
      locked: angles of locked joints [rad].
      states: function (qpos, qvel) -> `link_states`, not normalized.
    """
    data, base = mujoco.MjData(model), find_chain(model, None, tips).base
    dofs = [int(model.joint(name).dofadr[0]) for name in arm.joint_names]

    def pose(qpos: np.ndarray, qvel: np.ndarray) -> None:
        data.qpos[:], data.qvel[:] = data_at_zero(model).qpos, 0
        for name, angle in [*locked.items(), *zip(arm.joint_names, qpos, strict=True)]:
            data.qpos[model.joint(name).qposadr[0]] = angle
        data.qvel[dofs] = qvel
        mujoco.mj_forward(model, data)

    pose(np.zeros(arm.num_joints), np.zeros(arm.num_joints))
    R_world_base, origin = data.xmat[base].reshape(3, 3).copy(), data.xpos[base].copy()
    fixed = []  # body of each link, and its position and direction there
    for link, joint in enumerate(arm.link_joint):
        body = base if joint < 0 else int(model.joint(arm.joint_names[joint]).bodyid[0])
        R_world_body = data.xmat[body].reshape(3, 3)
        place = origin + R_world_base @ arm.link_position[link] - data.xpos[body]
        fixed.append((body, R_world_body.T @ place, R_world_body.T @ R_world_base @ arm.link_rotation[link][:, 0]))
    rng, error = np.random.default_rng(0), 0.0
    for _ in range(20):
        qpos, qvel = rng.uniform(*arm.joint_range.T), rng.normal(size=arm.num_joints)
        pose(qpos, qvel)
        result = states(qpos, qvel)
        for link, (body, place, direction) in enumerate(fixed):
            R_world_body, jacobians = data.xmat[body].reshape(3, 3), np.zeros((2, 3, model.nv))
            point = data.xpos[body] + R_world_body @ place
            mujoco.mj_jac(model, data, *jacobians, point, body)
            expected = point - origin, R_world_body @ direction, *(jacobians @ data.qvel)
            actual = result.position, result.direction, result.linear_velocity, result.angular_velocity
            for vector, values in zip(expected, actual, strict=True):
                error = max(error, float(np.abs(R_world_base.T @ vector - np.asarray(values[link])).max()))
    return error
