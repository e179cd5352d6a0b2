"""Random serial arms as MJCF, and their link states by C MuJoCo."""

import mujoco
import numpy as np

SEEDS = range(20)
_REACH = 0.15  # m: offsets of bodies, anchors and link ends in each axis


def has_link_sites(seed: int) -> bool:
    """Whether the arm of this seed marks its links by capsule sites; else they run from anchor to anchor."""
    return seed % 3 == 0


def random_arm(seed: int, joints: int | None = None) -> mujoco.MjModel:
    """A serial arm with the given number of revolute joints; 1 to 9 by the seed where None.

    Random axes, anchors and body rotations, with static bodies proximal to, between and distal to the moving ones. Some
    joints have a reference angle other than 0; some bodies of the arms without link sites have two joints with one
    anchor, so that the link between these has length zero.
    """
    rng = np.random.default_rng(seed)
    opened, num_joints, joints = [], 0, joints or 1 + seed % 9
    while num_joints < joints:
        if rng.random() < 0.4:
            opened.append(f"<body {_pose(rng)}>")
        opened.append(f'<body {_pose(rng)}><geom size="0.02"/>')
        anchor = _text(rng.uniform(-_REACH, _REACH, 3))
        twins = not has_link_sites(seed) and num_joints + 2 <= joints and rng.random() < 0.25
        for _ in range(2 if twins else 1):
            num_joints += 1
            ref = rng.choice([0.0, rng.uniform(-1, 1)])
            opened[-1] += (
                f'<joint name="joint{num_joints}" pos="{anchor}" axis="{_text(rng.normal(size=3))}" ref="{ref}"/>'
            )
        if has_link_sites(seed):
            site = f'<site name="link{num_joints}" fromto="{_text(rng.uniform(-_REACH, _REACH, 6))}"/>'
            opened[-1] += site if rng.random() < 0.5 else f"<body {_pose(rng)}>{site}</body>"
    opened[-1] += f'<site name="tip" type="sphere" pos="{_text(rng.uniform(-_REACH, _REACH, 3))}"/>'
    xml = f"""<mujoco model="random{seed}">
      <compiler angle="radian"/>
      <default><site type="capsule" size="0.01"/></default>
      <worldbody>{"".join(opened)}{"</body>" * sum(part.count("<body") - part.count("</body") for part in opened)}
      </worldbody>
    </mujoco>"""
    return mujoco.MjModel.from_xml_string(xml)


def posed(model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray | None = None) -> mujoco.MjData:
    """The model's state after `mj_forward`."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    data.qvel[:] = 0 if qvel is None else qvel
    mujoco.mj_forward(model, data)
    return data


def links(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    link_names: tuple[str, ...],
    joint_names: tuple[str, ...] = (),
    tip: str = "tip",
) -> dict[str, np.ndarray]:
    """The expected unnormalized `link_states`, from MuJoCo's positions and velocities.

    Links are found by name: "link2", or "link2+link3" for links that a locked joint merges.

    Args:
      model: of the arm.
      data: its state.
      link_names: of the arm.
      joint_names: of the arm; default: all joints of the model.
      tip: the site or body where the last link ends.
    """
    joints = [model.joint(name).id for name in joint_names] or list(range(model.njnt))
    base = int(model.body_parentid[model.jnt_bodyid[joints[0]]])
    R_base_world, origin = data.xmat[base].reshape(3, 3).T, data.xpos[base]
    rows = []
    for name in link_names:
        first, last = name.split("+")[0], name.split("+")[-1]
        start, end, body = _segment(model, data, first, joints, tip)[0], *_segment(model, data, last, joints, tip)[1:]
        velocity = np.zeros(6)  # [omega, v] at the body's origin, in the axes of the world
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 0)
        centre = (start + end) / 2
        linear = velocity[3:] + np.cross(velocity[:3], centre - data.xpos[body])
        direction = (end - start) / np.linalg.norm(end - start)
        rows.append((R_base_world @ (centre - origin), *(R_base_world @ x for x in (direction, linear, velocity[:3]))))
    position, direction, linear_velocity, angular_velocity = map(np.stack, zip(*rows, strict=True))
    return {
        "position": position,
        "direction": direction,
        "linear_velocity": linear_velocity,
        "angular_velocity": angular_velocity,
    }


def link_rotations(model: mujoco.MjModel, data: mujoco.MjData, link_names: tuple[str, ...]) -> np.ndarray:
    """Rotations [n, 3, 3] of the bodies that carry the links, in the base frame."""
    base = int(model.body_parentid[model.jnt_bodyid[0]])
    bodies = [_segment(model, data, name.split("+")[-1], list(range(model.njnt)), "tip")[2] for name in link_names]
    return np.stack([data.xmat[base].reshape(3, 3).T @ data.xmat[body].reshape(3, 3) for body in bodies])


def _segment(
    model: mujoco.MjModel, data: mujoco.MjData, link: str, joints: list[int], tip: str
) -> tuple[np.ndarray, np.ndarray, int]:
    """Start, end and body of one link: its site, else from its joint's anchor to the next one's, or to the tip.

    The link "base" runs from the body that carries the arm to the first anchor. It rotates with the first joint if that
    joint's axis is along it.
    """
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, link)
    if site >= 0:
        half = data.site_xmat[site].reshape(3, 3)[:, 2] * model.site_size[site, 1]  # z points from end to start
        return data.site_xpos[site] + half, data.site_xpos[site] - half, int(model.site_bodyid[site])
    if link == "base":
        body, anchor = int(model.jnt_bodyid[joints[0]]), data.xanchor[joints[0]]
        base = int(model.body_parentid[body])
        is_off_axis = np.linalg.norm(np.cross(data.xaxis[joints[0]], anchor - data.xpos[base])) > 1e-3
        return data.xpos[base], anchor, base if is_off_axis else body
    joint, is_site = int(link.removeprefix("link")) - 1, mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, tip) >= 0
    end = data.site(tip).xpos if is_site else data.body(tip).xpos
    end = data.xanchor[joints[joint + 1]] if joint + 1 < len(joints) else end
    return data.xanchor[joints[joint]], end, int(model.jnt_bodyid[joints[joint]])


def _pose(rng: np.random.Generator) -> str:
    return f'pos="{_text(rng.uniform(-_REACH, _REACH, 3))}" quat="{_text(rng.normal(size=4))}"'


def _text(numbers: np.ndarray) -> str:
    return " ".join(map(str, numbers))
