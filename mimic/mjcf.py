"""Reads the serial chain of hinges out of a MuJoCo model."""

import os
from collections.abc import Callable

import mujoco
import numpy as np

from mimic.chain import Chain, Joint, Link, drop_zero_length

READY_POSE = "ready"  # the keyframe that holds a model's own start pose

# As ints: MuJoCo's enums equal an integer of NumPy's in one order of the operands and not in the other.
_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
_CAPSULE, _CYLINDER = int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_CYLINDER)
_COUPLED_JOINTS = int(mujoco.mjtEq.mjEQ_JOINT)
_CONNECT, _WELD = int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)
_SITE = int(mujoco.mjtObj.mjOBJ_SITE)
_ON_JOINT = int(mujoco.mjtTrn.mjTRN_JOINT)
_NO_BIAS = int(mujoco.mjtBias.mjBIAS_NONE)


def read_model(path: str | os.PathLike[str]) -> mujoco.MjModel:
    """The compiled model of an MJCF file.

    Raises:
      ValueError: no such file, or MuJoCo cannot read it.
    """
    if not os.path.isfile(path):
        raise ValueError(f"no MJCF file at {os.fspath(path)!r}")
    try:
        return mujoco.MjModel.from_xml_path(os.fspath(path))
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{os.fspath(path)!r} is not an MJCF model that MuJoCo reads: {reason}") from error


def model_name(model: mujoco.MjModel) -> str:
    """The name that the MJCF gives itself."""
    return model.names[: model.names.index(b"\0")].decode()


def read_chain(model: mujoco.MjModel, base: str | None = None, tip: str | None = None) -> Chain:
    """The serial chain of hinges of a model, from body `base` to body or site `tip`.

    Raises:
      ValueError: no hinge, a joint of another kind, a branch, a loop, or a name that the model lacks.
    """
    path = _chain_bodies(model, base, tip)
    data = mujoco.MjData(model)
    data.qpos[:] = 0
    mujoco.mj_kinematics(model, data)
    base_body = int(model.body_parentid[path[0]]) if base is None else _body_id(model, base)
    origin, R_base_world = data.xpos[base_body], data.xmat[base_body].reshape(3, 3).T

    def in_base(point: np.ndarray) -> np.ndarray:
        return R_base_world @ (point - origin)

    velocity_limits = _velocity_limits(model)
    key = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, READY_POSE)
    joints: list[Joint] = []
    links: list[Link] = []
    for body in path:
        for joint_id in _joint_ids(model, body):
            joint = model.joint(joint_id)
            limited = bool(model.jnt_limited[joint_id])
            low, high = map(float, model.jnt_range[joint_id]) if limited else (-np.pi, np.pi)
            start = float(model.key_qpos[key, model.jnt_qposadr[joint_id]]) if key >= 0 else 0.0
            joints.append(
                Joint(
                    name=joint.name or f"joint{len(joints) + 1}",
                    axis=R_base_world @ data.xaxis[joint_id],
                    anchor=in_base(data.xanchor[joint_id]),
                    range=(low, high),
                    torque_limit=_torque_limit(model, joint_id),
                    velocity_limit=velocity_limits.get(joint_id, np.inf),
                    home=float(np.clip(start, low, high)) if limited else start,
                )
            )
        links += _site_links(model, data, body, len(joints) - 1, in_base)
    names = [joint.name for joint in joints]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"two joints of the chain are called {', '.join(twice)}; name the unnamed ones in the MJCF")
    if not links:
        links = _anchor_links(joints, in_base(_tip_point(model, data, path[-1], tip)))
    return Chain(tuple(joints), drop_zero_length(links))


def _chain_bodies(model: mujoco.MjModel, base: str | None, tip: str | None) -> list[int]:
    """Ids of the bodies with hinges on the way from base to tip, in order."""
    jointed = [body for body in range(1, model.nbody) if model.body_jntnum[body] > 0]
    if tip is not None:
        line = _ancestors(model, _tip_body(model, tip))
        jointed = [body for body in jointed if body in line]
    if base is not None:
        base_id = _body_id(model, base)
        jointed = [body for body in jointed if body != base_id and base_id in _ancestors(model, body)]
    hinged = [body for body in jointed if any(_is_hinge(model, joint) for joint in _joint_ids(model, body))]
    if not hinged:
        raise ValueError("the model has no hinge joint" + (" between base and tip" if base or tip else ""))
    line = _ancestors(model, hinged[-1])
    stray = [body for body in hinged if body not in line]
    if stray:
        names = ", ".join(repr(model.body(body).name) for body in (stray[-1], hinged[-1]))
        raise ValueError(f"the model branches: bodies {names} have hinges on different branches; name one with tip=")
    for joint in (joint for body in jointed if body in line for joint in _joint_ids(model, body)):
        if not _is_hinge(model, joint):
            name = model.joint(joint).name
            raise ValueError(f"expected hinges only; joint {name!r} on the chain is none: start behind it with base=")
    _refuse_loops(model, hinged)
    return hinged


