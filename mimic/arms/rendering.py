"""Images of arms by MuJoCo's renderer, with EGL where there is no display."""

import dataclasses
import functools
import os
import platform
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float, UInt8

from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.embodiment import Embodiment
from mimic.arms.link_match import Capsule, Colour, link_ends
from mimic.arms.visual_model import visual_spec
from mimic.base import compat

SPACING, FLAT_SPACING = 0.9, 1.5  # chain lengths between two arms; planar ones are seen from above, and reach sideways
LOCKED = (0.85, 0.12, 0.10, 1.0)
_ROUNDING = 1e-6  # m
_FLOOR, _GRID = (0.94, 0.95, 0.96), (0.88, 0.89, 0.91)
_SHADOWS, _SAMPLES = 2048, 4  # pixels of the shadow map, samples of a pixel
_SOFTWARE = "llvmpipe", "softpipe", "swrast", "SWR"  # names of Mesa's renderers on the CPU
MARGIN = 0.13  # around the centre lines, for the bodies of the arms; chain lengths
_FIT_POSES = 20  # poses that the camera's place depends on, of a motion
MARK = 0.05, 0.019  # radius and half width of a locked joint's disc, as fractions of the chain length


class ArmScene:
    """Renders several arms next to each other, each in its own pose; locked joints are red. Use in a `with` statement.

    Args:
      arms: from left to right.
      limits: see `EnvConfig`; sets the default angles of locked joints.
      width: of an image [pixels].
      height: of an image [pixels].
      fast: leave out shadows and multisampling where the CPU renders: 6 times as fast, for videos.
      colours: colours of each arm's links by name, as of `LinkMatch`. Default None: those of the models.

    Raises:
      ValueError: an arm cannot be built, an image without pixels, or no OpenGL library works.
    """

    def __init__(
        self,
        arms: Sequence[ArmConfig],
        *,
        limits: str = "none",
        width: int = 640,
        height: int = 480,
        fast: bool = False,
        colours: Sequence[Mapping[str, Colour]] | None = None,
    ):
        if min(width, height) < 1:
            raise ValueError(f"width, height: expected at least 1 pixel, got {width}, {height}")
        built_arms = [build_arm(arm, limits) for arm in arms]
        unlocked = [build_arm(dataclasses.replace(arm, locked=()), limits).embodiment for arm in arms]
        reach = max(float(arm.chain_length) for arm in unlocked)  # the scale does not depend on locked joints
        is_flat = all(arm.model == "planar" for arm in arms)
        spacing = reach * (-FLAT_SPACING if is_flat else SPACING)  # along y, which points left where x points up
        spec = _empty_room(width, height)
        self._arms = [arm.embodiment for arm in built_arms]
        self._joints: list[list[str]] = []
        self._bases: list[Float[np.ndarray, "4 4"]] = []  # transforms from the base frames to the world
        self._locked: dict[str, float] = {}
        for index, (config, arm) in enumerate(zip(arms, built_arms, strict=True)):
            prefix = f"arm{index}-"
            source, base = visual_spec(config, limits, colours[index] if colours else None)
            _copy_options(source, spec)
            for name in arm.locked:
                _mark_locked(source, name, float(unlocked[index].chain_length))
            place = [0.0, (index - 0.5 * (len(arms) - 1)) * spacing, 0.0] - base[:3, 3] * [1, 1, 0]
            spec.attach(source, prefix=prefix, frame=spec.worldbody.add_frame(pos=place))
            base[:3, 3] += place
            self._bases.append(base)
            self._joints.append([prefix + name for name in arm.embodiment.joint_names])
            self._locked |= {prefix + name: angle for name, angle in arm.locked.items()}
        highest = max(float(base[2, 3]) for base in self._bases)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._camera = mujoco.MjvCamera()
        self._camera.lookat[:] = 0.0, 0.0, 0.0 if is_flat else 0.4 * reach + 0.5 * highest
        self._camera.distance = (1.4 + 0.7 * (len(arms) - 1) + 1.6 * is_flat) * reach + 0.5 * highest
        self._camera.azimuth, self._camera.elevation = (0.0, -89.0) if is_flat else (165.0, -14.0)
        self._aspect, self._centres = width / height, [0.0] * len(arms)
        self._renderer = new_renderer(self._model, width, height, fast)

    def fit(
        self,
        poses: Sequence[Float[np.ndarray, "frames joints"]],
        others: Sequence[Float[np.ndarray, "points 3"]] | None = None,
    ) -> None:
        """Moves arms and camera so that the arms fill the image in all these poses [rad], those of each arm in turn.

        So do other points beside each arm, in its base frame [m]. The floor is at the bases, or below the lowest link
        where an arm reaches below its base, as a person's does.
        """
        margin = MARGIN * max(float(arm.chain_length) for arm in self._arms)
        others = [np.zeros((0, 3))] * len(poses) if others is None else others
        points = [
            np.concatenate([np.zeros((1, 3)), _points(arm, arm_poses), others_of_arm]) @ base[:3, :3].T + base[:3, 3]
            for arm, base, arm_poses, others_of_arm in zip(self._arms, self._bases, poses, others, strict=True)
        ]
        sizes = np.array([np.ptp(self.flattened(arm_points), axis=0) for arm_points in points])
        room = self._aspect * (sizes[:, 1].max() + 2 * margin) - sizes[:, 0].sum() - 2 * margin
        gap = max(2 * margin, room / len(points))  # the arms fill the width
        left = 0.0
        for index, arm_points in enumerate(points):
            shift = (left - self.flattened(arm_points)[:, 0].min()) * self._axes()[0]
            self._move(index, shift)
            points[index] = arm_points + shift
            left += sizes[index, 0] + gap
        self._centres = [
            float(np.ptp(x) / 2 + x.min()) for x in (self.flattened(arm_points)[:, 0] for arm_points in points)
        ]
        lowest = min(float(arm_points[:, 2].min()) for arm_points in points)
        self._data.mocap_pos[0, 2] = min(0.0, lowest - margin) if lowest < -_ROUNDING else 0.0
        self._look_at(np.concatenate(points), margin)

    def centres(self) -> list[float]:
        """Where the middle of each arm is in the image after `fit`, as a fraction of its width."""
        width = 2 * self._aspect * self._camera.distance * np.tan(np.radians(self._model.vis.global_.fovy / 2))
        middle = self.flattened(np.array(self._camera.lookat))[0]
        return [0.5 + (centre - middle) / width for centre in self._centres]

    def _move(self, index: int, shift: Float[np.ndarray, "3"]) -> None:
        """Moves an arm on the floor [m]."""
        for body in range(1, self._model.nbody):
            if self._model.body_parentid[body] == 0 and self._model.body(body).name.startswith(f"arm{index}-"):
                self._model.body_pos[body] += shift
        self._bases[index][:3, 3] += shift

    def _look_at(self, points: Float[np.ndarray, "points 3"], margin: float) -> None:
        """Places the camera so that points and a margin [m] fill the image."""
        right, up, forward = self._axes()
        image_points, depth = self.flattened(points), points @ forward
        low, high = image_points.min(axis=0) - margin, image_points.max(axis=0) + margin
        middle = (low + high) / 2
        self._camera.lookat[:] = middle[0] * right + middle[1] * up + depth.mean() * forward
        half_height = 0.5 * max(high[1] - low[1], (high[0] - low[0]) / self._aspect)
        half_angle = np.radians(self._model.vis.global_.fovy / 2)
        self._camera.distance = half_height / np.tan(half_angle) + depth.mean() - depth.min()

    def image(
        self,
        poses: Sequence[Float[np.ndarray, " joints"]],
        overlay: Sequence[Capsule] = (),
        at_first: Sequence[Capsule] = (),
    ) -> UInt8[np.ndarray, "height width 3"]:
        """Renders the arms in these poses [rad], overlays at the last arm, as of `LinkMatch.ghost`, and the first."""
        for name, angle in self._locked.items():
            self._data.joint(name).qpos[0] = angle
        for names, pose in zip(self._joints, poses, strict=True):
            for name, angle in zip(names, pose, strict=True):
                self._data.joint(name).qpos[0] = float(angle)
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        self._renderer.update_scene(self._data, self._camera)
        for base, capsules in ((self._bases[-1], overlay), (self._bases[0], at_first)):
            for capsule in capsules:
                _add_capsule(self._renderer.scene, capsule, base)
        return self._renderer.render()

    def flattened(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """Orthographic projection of points onto the image plane: right and up, in the units of the points."""
        right, up, _ = self._axes()
        return points @ np.stack([right, up], axis=1)

    def _axes(self) -> Float[np.ndarray, "3 3"]:
        """The camera's axes in the world: right, up and forward."""
        azimuth, elevation = np.radians([self._camera.azimuth, self._camera.elevation])
        forward = np.array(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        )
        right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
        return np.stack([right, np.cross(right, forward), forward])

    def __enter__(self) -> "ArmScene":
        return self

    def __exit__(self, *_: Any) -> None:
        self._renderer.close()


def _points(arm: Embodiment, poses: Float[np.ndarray, "frames joints"]) -> Float[np.ndarray, "points 3"]:
    """Ends of the links in some poses of a motion, in the base frame [m]."""
    every = max(1, len(poses) // _FIT_POSES)
    return np.concatenate([link_ends(arm, pose).reshape(-1, 3) for pose in poses[::every]])


def _add_capsule(scene: mujoco.MjvScene, capsule: Capsule, T_world_base: np.ndarray) -> None:
    """Adds a capsule to what the renderer draws next."""
    if scene.ngeom == scene.maxgeom:
        return
    start, end = (T_world_base[:3, :3] @ point + T_world_base[:3, 3] for point in (capsule.start, capsule.end))
    geom, kind = scene.geoms[scene.ngeom], int(mujoco.mjtGeom.mjGEOM_CAPSULE)
    mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), np.asarray(capsule.rgba, np.float32))
    mujoco.mjv_connector(geom, kind, capsule.radius, start, end)
    scene.ngeom += 1


