"""A serial chain of hinges as plain numbers, read from a MuJoCo model, and what locking joints makes of it."""

import dataclasses
import logging
from collections.abc import Iterable, Mapping

import mujoco
import numpy as np

_log = logging.getLogger(__name__)
_SHORTEST_LINK = 1e-6  # m; below this a link has no direction

Locked = Iterable[str | int] | Mapping[str | int, float]


@dataclasses.dataclass(frozen=True)
class Joint:
    """A hinge in the zero pose, in the base frame. Units: m, rad, N m, rad/s."""

    name: str
    axis: np.ndarray
    anchor: np.ndarray
    range: tuple[float, float] = (-np.pi, np.pi)
    torque_limit: float = np.inf
    velocity_limit: float = np.inf


@dataclasses.dataclass(frozen=True)
class Link:
    """A segment in the zero pose, in the base frame, and the index of the joint that moves it (-1: fixed to the base)."""

    name: str
    start: np.ndarray
    end: np.ndarray
    joint: int

    @property
    def length(self) -> float:
        return float(np.linalg.norm(self.end - self.start))


@dataclasses.dataclass(frozen=True)
class Chain:
    """Joints and links from the base to the tip."""

    joints: tuple[Joint, ...]
    links: tuple[Link, ...]


def resolve_locked(locked: Locked, joint_names: tuple[str, ...], angles: Mapping[str, float] | None = None) -> dict[str, float]:
    """Locked joints by name with their angles.

    Args:
      locked: joint names or numbers (1 is the first joint), or a mapping from these to angles [rad].
      joint_names: the arm's joints in order.
      angles: angle by name for joints that `locked` gives no angle for; 0 where absent.

    Raises:
      ValueError: an unknown or duplicate joint, an angle that is not finite, or no joint left.
    """
    if isinstance(locked, str | int):
        locked = (locked,)
    given = dict(locked) if isinstance(locked, Mapping) else None
    result: dict[str, float] = {}
    for joint in locked:
        name = _joint_name(joint, joint_names)
        if name in result:
            raise ValueError(f"locked: joint {name!r} is named twice")
        angle = given[joint] if given is not None else (angles or {}).get(name, 0.0)
        if not np.isfinite(angle):
            raise ValueError(f"locked: the angle of joint {name!r} must be finite, got {angle}")
        result[name] = float(angle)
    if len(result) == len(joint_names):
        raise ValueError(f"locked: all {len(joint_names)} joints are locked; at least one must stay free")
    return result


def _joint_name(joint: str | int, joint_names: tuple[str, ...]) -> str:
    if isinstance(joint, str) and joint in joint_names:
        return joint
    if isinstance(joint, int) and not isinstance(joint, bool) and 1 <= joint <= len(joint_names):
        return joint_names[joint - 1]
    raise ValueError(f"locked: unknown joint {joint!r}; valid are {', '.join(joint_names)} or 1 to {len(joint_names)}")


def lock(chain: Chain, locked: Mapping[str, float], merge: bool = True) -> Chain:
    """The chain that is left when joints are held at an angle.

    Args:
      chain: the free arm.
      locked: angle [rad] by joint name.
      merge: the links that a locked joint connects become one link, first start to last end; else they stay apart.
    """
    rotation, offset = np.eye(3), np.zeros(3)  # what the locked joints so far do to all that comes after them
    moved_by: dict[int, int] = {-1: -1}
    placement: dict[int, tuple[np.ndarray, np.ndarray]] = {-1: (rotation, offset)}
    joints: list[Joint] = []
    for index, joint in enumerate(chain.joints):
        axis, anchor = rotation @ joint.axis, rotation @ joint.anchor + offset
        if joint.name in locked:
            turn = _turn(axis, locked[joint.name])
            rotation, offset = turn @ rotation, turn @ (offset - anchor) + anchor
        else:
            joints.append(dataclasses.replace(joint, axis=axis, anchor=anchor))
        moved_by[index] = len(joints) - 1
        placement[index] = rotation, offset
    links: list[Link] = []
    previous_joint = None
    for link in chain.links:
        turn, shift = placement[link.joint]
        moved = Link(link.name, turn @ link.start + shift, turn @ link.end + shift, moved_by[link.joint])
        if merge and links and links[-1].joint == moved.joint and link.joint != previous_joint:
            moved = dataclasses.replace(moved, name=f"{links[-1].name}+{moved.name}", start=links.pop().start)
        links.append(moved)
        previous_joint = link.joint
    return Chain(tuple(joints), merge_zero_length(links))