def _refuse_loops(model: mujoco.MjModel, path: list[int]) -> None:
    """Refuses an equality constraint on the chain's joints, or between bodies that these joints move apart."""
    for equality in (i for i in range(model.neq) if model.eq_active0[i]):
        kind, objects = model.eq_type[equality], (model.eq_obj1id[equality], model.eq_obj2id[equality])
        if kind == _COUPLED_JOINTS:
            between = {int(model.jnt_bodyid[joint]) for joint in objects if joint >= 0}
        elif kind in (_CONNECT, _WELD):
            on_sites = model.eq_objtype[equality] == _SITE
            first, second = (model.site_bodyid[item] if on_sites else item for item in objects)
            between = set(_ancestors(model, first)) ^ set(_ancestors(model, second))
        else:
            continue
        if between & set(path):
            name = model.eq(equality).name or f"number {equality + 1}"
            raise ValueError(f"expected a serial chain; the model has a loop, closed by equality constraint {name}")


def _site_links(
    model: mujoco.MjModel, data: mujoco.MjData, body: int, joint: int, in_base: Callable[[np.ndarray], np.ndarray]
) -> list[Link]:
    """Links that the model marks itself: capsule sites named link…, start and end as in their `fromto`."""
    links = []
    for site in (s for s in range(model.nsite) if model.body_weldid[model.site_bodyid[s]] == body):
        name = model.site(site).name
        if name.startswith("link") and model.site_type[site] == _CAPSULE:
            half = data.site_xmat[site].reshape(3, 3)[:, 2] * model.site_size[site, 1]  # points from end to start
            centre = data.site_xpos[site]
            links.append(Link(name, in_base(centre + half), in_base(centre - half), joint))
    return links


def _anchor_links(joints: list[Joint], tip: np.ndarray) -> list[Link]:
    ends = [joint.anchor for joint in joints[1:]] + [tip]
    return [Link(f"link{i + 1}", joint.anchor, end, i) for i, (joint, end) in enumerate(zip(joints, ends, strict=True))]


def _tip_point(model: mujoco.MjModel, data: mujoco.MjData, last: int, tip: str | None) -> np.ndarray:
    """Where the last link ends.

    The named tip, else the farthest of the sites and bodies that the last body carries, else of its geoms' ends.
    """
    if tip is not None:
        site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, tip)
        return data.site_xpos[site] if site >= 0 else data.xpos[_tip_body(model, tip)]
    carried = [body for body in range(1, model.nbody) if last in _ancestors(model, body)]
    points = [data.site_xpos[site] for site in range(model.nsite) if model.site_bodyid[site] in carried]
    points += [data.xpos[body] for body in carried if body != last]
    if not points:
        for geom in (g for g in range(model.ngeom) if model.geom_bodyid[g] in carried):
            is_rod = model.geom_type[geom] in (_CAPSULE, _CYLINDER)
            half = data.geom_xmat[geom].reshape(3, 3)[:, 2] * (model.geom_size[geom, 1] if is_rod else 0)
            points += [data.geom_xpos[geom] + half, data.geom_xpos[geom] - half]
    anchor = data.xanchor[_joint_ids(model, last)[-1]]
    return max(points or [data.xipos[last]], key=lambda point: float(np.linalg.norm(point - anchor)))


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
            elif model.actuator_ctrllimited[actuator] and is_motor:
                gain = abs(model.actuator_gainprm[actuator, 0])
                limits.append(gear * gain * np.abs(model.actuator_ctrlrange[actuator]).max())
    return float(min(limits, default=np.inf))


def _velocity_limits(model: mujoco.MjModel) -> dict[int, float]:
    """Rated speeds from the model's custom numeric `velocity_limit`, one for each joint."""
    numeric = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, "velocity_limit")
    return dict(enumerate(map(float, model.numeric(numeric).data))) if numeric >= 0 else {}


def _joint_ids(model: mujoco.MjModel, body: int) -> range:
    return range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])


def _is_hinge(model: mujoco.MjModel, joint: int) -> bool:
    return int(model.jnt_type[joint]) == _HINGE


def _ancestors(model: mujoco.MjModel, body: int) -> list[int]:
    """The body, its parent, … and the world."""
    line = [int(body)]
    while line[-1] != 0:
        line.append(int(model.body_parentid[line[-1]]))
    return line


def _body_id(model: mujoco.MjModel, name: str) -> int:
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    if body < 0:
        names = ", ".join(model.body(b).name or f"#{b}" for b in range(1, model.nbody))
        raise ValueError(f"the model has no body {name!r}; valid are {names}")
    return body


def _tip_body(model: mujoco.MjModel, tip: str) -> int:
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, tip)
    if site >= 0:
        return int(model.site_bodyid[site])
    try:
        return _body_id(model, tip)
    except ValueError as error:
        sites = ", ".join(filter(None, (model.site(s).name for s in range(model.nsite)))) or "none"
        raise ValueError(f"{error}, nor a site of that name; valid are {sites}") from None
