"""Reads the revolute joints and links of an arm from a MuJoCo model: a serial chain, or a tree."""

import dataclasses
import functools
import logging
import re
from collections.abc import Callable, Sequence

import mujoco
import numpy as np
from jaxtyping import Float

from mimic.arms.chain import SHORTEST_LINK, Chain, Hand, Joint, Link, drop_zero_length
from mimic.arms.compile_check import VELOCITY_LIMIT, joint_numbers
from mimic.arms.hand import ArmEnd, HandChoice, find_end, given_ends
from mimic.arms.kinematic_tree import ChainIds, Tip, find_chain
from mimic.arms.model_tree import is_revolute
from mimic.arms.tool_frames import find_frame

UNKNOWN_HAND = "unknown_hand"  # custom text of a model whose hand frame nothing states, as of a captured person
START_POSES = "ready", "home"  # keyframes with the start pose of a model, in order of preference

# As ints: a MuJoCo enum equals a NumPy integer in one order of the operands and not in the other.
_CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
_ON_JOINT = int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)
_NO_BIAS, _AFFINE_GAIN = int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtGain.mjGAIN_AFFINE)
_WORLD = 0  # body
_LINK, _PREFIXED = re.compile("link"), re.compile(r"(.*[^A-Za-z0-9])?link")  # names of sites
_ALONG_AXIS = 1e-3  # rad; files round directions
_SHORT, _LONG = 0.02, 25.0  # m, of all links together: others are in another unit

_log = logging.getLogger(__name__)


# Above 40 lines because of its docstring.
def read_chain(
    model: mujoco.MjModel,
    base: str | None = None,
    tip: Tip = None,
    hand: HandChoice = None,
    *,
    base_segment: bool = True,
) -> Chain:
    """The revolute joints and links of a model, in a serial chain from body `base` to `tip`, or in a tree to its tips.

    Args:
      model: any.
      base, tip: see `find_chain`.
      hand: see `given_ends`; default: see `find_end`.
      base_segment: add a link from the origin of the base body to the first joint, or to that of each branch at the
        base, unless the model marks its links itself. The world is a base body only where `base` names it.

    Raises:
      ValueError: no revolute joint, a joint of another kind, a branch, a loop, or a name that the model lacks.
    """
    chain_ids, data = find_chain(model, base, tip), data_at_zero(model)
    origin, R_base_world = data.xpos[chain_ids.base], data.xmat[chain_ids.base].reshape(3, 3).T

    def in_base(point: np.ndarray) -> np.ndarray:
        return R_base_world @ (point - origin)

    velocities = joint_numbers(model, VELOCITY_LIMIT)
    index = {joint_id: joint for joint, joint_id in enumerate(chain_ids.joints)}
    paths = [[index[joint_id] for joint_id in chain] for chain in chain_ids.chains]
    joints: list[Joint] = []
    links: list[Link] = []
    for body in chain_ids.bodies:
        for joint_id in (joint for joint in chain_ids.joints if model.jnt_bodyid[joint] == body):
            axis, anchor = R_base_world @ data.xaxis[joint_id], in_base(data.xanchor[joint_id])
            name = model.joint(joint_id).name or f"joint{len(joints) + 1}"
            joints.append(_joint(model, joint_id, name, axis, anchor, velocities.get(joint_id, np.inf)))
        links += _site_links(model, data, body, len(joints) - 1, in_base, paths)
    _check_names(joints)
    ends = _chain_ends(model, data, chain_ids, hand)
    hands = tuple(Hand(in_base(end.point), R_base_world @ end.rotation, path[-1])
                  for end, path in zip(ends, paths, strict=True))  # fmt: skip
    if not links:
        has_base = base_segment and (base is not None or chain_ids.base != _WORLD)
        tips = [found.position for found in hands]
        links = (_base_links(joints, paths) if has_base else []) + _anchor_links(joints, paths, tips)
    if hand is None and mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TEXT, UNKNOWN_HAND) >= 0:
        hands = ()
    length = float(sum(link.length for link in links))
    if not _SHORT <= length <= _LONG:
        _warn_size(length)
    if len(paths) == 1:
        return Chain(tuple(joints), drop_zero_length(links), hands=hands)
    parents = tuple(_parent(joint, paths) for joint in range(len(joints)))
    return Chain(tuple(joints), drop_zero_length(links), parents, chain_ids.names, hands)


