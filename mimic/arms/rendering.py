"""Images of arms by MuJoCo's renderer, with EGL where there is no display."""

import dataclasses
import functools
import os
import platform
import sys
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float, UInt8

from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.visual_model import visual_spec

SPACING, FLAT_SPACING = 0.9, 1.5  # chain lengths between two arms; planar ones are seen from above, and reach sideways
LOCKED = (0.85, 0.12, 0.10, 1.0)
_FLOOR, _GRID = (0.94, 0.95, 0.96), (0.88, 0.89, 0.91)
_SHADOWS, _SAMPLES = 2048, 4  # pixels of the shadow map, samples of a pixel
_SOFTWARE = "llvmpipe", "softpipe", "swrast", "SWR"  # names of Mesa's renderers on the CPU
MARK = 0.05, 0.019  # radius and half width of a locked joint's disc, as fractions of the chain length


class ArmScene:
    """Renders several arms next to each other, each in its own pose; locked joints are red. Use in a `with` statement.

    Args:
      arms: from left to right.
      limits: see `EnvConfig`; sets the default angles of locked joints.
      width: of an image [pixels].
      height: of an image [pixels].
      fast: leave out shadows and multisampling where the CPU renders: 6 times as fast, for videos.

    Raises:
      ValueError: an arm cannot be built, or no OpenGL library works.
    """

    def __init__(
        self,
        arms: Sequence[ArmConfig],
        *,
        limits: str = "none",
        width: int = 640,
        height: int = 480,
        fast: bool = False,
    ):
        built_arms = [build_arm(arm, limits) for arm in arms]
        unlocked = [build_arm(dataclasses.replace(arm, locked=()), limits).embodiment for arm in arms]
        reach = max(float(arm.chain_length) for arm in unlocked)  # the scale does not depend on locked joints
        is_flat = all(arm.model == "planar" for arm in arms)
        spacing = reach * (-FLAT_SPACING if is_flat else SPACING)  # along y, which points left where x points up
        spec = _empty_room(width, height)
        self._joints: list[list[str]] = []
        self._locked: dict[str, float] = {}
        highest = 0.0
        for index, (config, arm) in enumerate(zip(arms, built_arms, strict=True)):
            prefix = f"arm{index}-"
            source, base = visual_spec(config)
            highest = max(highest, float(base[2]))
            _copy_options(source, spec)
            for name in arm.locked:
                _mark_locked(source, name, float(unlocked[index].chain_length))
            place = [0.0, (index - 0.5 * (len(arms) - 1)) * spacing, 0.0] - base * [1, 1, 0]
            spec.attach(source, prefix=prefix, frame=spec.worldbody.add_frame(pos=place))
            self._joints.append([prefix + name for name in arm.embodiment.joint_names])
            self._locked |= {prefix + name: angle for name, angle in arm.locked.items()}
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._camera = mujoco.MjvCamera()
        self._camera.lookat[:] = 0.0, 0.0, 0.0 if is_flat else 0.4 * reach + 0.5 * highest
        self._camera.distance = (1.4 + 0.7 * (len(arms) - 1) + 1.6 * is_flat) * reach + 0.5 * highest
        self._camera.azimuth, self._camera.elevation = (0.0, -89.0) if is_flat else (165.0, -14.0)
        self._renderer = _renderer(self._model, width, height, fast)

    def image(self, poses: Sequence[Float[np.ndarray, " joints"]]) -> UInt8[np.ndarray, "height width 3"]:
        """Renders the arms in these poses [rad]."""
        for name, angle in self._locked.items():
            self._data.joint(name).qpos[0] = angle
        for names, pose in zip(self._joints, poses, strict=True):
            for name, angle in zip(names, pose, strict=True):
                self._data.joint(name).qpos[0] = float(angle)
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        self._renderer.update_scene(self._data, self._camera)
        return self._renderer.render()

    def flattened(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """Orthographic projection of points onto the image plane: right and up, in the units of the points."""
        azimuth, elevation = np.radians([self._camera.azimuth, self._camera.elevation])
        forward = np.array(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        )
        right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
        return points @ np.stack([right, np.cross(right, forward)], axis=1)

    def __enter__(self) -> "ArmScene":
        return self

    def __exit__(self, *_: Any) -> None:
        self._renderer.close()


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
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], material="floor")
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


def _renderer(model: mujoco.MjModel, width: int, height: int, fast: bool) -> mujoco.Renderer:
    try:
        is_plain = fast and is_software_renderer()
        if is_plain:
            model.vis.quality.offsamples = 0
        _choose_window_system()
        renderer = mujoco.Renderer(model, height, width)
    except (ImportError, AttributeError, RuntimeError, mujoco.FatalError) as error:
        raise ValueError(
            "rendering: no OpenGL library works; expected EGL (Debian, Ubuntu: libegl1), or MUJOCO_GL=osmesa with "
            f"libosmesa6: {' '.join(str(error).split())}"
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