def _empty_room(width: int, height: int) -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    visual = spec.visual
    visual.global_.offwidth, visual.global_.offheight = width, height
    visual.quality.shadowsize, visual.quality.offsamples = _SHADOWS, _SAMPLES
    visual.headlight.ambient, visual.headlight.diffuse = [0.45] * 3, [0.25] * 3
    visual.headlight.specular = [0.1] * 3
    visual.map.shadowclip = 3.0  # m; shadows beyond it are speckled
    visual.rgba.haze = [*_FLOOR, 1]
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[1, 1, 1], rgb2=[0.93, 0.95, 0.97], width=256, height=256,
    )  # fmt: skip
    spec.add_texture(
        name="floor", type=mujoco.mjtTexture.mjTEXTURE_2D, builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=list(_FLOOR), rgb2=list(_GRID), width=256, height=256,
    )  # fmt: skip
    floor = spec.add_material(name="floor", texrepeat=[2, 2], texuniform=True)
    floor.textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = "floor"
    ground = spec.worldbody.add_body(name="ground", mocap=True)  # the only body that `fit` moves by its pose
    ground.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], material="floor")
    for place, strength in (([1.5, -2.0, 3.5], 0.55), ([1.5, 2.5, 3.0], 0.2)):
        spec.worldbody.add_light(
            pos=place, dir=[-x for x in place], diffuse=[strength] * 3, castshadow=strength > 0.5,
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        )  # fmt: skip
    return spec