@functools.cache  # warns once, though a run builds an arm several times
def _warn_size(length: float) -> None:
    _log.warning("the links of the arm are %.3g m long together: is its file in metres, as MJCF and URDF are?", length)


def _check_names(joints: Sequence[Joint]) -> None:
    names = [joint.name for joint in joints]
    duplicates = sorted({name for name in names if names.count(name) > 1})
    if duplicates:
        raise ValueError(f"two joints of the chain are called {', '.join(duplicates)}; name the unnamed ones in MJCF")


def _parent(joint: int, paths: Sequence[Sequence[int]]) -> int:
    """The joint before this one on the chains, -1 for none."""
    path = next(path for path in paths if joint in path)
    return [-1, *path][path.index(joint)]


def _chains_with(joint: int, paths: Sequence[Sequence[int]]) -> tuple[int, ...]:
    return tuple(number for number, path in enumerate(paths) if joint in path)


def _joint(
    model: mujoco.MjModel, joint_id: int, name: str, axis: np.ndarray, anchor: np.ndarray, velocity_limit: float
) -> Joint:
    """A joint of the model, with axis and anchor in the base frame; home from the keyframe with the start pose."""
    limited = bool(model.jnt_limited[joint_id])
    low, high = map(float, model.jnt_range[joint_id]) if limited else (-np.pi, np.pi)
    start = _start_angle(model, joint_id)
    return Joint(
        name=name,
        axis=axis,
        anchor=anchor,
        range=(low, high),
        torque_limit=_torque_limit(model, joint_id),
        velocity_limit=velocity_limit,
        home=float(np.clip(start, low, high)) if limited else start,
    )


def _site_links(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    body: int,
    joint: int,
    in_base: Callable[[np.ndarray], np.ndarray],
    paths: Sequence[Sequence[int]],
) -> list[Link]:
    """Links that the model marks itself, as capsule sites named link…; start and end as in their `fromto`.

    In a tree the names may have a prefix, as of the models that MuJoCo attaches: left_link1.
    """
    links, pattern = [], _PREFIXED if len(paths) > 1 else _LINK
    for site in (s for s in range(model.nsite) if model.body_weldid[model.site_bodyid[s]] == body):
        name = model.site(site).name
        if pattern.match(name) and model.site_type[site] == _CAPSULE:
            half = data.site_xmat[site].reshape(3, 3)[:, 2] * model.site_size[site, 1]  # points from end to start
            centre, chains = data.site_xpos[site], _chains_with(joint, paths)
            links.append(Link(name, in_base(centre + half), in_base(centre - half), joint, chains=chains))
    return links


def _base_links(joints: Sequence[Joint], paths: Sequence[Sequence[int]]) -> list[Link]:
    """The links from the base body to the first joints; none where they are at the same point.

    A link along the joint's axis rotates with it, as the Panda's first link does; its position is the same either way.
    """
    links = []
    for first in dict.fromkeys(path[0] for path in paths):
        joint = joints[first]
        length = np.linalg.norm(joint.anchor)
        is_along_axis = np.linalg.norm(np.cross(joint.axis, joint.anchor)) <= _ALONG_AXIS * length
        name, chains = "base" if len(paths) == 1 else f"base-{joint.name}", _chains_with(first, paths)
        if length > SHORTEST_LINK:
            links.append(Link(name, np.zeros(3), joint.anchor, first if is_along_axis else -1, chains=chains))
    return links


def _anchor_links(joints: Sequence[Joint], paths: Sequence[Sequence[int]], tips: Sequence[np.ndarray]) -> list[Link]:
    """Links from each joint to the next ones on the chains, and from the last ones to the tips."""
    links: dict[tuple[int, int], Link] = {}  # by the joints at both ends; -1 - number of the chain for a tip
    for number, (path, tip) in enumerate(zip(paths, tips, strict=True)):
        for joint, following in zip(path, [*path[1:], -1 - number], strict=True):
            end = joints[following].anchor if following >= 0 else tip
            known = links.get((joint, following))
            chains = (*(known.chains if known else ()), number)
            links[joint, following] = Link("", joints[joint].anchor, end, joint, chains=chains)
    ends = sorted(links, key=lambda pair: pair[0])  # stable: branches in the order of the chains
    return [dataclasses.replace(links[pair], name=_link_name(pair, ends, joints, len(paths))) for pair in ends]


