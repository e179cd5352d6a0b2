"""Triangle meshes of an arm's MuJoCo model, and the poses of its bodies."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
import trimesh
from jaxtyping import Float, Int

from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.kinematic_tree import find_chain
from mimic.arms.link_match import Capsule, Colour
from mimic.arms.rendering import LOCKED, MARK, SPACING
from mimic.arms.visual_model import visual_spec

_VISIBLE_GROUPS = 3  # MuJoCo draws groups 0, 1 and 2; collision geoms are in higher groups
_SPHERE = int(mujoco.mjtGeom.mjGEOM_SPHERE)
_CAPSULE, _ELLIPSOID = int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_ELLIPSOID)
_CYLINDER, _BOX = int(mujoco.mjtGeom.mjGEOM_CYLINDER), int(mujoco.mjtGeom.mjGEOM_BOX)
_MESH = int(mujoco.mjtGeom.mjGEOM_MESH)


@dataclasses.dataclass(frozen=True)
class Part:
    """One mesh, in the frame of its body.

    Attributes:
      body: index of the body.
      vertices: vertex positions [m].
      faces: vertex indices of the triangles.
      rgba: colour and opacity, from 0 to 1.
      locked_joint: joint that the mesh marks as locked; the mesh is hidden while the joint is free.
    """

    body: int
    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    rgba: tuple[float, ...]
    locked_joint: str | None = None


class ArmShape:
    """Meshes of an arm and their forward kinematics.

    Args:
      config: config of the arm; locked joints can be moved too.
      limits: see `EnvConfig`.
      colours: colours of links by name, see `LinkMatch`. Default None: those of the model.

    Attributes:
      joint_names: joints of the chain, base to tip.
      parts: meshes of the arm.
      num_bodies: number of bodies in the model, including the world.
      reach: length of the chain [m].

    Raises:
      ValueError: the arm is invalid.
    """

    def __init__(self, config: ArmConfig, limits: str = "none", colours: Mapping[str, Colour] | None = None):
        free = build_arm(dataclasses.replace(config, locked=()), limits).embodiment
        self._model = visual_spec(config, limits, colours)[0].compile()
        self._data = mujoco.MjData(self._model)
        mujoco.mj_kinematics(self._model, self._data)
        self._base = find_chain(self._model, config.base, config.tip).base
        self.joint_names = free.joint_names
        self.num_bodies = int(self._model.nbody)
        self.reach = float(free.chain_length)
        marks = [_mark(self._model, name, self.reach) for name in free.joint_names]
        self.parts: list[Part] = [*_visible_parts(self._model), *marks]

    def base_pose(self) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "4"]]:
        """Position [m] and quaternion of the arm's base frame, in the frame of the model."""
        return self._data.xpos[self._base].copy(), self._data.xquat[self._base].copy()

    def bodies(
        self, angles: Mapping[str, float]
    ) -> tuple[Float[np.ndarray, "bodies 3"], Float[np.ndarray, "bodies 4"]]:
        """Positions [m] and quaternions (w, x, y, z) of all bodies for the angles of joints [rad] by name."""
        for name, angle in angles.items():
            self._data.joint(name).qpos[0] = angle
        mujoco.mj_kinematics(self._model, self._data)
        return self._data.xpos.copy(), self._data.xquat.copy()


def places(shapes: Sequence[ArmShape]) -> list[Float[np.ndarray, "3"]]:
    """Base positions of arms side by side, as in a video [m]."""
    reach = max(shape.reach for shape in shapes)
    return [np.array([0.0, (index - 0.5 * (len(shapes) - 1)) * SPACING * reach, 0.0]) for index in range(len(shapes))]


def _visible_parts(model: mujoco.MjModel) -> list[Part]:
    """The visible geoms, merged by body and colour."""
    groups: dict[tuple[int, tuple[float, ...]], list[Any]] = {}  # meshes by body and colour
    for geom in range(model.ngeom):
        mesh = _triangles(model, geom)
        material = int(model.geom_matid[geom])
        rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
        if mesh is None or model.geom_group[geom] >= _VISIBLE_GROUPS or rgba[3] == 0:
            continue
        mesh.apply_transform(pose_matrix(model.geom_pos[geom], model.geom_quat[geom]))
        key = int(model.geom_bodyid[geom]), tuple(float(x) for x in rgba)
        groups.setdefault(key, []).append(mesh)
    return [_part(body, trimesh.util.concatenate(meshes), rgba) for (body, rgba), meshes in groups.items()]


def capsule_mesh(capsule: Capsule) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """Vertices and triangles of a capsule along the z-axis, with its start in the origin."""
    length = float(np.linalg.norm(capsule.end - capsule.start))
    mesh = trimesh.creation.capsule(length, capsule.radius, count=[12, 12])
    vertices = np.asarray(mesh.vertices, np.float32)
    return vertices - [0, 0, vertices[:, 2].min() + capsule.radius], np.asarray(mesh.faces, np.int32)


def pose_matrix(position: Any, wxyz: Any) -> Float[np.ndarray, "4 4"]:
    """The homogeneous matrix of a position and a quaternion (w, x, y, z)."""
    rotation, transform = np.zeros(9), np.eye(4)
    mujoco.mju_quat2Mat(rotation, np.asarray(wxyz, float))
    transform[:3, :3], transform[:3, 3] = rotation.reshape(3, 3), position
    return transform


def along_z(direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4"]:
    """Quaternion (w, x, y, z) that turns the z-axis into a direction."""
    quaternion = np.zeros(4)
    mujoco.mju_quatZ2Vec(quaternion, direction)
    return quaternion


def _part(body: int, mesh: Any, rgba: tuple[float, ...], locked_joint: str | None = None) -> Part:
    vertices, faces = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32)
    return Part(body, vertices, faces, rgba, locked_joint)


def _triangles(model: mujoco.MjModel, geom: int) -> trimesh.Trimesh | None:
    """Mesh of a geom in its own frame; None for geoms of infinite extent, such as planes."""
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    if kind == _SPHERE:
        return trimesh.creation.icosphere(3, float(size[0]))
    if kind == _ELLIPSOID:
        mesh = trimesh.creation.icosphere(3, 1.0)
        mesh.apply_scale(size)
        return mesh
    if kind == _CAPSULE:  # its frame is at its centre
        return trimesh.creation.capsule(2 * float(size[1]), float(size[0]), count=[24, 24])
    if kind == _CYLINDER:
        return trimesh.creation.cylinder(float(size[0]), 2 * float(size[1]), sections=40)
    if kind == _BOX:
        return trimesh.creation.box(2 * size)
    if kind == _MESH:
        mesh = model.mesh(int(model.geom_dataid[geom]))
        vertices = model.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + mesh.vertnum[0]]
        faces = model.mesh_face[mesh.faceadr[0] : mesh.faceadr[0] + mesh.facenum[0]]
        return trimesh.Trimesh(vertices.copy(), faces.copy(), process=False)
    return None


def _mark(model: mujoco.MjModel, joint_name: str, reach: float) -> Part:
    """A red disc around a joint's axis, which marks it as locked."""
    joint = model.joint(joint_name)
    disc = trimesh.creation.cylinder(MARK[0] * reach, 2 * MARK[1] * reach, sections=40)
    disc.apply_transform(pose_matrix(joint.pos, along_z(joint.axis)))
    return _part(int(joint.bodyid[0]), disc, LOCKED, joint_name)
