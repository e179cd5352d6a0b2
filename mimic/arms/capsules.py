"""Capsules around the links of an arm, fitted to the geoms of its model."""

import dataclasses
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from mimic.arms.arm import ArmConfig, arm_spec, build_arm
from mimic.arms.embodiment import Embodiment
from mimic.arms.kinematic_tree import ChainIds, find_chain
from mimic.arms.model_tree import ancestors
from mimic.arms.mujoco_chain import data_at_zero

_SPHERE, _CAPSULE, _CYLINDER, _MESH, _PLANE = (
    int(kind)
    for kind in (
        mujoco.mjtGeom.mjGEOM_SPHERE,
        mujoco.mjtGeom.mjGEOM_CAPSULE,
        mujoco.mjtGeom.mjGEOM_CYLINDER,
        mujoco.mjtGeom.mjGEOM_MESH,
        mujoco.mjtGeom.mjGEOM_PLANE,
    )
)

_SAMPLES = 17  # points of an axis, to find capsules that intersect in the zero pose


@dataclasses.dataclass(frozen=True)
class Capsules:
    """Capsules fixed to the links of an arm, in the base frame and its zero pose.

    Attributes:
      start, end: [capsules, 3] ends of their axes, in m.
      radius: [capsules], in m.
      joint: index of the last free joint that moves each capsule; -1 for the base.
      joint_parent: see `Embodiment`; where None, that of a serial chain.
    """

    start: Float[Any, "capsules 3"]
    end: Float[Any, "capsules 3"]
    radius: Float[Any, " capsules"]
    joint: tuple[int, ...]
    joint_parent: tuple[int, ...] | None = None

    @property
    def near_base(self) -> tuple[bool, ...]:
        """Whether each capsule is on the base, or on a joint whose parent is the base."""
        return tuple(joint < 0 or self._parent(joint) < 0 for joint in self.joint)

    def links(self, arm: Embodiment) -> list[str]:
        """What each capsule of an arm is around, in words."""
        return ["the base" if joint < 0 else f"the link of {arm.joint_names[joint]}" for joint in self.joint]

    def _parent(self, joint: int) -> int:
        return joint - 1 if self.joint_parent is None else self.joint_parent[joint]

    def _are_neighbours(self, a: int, b: int) -> bool:
        """Whether two joints are the same, or one is the parent of the other; -1 stands for the base."""
        return a == b or (a >= 0 and self._parent(a) == b) or (b >= 0 and self._parent(b) == a)

    @property
    def pairs(self) -> tuple[tuple[int, int], ...]:
        """Pairs that can collide: not on one body or on neighbours along the chain, and apart in the zero pose."""
        fractions = np.linspace(0, 1, _SAMPLES)[:, None]
        points = [a + fractions * (b - a) for a, b in zip(self.start, self.end, strict=True)]

        def are_apart(i: int, j: int) -> bool:
            distances = np.linalg.norm(points[i][:, None] - points[j], axis=-1)
            return bool(distances.min() > self.radius[i] + self.radius[j])

        indices = range(len(self.joint))
        pairs = ((i, j) for i in indices for j in indices[i + 1 :])
        distant = ((i, j) for i, j in pairs if not self._are_neighbours(self.joint[i], self.joint[j]))
        return tuple(pair for pair in distant if are_apart(*pair))


