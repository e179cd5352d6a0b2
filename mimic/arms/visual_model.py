"""An arm's model prepared for rendering: without its scene, and with shapes and hand frames to draw."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from mimic.arms.arm import ArmConfig, arm_spec, build_arm
from mimic.arms.embodiment import Embodiment, load_mjcf
from mimic.arms.kinematic_tree import ChainIds, find_chain
from mimic.arms.link_match import Colour
from mimic.arms.model_tree import ancestors
from mimic.arms.mujoco_chain import base_pose, data_at_zero

_THICKNESS, _COLOUR = 0.03, (0.55, 0.62, 0.70, 1.0)  # of links without geoms; fraction of the chain length
_HAND_LENGTH, _HAND_THICKNESS = 0.07, 0.006  # of the lines of a hand frame; fractions of the chain length
HAND_LINE, _HAND_LINES = "hand frame ", ("x", "y", "z", "finger", "other finger", "palm")  # names of geoms
_FINGERS, _AXES = (0.1, 0.1, 0.1, 1.0), ((0.9, 0.15, 0.15, 1.0), (0.1, 0.65, 0.2, 1.0), (0.15, 0.3, 0.95, 1.0))
_DARK = 0.4  # maximum channel of a dark colour
_SCENE_ELEMENTS = ("keys", "equalities", "actuators", "sensors", "tendons", "excludes", "pairs", "lights", "cameras")


def visual_spec(
    config: ArmConfig, limits: str = "none", colours: Mapping[str, Colour] | None = None
) -> tuple[mujoco.MjSpec, Float[np.ndarray, "4 4"]]:
    """The model of an arm without the scene around it, and the transform from its base frame to the world.

    Args:
      config: of the arm.
      limits: see `EnvConfig`.
      colours: colours of links by name. Default None: those of the model.

    Raises:
      ValueError: what `arm_spec` and `find_chain` reject.
    """
    spec = arm_spec(config)
    spec.compiler.discardvisual = False  # hands and marks are visual, which MuJoCo discards in a URDF
    for number, body in enumerate(spec.bodies):  # links are found by the names of their bodies
        body.name = body.name or f"unnamed body {number}"
    model = spec.compile()
    chain_ids = find_chain(model, config.base, config.tip)
    if config.is_file:
        _remove_scene(spec, model, chain_ids)
    if not any(bool(body.geoms) for body in spec.bodies[1:]):
        for joints in chain_ids.chains:
            _draw_links(model, data_at_zero(model), spec, joints)
    if colours:
        links = body_links(model, config, limits)
        by_body = {model.body(body).name: colours[link] for body, link in links.items() if link in colours}
        for body in spec.bodies[1:]:
            if body.name in by_body:
                _colour_geoms(spec, body, by_body[body.name])
    _draw_hands(model, spec, config, chain_ids)
    return spec, base_pose(model, config.base, config.tip)


def body_links(model: mujoco.MjModel, config: ArmConfig, limits: str) -> dict[int, str]:
    """The link that each moving body belongs to, by the body's id.

    A body between two joints belongs to the longest link that its joint moves; where that joint moves none, because the
    joints are at one point, to the next link.
    """
    free = build_arm(dataclasses.replace(config, locked=()), limits).embodiment
    chain_ids = find_chain(model, config.base, config.tip)
    bodies = [int(model.jnt_bodyid[joint]) for joint in chain_ids.joints]
    links = {}
    for body in range(1, model.nbody):
        line = ancestors(model, body)
        joints = [joint for joint, moved in enumerate(bodies) if moved in line]
        if joints:
            links[body] = free.link_names[_moved_link(free, joints[-1])]
    return links


def _moved_link(arm: Embodiment, joint: int) -> int:
    moved = [link for link, mover in enumerate(arm.link_joint) if mover == joint]
    if moved:
        return max(moved, key=lambda link: float(arm.link_lengths[link]))
    distal, proximal = {joint}, {joint}
    for index, parent in enumerate(arm.joint_parent):
        distal |= {index} if parent in distal else set()
    while -1 not in proximal:
        proximal.add(arm.joint_parent[min(proximal)])
    nearest = max((link for link, mover in enumerate(arm.link_joint) if mover in proximal), default=0)
    return next((link for link, mover in enumerate(arm.link_joint) if mover in distal), nearest)


def is_dark(rgba: Sequence[float] | np.ndarray) -> bool:
    """Whether a geom keeps its colour where links are coloured: dark parts are joints, which structure the arm."""
    return max(rgba[:3]) < _DARK


def _colour_geoms(spec: mujoco.MjSpec, body: Any, colour: Colour) -> None:
    """Colours the visible geoms of a body, except dark ones where it has others."""
    rgba = {geom: np.asarray(spec.material(geom.material).rgba if geom.material else geom.rgba) for geom in body.geoms}
    visible = [geom for geom in body.geoms if rgba[geom][3] > 0]
    for geom in [geom for geom in visible if not is_dark(rgba[geom])] or visible:
        geom.material, geom.rgba = "", [*colour, 1.0]


def _remove_scene(spec: mujoco.MjSpec, model: mujoco.MjModel, chain_ids: ChainIds) -> None:
    """Removes everything but the root bodies of the arm."""
    for kind in _SCENE_ELEMENTS:
        for item in list(getattr(spec, kind)):
            spec.delete(item)
    roots = {model.body(ancestors(model, root)[-2]).name for root in chain_ids.roots(model)}
    for item in [*spec.worldbody.geoms, *spec.worldbody.sites]:
        spec.delete(item)
    for body in [body for body in spec.worldbody.bodies if body.name not in roots]:
        spec.delete(body)
    visual = [geom for geom in spec.geoms if not (geom.contype or geom.conaffinity)]
    if visual:  # the model has visual geoms, so its collision geoms are hidden
        for geom in spec.geoms:
            if geom not in visual:
                geom.material, geom.rgba = "", [0, 0, 0, 0]


def _draw_links(model: mujoco.MjModel, data: mujoco.MjData, spec: mujoco.MjSpec, joints: Sequence[int]) -> None:
    """Capsules from each joint of a chain to the next, for models without any geom."""
    points = [data.xanchor[joint] for joint in joints]
    distal = [body for body in range(model.nbody) if model.jnt_bodyid[joints[-1]] in ancestors(model, body)]
    points.append(
        max((data.xpos[body] for body in distal), key=lambda point: float(np.linalg.norm(point - points[-1])))
    )
    lengths = [float(np.linalg.norm(end - start)) for start, end in zip(points[:-1], points[1:], strict=True)]
    for joint, start, end, length in zip(joints, points[:-1], points[1:], lengths, strict=True):
        body = int(model.jnt_bodyid[joint])
        R_body_world = data.xmat[body].reshape(3, 3).T
        if length > _THICKNESS * sum(lengths) / 10:
            spec.body(model.body(body).name).add_geom(
                type=mujoco.mjtGeom.mjGEOM_CAPSULE,
                fromto=np.concatenate([R_body_world @ (point - data.xpos[body]) for point in (start, end)]),
                size=[_THICKNESS * sum(lengths), 0, 0], rgba=_COLOUR, contype=0, conaffinity=0, mass=0,
            )  # fmt: skip


def _draw_hands(model: mujoco.MjModel, spec: mujoco.MjSpec, config: ArmConfig, chain_ids: ChainIds) -> None:
    """The axes of each hand frame (x red, y green, z blue), and a fork that opens along x and points along z."""
    arm = load_mjcf(model, base=config.base, tip=config.tip, hand=config.hand)
    data, length = data_at_zero(model), _HAND_LENGTH * float(arm.chain_length)
    lines = [([0, 0, 0], axis, rgba) for axis, rgba in zip(np.eye(3), _AXES, strict=True)]
    lines += [([side, 0, 0], [side, 0, 1], _FINGERS) for side in (-0.6, 0.6)] + [([-0.6, 0, 0], [0, 0, 0], _FINGERS)]
    T_world_base = base_pose(model, config.base, config.tip)
    hands = zip(arm.hand_joint, arm.hand_position, arm.hand_rotation, strict=True)
    for number, (joint, position, rotation) in enumerate(hands):
        body = int(model.jnt_bodyid[chain_ids.joints[joint]])
        R_body_base = data.xmat[body].reshape(3, 3).T @ T_world_base[:3, :3]
        origin = R_body_base @ position + data.xmat[body].reshape(3, 3).T @ (T_world_base[:3, 3] - data.xpos[body])
        for name, (start, end, rgba) in zip(_HAND_LINES, lines, strict=True):
            ends = [origin + length * R_body_base @ rotation @ np.asarray(point, float) for point in (start, end)]
            spec.body(model.body(body).name).add_geom(
                name=f"{HAND_LINE}{number} {name}", type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=np.concatenate(ends),
                size=[_HAND_THICKNESS * float(arm.chain_length), 0, 0], rgba=rgba, contype=0, conaffinity=0, mass=0,
            )  # fmt: skip