def _copy_options(source: mujoco.MjSpec, room: mujoco.MjSpec) -> None:
    """Copies the physics options: they do not affect an image, but MuJoCo warns where two models differ in them."""
    for name in dir(room.option):
        if not name.startswith("_"):
            setattr(source.option, name, getattr(room.option, name))


def _mark_locked(spec: mujoco.MjSpec, joint_name: str, chain_length: float) -> None:
    """Adds a red disc around the joint's axis."""
    joint = spec.joint(joint_name)
    axis = np.asarray(joint.axis) / np.linalg.norm(joint.axis)
    radius, half_width = MARK[0] * chain_length, MARK[1] * chain_length
    ends = np.concatenate([joint.pos - half_width * axis, joint.pos + half_width * axis])
    joint.parent.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CYLINDER, fromto=ends, size=[radius, 0, 0], rgba=LOCKED,
        contype=0, conaffinity=0, mass=0,
    )  # fmt: skip


def new_renderer(model: mujoco.MjModel, width: int, height: int, fast: bool = False) -> mujoco.Renderer:
    """A renderer of images, see `ArmScene`; with EGL where there is no display."""
    try:
        is_plain = fast and is_software_renderer()
        if is_plain:
            model.vis.quality.offsamples = 0
        _choose_window_system()
        renderer = mujoco.Renderer(model, height, width)
    except (*compat.NO_GRAPHICS, ImportError, RuntimeError, mujoco.FatalError) as error:
        raise ValueError(
            "rendering: no OpenGL library works; expected EGL (Debian, Ubuntu: libegl1 and libgl1), or "
            f"MUJOCO_GL=osmesa with libosmesa6: {' '.join(str(error).split())}"
        ) from error
    if is_plain:
        renderer.scene.flags[int(mujoco.mjtRndFlag.mjRND_SHADOW)] = 0
    return renderer


@functools.cache
def is_software_renderer() -> bool:
    """Whether OpenGL runs on the CPU."""
    _choose_window_system()
    context = sys.modules[mujoco.Renderer.__module__].gl_context.GLContext(1, 1)
    context.make_current()
    try:
        from OpenGL import GL

        name: Any = GL.glGetString(GL.GL_RENDERER) or b""
        return any(software in name.decode() for software in _SOFTWARE)
    finally:
        context.free()


def _choose_window_system() -> None:
    """Takes EGL where there is no display.

    MuJoCo chooses a window system at import, before a user can know that EGL is needed.
    """
    if _is_headless():
        from mujoco.egl import GLContext

        sys.modules[mujoco.Renderer.__module__].gl_context.GLContext = GLContext


def _is_headless() -> bool:
    has_display = any(os.environ.get(name) for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"))
    return platform.system() == "Linux" and not has_display