def _link_name(pair: tuple[int, int], pairs: Sequence[tuple[int, int]], joints: Sequence[Joint], chains: int) -> str:
    """The number of a link on one chain; in a tree its joint, with the next one where links branch."""
    joint, following = pair
    if chains == 1:
        return f"link{joint + 1}"
    branches = sum(first == joint for first, _ in pairs) > 1
    return joints[joint].name + (f"-{joints[following].name if following >= 0 else 'tip'}" if branches else "")


def chain_ends(
    model: mujoco.MjModel, base: str | None = None, tip: Tip = None, hand: HandChoice = None
) -> tuple[ArmEnd, ...]:
    """The end of each chain of an arm, in the world of the model in the zero pose; see `read_chain`."""
    return _chain_ends(model, data_at_zero(model), find_chain(model, base, tip), hand)


def _chain_ends(
    model: mujoco.MjModel, data: mujoco.MjData, chain_ids: ChainIds, hand: HandChoice
) -> tuple[ArmEnd, ...]:
    """The given ends of the chains, or those at the named tips, or those that `find_end` finds."""
    if hand is not None:
        return given_ends(model, data, [chain[-1] for chain in chain_ids.chains], hand)
    ends = []
    for chain, name in zip(chain_ids.chains, chain_ids.tips, strict=True):
        body, paths = int(model.jnt_bodyid[chain[-1]]), [[0]] * len(chain_ids.chains)
        marks = _site_links(model, data, body, 0, lambda point: point, paths)
        tip = find_frame(model, data, name) if name is not None else None
        ends.append(find_end(model, data, chain, tip=tip, marked=marks[-1].end if marks else None))
    return tuple(ends)


def base_pose(model: mujoco.MjModel, base: str | None = None, tip: Tip = None) -> Float[np.ndarray, "4 4"]:
    """Pose of the base frame of an arm in the world of its model, in the zero pose; see `find_chain`."""
    body, data = find_chain(model, base, tip).base, data_at_zero(model)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = data.xmat[body].reshape(3, 3), data.xpos[body]
    return pose


def data_at_zero(model: mujoco.MjModel) -> mujoco.MjData:
    """The model's bodies with revolute joints at 0, and joints of other kinds as in `qpos0`."""
    data = mujoco.MjData(model)
    data.qpos[model.jnt_qposadr[[joint for joint in range(model.njnt) if is_revolute(model, joint)]]] = 0
    mujoco.mj_kinematics(model, data)
    return data


def _start_angle(model: mujoco.MjModel, joint_id: int) -> float:
    """Angle of a joint in the keyframe with the start pose, which may be that of an attached model; 0 without one."""
    joint, start = model.joint(joint_id).name, 0.0
    for pose in reversed(START_POSES):
        for key in sorted((model.key(i) for i in range(model.nkey)), key=lambda key: -len(key.name)):
            if key.name.endswith(pose) and joint.startswith(key.name.removesuffix(pose)):
                start = float(key.qpos[model.jnt_qposadr[joint_id]])
    return start


def _torque_limit(model: mujoco.MjModel, joint_id: int) -> float:
    limits = []
    if model.jnt_actfrclimited[joint_id]:
        limits.append(np.abs(model.jnt_actfrcrange[joint_id]).max())
    for actuator in range(model.nu):
        if int(model.actuator_trntype[actuator]) in _ON_JOINT and model.actuator_trnid[actuator, 0] == joint_id:
            gear = abs(model.actuator_gear[actuator, 0])
            is_motor = model.actuator_biastype[actuator] == _NO_BIAS
            if is_motor and model.actuator_gaintype[actuator] == _AFFINE_GAIN:
                continue  # a damper, which only brakes
            if model.actuator_forcelimited[actuator]:
                limits.append(gear * np.abs(model.actuator_forcerange[actuator]).max())
            if model.actuator_ctrllimited[actuator] and is_motor:
                gain = abs(model.actuator_gainprm[actuator, 0])
                limits.append(gear * gain * np.abs(model.actuator_ctrlrange[actuator]).max())
    return float(min(limits, default=np.inf))