def merge_zero_length(links: Iterable[Link]) -> tuple[Link, ...]:
    """Links without those of length zero, which have no direction: the next link, which starts where they do, stands for them."""
    links = tuple(links)
    kept = tuple(link for link in links if link.length > _SHORTEST_LINK)
    dropped = [link.name for link in links if link.length <= _SHORTEST_LINK]
    if dropped:
        _log.warning("links of length zero merged into the next link: %s", ", ".join(dropped))
    if not kept:
        raise ValueError("the arm has no link of a length above zero")
    return kept


def _turn(axis: np.ndarray, angle: float) -> np.ndarray:
    skew = np.cross(np.eye(3), axis)
    return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew


def read_chain(model: mujoco.MjModel, base: str | None = None, tip: str | None = None) -> Chain:
    """The serial chain of hinges of a MuJoCo model, from body `base` to body or site `tip`.

    Raises:
      ValueError: no hinge, a joint of another kind, a branch, a loop, or a name that the model lacks.
    """
    path = chain_bodies(model, base, tip)
    data = mujoco.MjData(model)
    data.qpos[:] = 0
    mujoco.mj_kinematics(model, data)
    base_body = int(model.body_parentid[path[0]]) if base is None else _body_id(model, base)
    T_base = data.xmat[base_body].reshape(3, 3).T

    def in_base(point: np.ndarray) -> np.ndarray:
        return T_base @ (point - data.xpos[base_body])

    joints, links = [], []
    velocity_limits = _velocity_limits(model)
    for body in path:
        for joint_id in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
            joint = model.joint(joint_id)
            limited = bool(model.jnt_limited[joint_id])
            joints.append(
                Joint(
                    name=joint.name or f"joint{len(joints) + 1}",
                    axis=T_base @ data.xaxis[joint_id],
                    anchor=in_base(data.xanchor[joint_id]),
                    range=tuple(map(float, model.jnt_range[joint_id])) if limited else (-np.pi, np.pi),
                    torque_limit=_torque_limit(model, joint_id),
                    velocity_limit=velocity_limits.get(joint_id, np.inf),
                )
            )
        links += _site_links(model, data, body, len(joints) - 1, in_base)
    if not links:
        links = _anchor_links(joints, in_base(_tip_point(model, data, path[-1], tip)))
    return Chain(tuple(joints), merge_zero_length(links))


def chain_bodies(model: mujoco.MjModel, base: str | None = None, tip: str | None = None) -> list[int]:
    """Ids of the bodies with hinges on the way from base to tip, in order."""
    jointed = [body for body in range(1, model.nbody) if model.body_jntnum[body] > 0]
    if tip is not None:
        line = _ancestors(model, _tip_body(model, tip))
        jointed = [body for body in jointed if body in line]
    if base is not None:
        base_id = _body_id(model, base)
        jointed = [body for body in jointed if base_id in _ancestors(model, body) and body != base_id]
    hinge = mujoco.mjtJoint.mjJNT_HINGE
    hinged = [body for body in jointed if any(model.joint(j).type[0] == hinge for j in _joint_ids(model, body))]
    if not hinged:
        raise ValueError("the model has no hinge joint" + (" between base and tip" if base or tip else ""))
    line = _ancestors(model, hinged[-1])
    stray = [body for body in hinged if body not in line]
    if stray:
        names = ", ".join(sorted({model.body(b).name for b in (stray[0], hinged[-1])}))
        raise ValueError(f"the model branches (bodies {names} have hinges on different branches); name one with tip=")
    for joint_id in (j for body in jointed if body in line for j in _joint_ids(model, body)):
        if model.joint(joint_id).type[0] != hinge:
            raise ValueError(f"joint {model.joint(joint_id).name!r} on the chain is not a hinge; start behind it with base=")
    _refuse_loops(model, set(line))
    return hinged


