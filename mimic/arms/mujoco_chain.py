"""Reads a serial chain of revolute joints from a MuJoCo model."""

from collections.abc import Callable

import mujoco
import numpy as np

from mimic.arms.chain import SHORTEST_LINK, Chain, Joint, Link, drop_zero_length
from mimic.arms.compile_check import VELOCITY_LIMIT
from mimic.arms.kinematic_tree import ChainIds, ancestors, body_id, find_chain, is_revolute, tip_body

START_POSES = "ready", "home"  # keyframes with the start pose of a model, in order of preference

# As ints: a MuJoCo enum equals a NumPy integer in one order of the operands and not in the other.
_CAPSULE, _CYLINDER = int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_CYLINDER)
_ON_JOINT = int(mujoco.mjtTrn.mjTRN_JOINT)
_NO_BIAS = int(mujoco.mjtBias.mjBIAS_NONE)
_WORLD = 0  # body
_ALONG_AXIS = 1e-3  # rad; files round directions


# Above 40 lines because of its docstring.
def read_chain(
    model: mujoco.MjModel, base: str | None = None, tip: str | None = None, *, base_segment: bool = True
) -> Chain:
    """The serial chain of revolute joints of a model, from body `base` to body or site `tip`.

    Args:
      model: any.
      base, tip: see `find_chain`.
      base_segment: add a link from the origin of the base body to the first joint, unless the model marks its links
        itself. The world is a base body only where `base` names it.

    Raises:
      ValueError: no revolute joint, a joint of another kind, a branch, a loop, or a name that the model lacks.
    """
    chain_ids = find_chain(model, base, tip)
    path = chain_ids.bodies
    data = mujoco.MjData(model)
    data.qpos[:] = zero_pose(model)
    mujoco.mj_kinematics(model, data)
    base_body = int(model.body_parentid[path[0]]) if base is None else body_id(model, base)
    origin, R_base_world = data.xpos[base_body], data.xmat[base_body].reshape(3, 3).T

    def in_base(point: np.ndarray) -> np.ndarray:
        return R_base_world @ (point - origin)

    joints: list[Joint] = []
    links: list[Link] = []
    for body in path:
        for joint_id in (joint for joint in chain_ids.joints if model.jnt_bodyid[joint] == body):
            axis, anchor = R_base_world @ data.xaxis[joint_id], in_base(data.xanchor[joint_id])
            joints.append(_joint(model, joint_id, axis, anchor, f"joint{len(joints) + 1}"))
        links += _site_links(model, data, body, len(joints) - 1, in_base)
    names = [joint.name for joint in joints]
    duplicates = sorted({name for name in names if names.count(name) > 1})
    if duplicates:
        raise ValueError(f"two joints of the chain are called {', '.join(duplicates)}; name the unnamed ones in MJCF")
    if not links:
        has_base = base_segment and (base is not None or base_body != _WORLD)
        links = _base_links(joints[0]) if has_base else []
        links += _anchor_links(joints, in_base(_tip_point(model, data, chain_ids, tip)))
    return Chain(tuple(joints), drop_zero_length(links))


def _joint(model: mujoco.MjModel, joint_id: int, axis: np.ndarray, anchor: np.ndarray, default_name: str) -> Joint:
    """A joint of the model, with axis and anchor in the base frame; home from the keyframe with the start pose."""
    key = _start_keyframe(model)
    limited = bool(model.jnt_limited[joint_id])
    low, high = map(float, model.jnt_range[joint_id]) if limited else (-np.pi, np.pi)
    start = float(model.key_qpos[key, model.jnt_qposadr[joint_id]]) if key >= 0 else 0.0
    return Joint(
        name=model.joint(joint_id).name or default_name,
        axis=axis,
        anchor=anchor,
        range=(low, high),
        torque_limit=_torque_limit(model, joint_id),
        velocity_limit=_velocity_limits(model).get(joint_id, np.inf),
        home=float(np.clip(start, low, high)) if limited else start,
    )


def _site_links(
    model: mujoco.MjModel, data: mujoco.MjData, body: int, joint: int, in_base: Callable[[np.ndarray], np.ndarray]
) -> list[Link]:
    """Links that the model marks itself, as capsule sites named link…; start and end as in their `fromto`."""
    links = []
    for site in (s for s in range(model.nsite) if model.body_weldid[model.site_bodyid[s]] == body):
        name = model.site(site).name
        if name.startswith("link") and model.site_type[site] == _CAPSULE:
            half = data.site_xmat[site].reshape(3, 3)[:, 2] * model.site_size[site, 1]  # points from end to start
            centre = data.site_xpos[site]
            links.append(Link(name, in_base(centre + half), in_base(centre - half), joint))
    return links


