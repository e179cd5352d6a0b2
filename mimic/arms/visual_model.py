"""An arm's model prepared for rendering: without its scene, and with shapes to draw."""

import mujoco
import numpy as np

from mimic.arms.arm import ArmConfig, arm_spec
from mimic.arms.kinematic_tree import ChainIds, ancestors, find_chain
from mimic.arms.mujoco_chain import zero_pose

_THICKNESS, _COLOUR = 0.03, (0.55, 0.62, 0.70, 1.0)  # of links without geoms; fraction of the chain length
_SCENE_ELEMENTS = ("keys", "equalities", "actuators", "sensors", "tendons", "excludes", "pairs", "lights", "cameras")


def visual_spec(config: ArmConfig) -> tuple[mujoco.MjSpec, np.ndarray]:
    """The model of an arm without the scene around it, and the position of its base [m].

    Raises:
      ValueError: what `arm_spec` and `find_chain` reject.
    """
    spec = arm_spec(config)
    model = spec.compile()
    chain_ids = find_chain(model, config.base, config.tip)
    data = mujoco.MjData(model)
    data.qpos[:] = zero_pose(model)
    mujoco.mj_kinematics(model, data)
    if config.is_file:
        _remove_scene(spec, model, chain_ids)
    if not any(bool(body.geoms) for body in spec.bodies[1:]):
        _draw_links(model, data, spec, chain_ids)
    return spec, data.xpos[model.body_parentid[chain_ids.bodies[0]]].copy()


def _remove_scene(spec: mujoco.MjSpec, model: mujoco.MjModel, chain_ids: ChainIds) -> None:
    """Removes everything but the root body of the arm."""
    for kind in _SCENE_ELEMENTS:
        for item in list(getattr(spec, kind)):
            spec.delete(item)
    root = model.body(ancestors(model, chain_ids.bodies[0])[-2]).name
    for item in [*spec.worldbody.geoms, *spec.worldbody.sites]:
        spec.delete(item)
    for body in [body for body in spec.worldbody.bodies if body.name != root]:
        spec.delete(body)
    visual = [geom for geom in spec.geoms if not (geom.contype or geom.conaffinity)]
    if visual:  # the model has visual geoms, so its collision geoms are hidden
        for geom in spec.geoms:
            if geom not in visual:
                geom.material, geom.rgba = "", [0, 0, 0, 0]


def _draw_links(model: mujoco.MjModel, data: mujoco.MjData, spec: mujoco.MjSpec, chain_ids: ChainIds) -> None:
    """Capsules from each joint to the next, for models without any geom."""
    points = [data.xanchor[joint] for joint in chain_ids.joints]
    distal = [body for body in range(model.nbody) if chain_ids.bodies[-1] in ancestors(model, body)]
    points.append(
        max((data.xpos[body] for body in distal), key=lambda point: float(np.linalg.norm(point - points[-1])))
    )
    lengths = [float(np.linalg.norm(end - start)) for start, end in zip(points[:-1], points[1:], strict=True)]
    for joint, start, end, length in zip(chain_ids.joints, points[:-1], points[1:], lengths, strict=True):
        body = int(model.jnt_bodyid[joint])
        R_body_world = data.xmat[body].reshape(3, 3).T
        if length > _THICKNESS * sum(lengths) / 10:
            spec.body(model.body(body).name).add_geom(
                type=mujoco.mjtGeom.mjGEOM_CAPSULE,
                fromto=np.concatenate([R_body_world @ (point - data.xpos[body]) for point in (start, end)]),
                size=[_THICKNESS * sum(lengths), 0, 0], rgba=_COLOUR, contype=0, conaffinity=0, mass=0,
            )  # fmt: skip