def _refuse_loops(model: mujoco.MjModel, line: set[int]) -> None:
    for equality in range(model.neq):
        kind = model.eq_type[equality]
        first, second = int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])
        if kind == mujoco.mjtEq.mjEQ_JOINT:
            first = int(model.jnt_bodyid[first])
            second = int(model.jnt_bodyid[second]) if second >= 0 else first
        elif kind not in (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD):
            continue
        if first in line - {0} or second in line - {0}:
            raise ValueError(f"the model has a loop: equality constraint {model.eq(equality).name or equality} ties the chain")


def _site_links(model, data, body: int, joint: int, in_base) -> list[Link]:
    """Links that the model marks itself: capsule sites named link…, start and end as in their `fromto`."""
    links = []
    for site in (s for s in range(model.nsite) if model.site_bodyid[s] == body):
        name = model.site(site).name
        if name.startswith("link") and model.site_type[site] == mujoco.mjtGeom.mjGEOM_CAPSULE:
            half = data.site_xmat[site].reshape(3, 3)[:, 2] * model.site_size[site, 1]  # points from end to start
            centre = data.site_xpos[site]
            links.append(Link(name, in_base(centre + half), in_base(centre - half), joint))
    return links


def _anchor_links(joints: list[Joint], tip: np.ndarray) -> list[Link]:
    ends = [joint.anchor for joint in joints[1:]] + [tip]
    return [Link(f"link{i + 1}", joint.anchor, end, i) for i, (joint, end) in enumerate(zip(joints, ends, strict=True))]


def _tip_point(model, data, last: int, tip: str | None) -> np.ndarray:
    """Where the last link ends: the named tip, else the point of the last body's sites, children or geoms that is farthest out."""
    if tip is not None:
        site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, tip)
        return data.site_xpos[site] if site >= 0 else data.xpos[_tip_body(model, tip)]
    carried = [body for body in range(1, model.nbody) if last in _ancestors(model, body)]
    points = [data.site_xpos[s] for s in range(model.nsite) if model.site_bodyid[s] in carried]
    points += [data.xpos[body] for body in carried if body != last]
    points = points or [data.geom_xpos[g] for g in range(model.ngeom) if model.geom_bodyid[g] in carried]
    points = points or [data.xipos[last]]
    anchor = data.xanchor[model.body_jntadr[last] + model.body_jntnum[last] - 1]
    return max(points, key=lambda point: float(np.linalg.norm(point - anchor)))


def _torque_limit(model, joint_id: int) -> float:
    limits = []
    if model.jnt_actfrclimited[joint_id]:
        limits.append(np.abs(model.jnt_actfrcrange[joint_id]).max())
    for actuator in range(model.nu):
        if model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT and model.actuator_trnid[actuator, 0] == joint_id:
            gear = abs(model.actuator_gear[actuator, 0])
            motor = model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_NONE
            if model.actuator_forcelimited[actuator]:
                limits.append(gear * np.abs(model.actuator_forcerange[actuator]).max())
            elif model.actuator_ctrllimited[actuator] and motor:
                gain = abs(model.actuator_gainprm[actuator, 0])
                limits.append(gear * gain * np.abs(model.actuator_ctrlrange[actuator]).max())
    return float(min(limits, default=np.inf))


def _velocity_limits(model) -> dict[int, float]:
    """Rated speeds from the model's custom numeric `velocity_limit`, one for each joint."""
    numeric = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, "velocity_limit")
    return dict(enumerate(map(float, model.numeric(numeric).data))) if numeric >= 0 else {}


def _joint_ids(model, body: int) -> range:
    return range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])


def _ancestors(model, body: int) -> list[int]:
    """The body, its parent, … and the world."""
    line = [int(body)]
    while line[-1] != 0:
        line.append(int(model.body_parentid[line[-1]]))
    return line


def _body_id(model, name: str) -> int:
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    if body < 0:
        names = ", ".join(model.body(b).name for b in range(1, model.nbody))
        raise ValueError(f"the model has no body {name!r}; valid are {names}")
    return body


def _tip_body(model, tip: str) -> int:
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, tip)
    return int(model.site_bodyid[site]) if site >= 0 else _body_id(model, tip)