def _base_links(first: Joint) -> list[Link]:
    """The link from the base body to the first joint; none where they are at the same point.

    A link along the joint's axis rotates with it, as the Panda's first link does; its position is the same either way.
    """
    length = np.linalg.norm(first.anchor)
    is_along_axis = np.linalg.norm(np.cross(first.axis, first.anchor)) <= _ALONG_AXIS * length
    link = Link("base", np.zeros(3), first.anchor, 0 if is_along_axis else -1)
    return [link] if length > SHORTEST_LINK else []


def _anchor_links(joints: list[Joint], tip: np.ndarray) -> list[Link]:
    ends = [joint.anchor for joint in joints[1:]] + [tip]
    return [Link(f"link{i + 1}", joint.anchor, end, i) for i, (joint, end) in enumerate(zip(joints, ends, strict=True))]


def _tip_point(model: mujoco.MjModel, data: mujoco.MjData, chain_ids: ChainIds, tip: str | None) -> np.ndarray:
    """End of the last link.

    The named tip; else the farthest site or body distal to the last joint; else the farthest end of a geom; else the
    centre of mass of the last body.
    """
    if tip is not None:
        site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, tip)
        return data.site_xpos[site] if site >= 0 else data.xpos[tip_body(model, tip)]
    last = chain_ids.bodies[-1]
    subtree = [body for body in range(1, model.nbody) if last in ancestors(model, body)]
    points = [data.site_xpos[site] for site in range(model.nsite) if model.site_bodyid[site] in subtree]
    points += [data.xpos[body] for body in subtree if body != last]
    anchor = data.xanchor[chain_ids.joints[-1]]

    def distance(point: np.ndarray) -> float:
        return float(np.linalg.norm(point - anchor))

    def is_at_anchor() -> bool:
        return max(map(distance, points), default=0.0) <= SHORTEST_LINK

    if is_at_anchor():
        points += _geom_ends(model, data, subtree)
    if is_at_anchor():
        points = [data.xipos[last]]
    return max(points, key=distance)


def _geom_ends(model: mujoco.MjModel, data: mujoco.MjData, bodies: list[int]) -> list[np.ndarray]:
    points = []
    for geom in (g for g in range(model.ngeom) if model.geom_bodyid[g] in bodies):
        is_rod = model.geom_type[geom] in (_CAPSULE, _CYLINDER)
        half = data.geom_xmat[geom].reshape(3, 3)[:, 2] * (model.geom_size[geom, 1] if is_rod else 0)
        points += [data.geom_xpos[geom] + half, data.geom_xpos[geom] - half]
    return points


def zero_pose(model: mujoco.MjModel) -> np.ndarray:
    """The model's pose [nq] with revolute joints at 0, and joints of other kinds as in `qpos0`."""
    qpos = np.array(model.qpos0)
    revolute = [joint for joint in range(model.njnt) if is_revolute(model, joint)]
    qpos[model.jnt_qposadr[revolute]] = 0
    return qpos


def _start_keyframe(model: mujoco.MjModel) -> int:
    """Id of the keyframe with the start pose; -1 where there is none."""
    keys = (mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, name) for name in START_POSES)
    return next((key for key in keys if key >= 0), -1)


def _torque_limit(model: mujoco.MjModel, joint_id: int) -> float:
    limits = []
    if model.jnt_actfrclimited[joint_id]:
        limits.append(np.abs(model.jnt_actfrcrange[joint_id]).max())
    for actuator in range(model.nu):
        if model.actuator_trntype[actuator] == _ON_JOINT and model.actuator_trnid[actuator, 0] == joint_id:
            gear = abs(model.actuator_gear[actuator, 0])
            is_motor = model.actuator_biastype[actuator] == _NO_BIAS
            if model.actuator_forcelimited[actuator]:
                limits.append(gear * np.abs(model.actuator_forcerange[actuator]).max())
            if model.actuator_ctrllimited[actuator] and is_motor:
                gain = abs(model.actuator_gainprm[actuator, 0])
                limits.append(gear * gain * np.abs(model.actuator_ctrlrange[actuator]).max())
    return float(min(limits, default=np.inf))


def _velocity_limits(model: mujoco.MjModel) -> dict[int, float]:
    """Velocity limits [rad/s] by joint id, from the model's custom numeric of that name."""
    numeric = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, VELOCITY_LIMIT)
    return dict(enumerate(map(float, model.numeric(numeric).data))) if numeric >= 0 else {}