def fit_capsules(config: ArmConfig, limits: str = "none") -> Capsules:
    """One capsule around each collision geom of an arm, or around each visual one where it has no collision geoms.

    Spheres and capsules are exact. A cylinder gets the capsule of its total length and radius; its rims stick out.
    Other shapes get the smallest capsule along the main axis of their corners or vertices.

    Args:
      config: of the arm, with its locked joints.
      limits: see `EnvConfig`.

    Raises:
      ValueError: what `build_arm` rejects, or a model without geoms on the arm.
    """
    arm = build_arm(config, limits)
    model = arm_spec(config).compile()
    chain = find_chain(model, config.base, config.tip)
    data = data_at_zero(model)
    for name, angle in arm.locked.items():
        data.qpos[model.joint(name).qposadr[0]] = angle
    mujoco.mj_kinematics(model, data)
    base = chain.base
    R_base_world, origin = data.xmat[base].reshape(3, 3).T, data.xpos[base]
    free = {int(model.joint(name).bodyid[0]): i for i, name in enumerate(arm.embodiment.joint_names)}
    moved = _joints_of_geoms(model, base, _first_bodies(model, chain), free)
    geoms = [(geom, joint) for geom, joint in moved if joint is not None]
    solid = [(geom, joint) for geom, joint in geoms if model.geom_contype[geom] or model.geom_conaffinity[geom]]
    if not geoms:
        raise ValueError(f"capsules: {arm.embodiment.name} has no geoms to fit them to")
    fits = [(*_capsule(model, data, geom), joint) for geom, joint in solid or geoms]
    starts, ends, radii, joints = zip(*fits, strict=True)
    points = [(np.stack(ends_) - origin) @ R_base_world.T for ends_ in (starts, ends)]
    return Capsules(points[0], points[1], np.array(radii), tuple(joints), arm.embodiment.joint_parent)


def _first_bodies(model: mujoco.MjModel, chain: ChainIds) -> set[int]:
    """Bodies from which on the model is the arm's: those of the first joints, and the mounts of a tree's arms."""
    roots = chain.roots(model)
    if len(roots) == 1:
        return set(roots)
    lines = [ancestors(model, root)[::-1] for root in roots]
    return {line[line.index(chain.base) + 1] for line in lines}


def _joints_of_geoms(
    model: mujoco.MjModel, base: int, first_bodies: set[int], free: dict[int, int]
) -> list[tuple[int, int | None]]:
    """Each geom with the last free joint that moves it; None for geoms that are not on the arm."""
    result = []
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        parents = [body, *ancestors(model, body)]
        on_arm = not first_bodies.isdisjoint(parents) or (body == base and base != 0)
        joints = [free[parent] for parent in parents if parent in free]
        is_shape = int(model.geom_type[geom]) != _PLANE
        result.append((geom, max(joints, default=-1) if on_arm and is_shape else None))
    return result


def _capsule(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Ends [m, world frame] and radius of the capsule around a geom."""
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    centre, rotation = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)
    if kind in (_SPHERE, _CAPSULE, _CYLINDER):
        half = {_SPHERE: 0.0, _CAPSULE: size[1], _CYLINDER: max(size[1] - size[0], 0.0)}[kind]
        radius = max(size[0], size[1]) if kind == _CYLINDER and size[1] < size[0] else size[0]
        return centre - half * rotation[:, 2], centre + half * rotation[:, 2], float(radius)
    if kind == _MESH:
        mesh = model.geom_dataid[geom]
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        points = np.asarray(model.mesh_vert[first : first + count], float)
    else:  # the box around it: exact for a box, generous for an ellipsoid
        points = size * np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T
    return bounding_capsule(centre + points @ rotation.T)


def bounding_capsule(points: Float[np.ndarray, "points 3"]) -> tuple[np.ndarray, np.ndarray, float]:
    """Ends and radius of a small capsule along the main axis of points, which contains all of them."""
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    axis = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][0]
    along = (points - middle) @ axis
    radial = points - middle - along[:, None] * axis
    radius = float(np.linalg.norm(radial, axis=1).max())
    # Each point needs an end at most sqrt(r^2 - d^2) nearer to the middle than itself.
    reach = np.sqrt(np.maximum(radius**2 - np.sum(radial**2, axis=1), 0))
    low, high = float((along + reach).min()), float((along - reach).max())
    low, high = (low, high) if low <= high else ((low + high) / 2,) * 2
    return middle + low * axis, middle + high * axis, radius
