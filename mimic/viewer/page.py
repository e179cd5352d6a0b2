"""The page of every view in viser: two arms in 3-D, numbers, heat maps and a chart."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import viser
from jaxtyping import Float

from mimic.arms.link_match import LinkMatch
from mimic.viewer import html
from mimic.viewer.live_session import Frame
from mimic.viewer.meshes import ArmShape, Part, along_z, capsule_mesh, places

_ROLES = ("expert", "learner")
_GRID = 0.1, 0.5  # m, sizes of a cell and of a section
_STANCE = np.array([2.5, -0.1, 0.75])  # camera position relative to its target, in arm lengths
_FROM_ABOVE = np.array([0.55, -0.01, 2.9])
_LAST = 1e12  # order of an element below all others, whose orders are times in seconds
_FIELD_OF_VIEW = 0.75  # rad


class Page:
    """The elements of the page that change with each `Frame`.

    Args:
      server: new server without elements.
      shapes: meshes of expert and learner.
      names: names of expert and learner.
      title: title of the page.
      is_flat: whether the camera looks from above.
      match: which links correspond.

    Attributes:
      server: the server.
      expert: meshes of the expert.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        shapes: Sequence[ArmShape],
        names: Sequence[str],
        title: str,
        is_flat: bool,
        match: LinkMatch,
    ):
        self.server, self.expert = server, shapes[0]
        _set_stage(server, max(shape.reach for shape in shapes), is_flat)
        self._arms = [
            _DrawnArm(server, f"/{role}", shape, place, f"{role}: {name}")
            for role, shape, place, name in zip(_ROLES, shapes, places(shapes), names, strict=True)
        ]
        self._ghost = _Ghost(server, shapes[1], match)
        server.gui.add_markdown(f"**{title}**")
        self._numbers = server.gui.add_html(html.numbers(float("nan"), float("nan"), "compiling …"))
        self._chart = server.gui.add_html("")
        self._maps = server.gui.add_html("", order=_LAST)  # below the controls, which then fit 800 pixels

    def move(self, frame: Frame) -> None:
        """Moves the arms to those of a frame; numbers, chart and maps stay."""
        with self.server.atomic():
            self._move(frame)

    def show(self, frame: Frame, chart: str, note: str) -> None:
        """Shows a frame; all elements change together."""
        with self.server.atomic():
            self._move(frame)
            self._numbers.content = html.numbers(frame.distance, frame.bound, note, frame.similarity)
            self._maps.content = html.heat_maps(frame.matrix, frame.links, frame.expert_links, frame.learner_links)
            self._chart.content = chart

    def _move(self, frame: Frame) -> None:
        self._arms[0].move_to(frame.expert, ())
        self._arms[1].move_to(frame.learner, frame.locked)
        self._ghost.move_to(frame)


class _DrawnArm:
    """The meshes of an arm in the scene."""

    def __init__(self, server: viser.ViserServer, path: str, shape: ArmShape, place: np.ndarray, label: str):
        self._shape = shape
        scene = server.scene
        scene.add_frame(path, show_axes=False, position=place)
        scene.add_label(
            f"{path}/label", label, position=(0.3 * shape.reach, 0.0, 0.0), anchor="top-center", font_screen_scale=1.1
        )
        bodies = sorted({part.body for part in shape.parts})
        self._frames = {body: scene.add_frame(f"{path}/body{body}", show_axes=False) for body in bodies}
        self._marks: dict[str, Any] = {}
        for index, part in enumerate(shape.parts):
            mesh = _mesh(scene, f"{path}/body{part.body}/part{index}", part)
            if part.locked_joint is not None:
                self._marks[part.locked_joint] = mesh

    def move_to(self, angles: Mapping[str, float], locked: Sequence[str]) -> None:
        positions, quaternions = self._shape.bodies(angles)
        for body, frame in self._frames.items():
            frame.position, frame.wxyz = positions[body], quaternions[body]
        for name, mark in self._marks.items():
            if mark.visible != (name in locked):
                mark.visible = name in locked


class _Ghost:
    """The expert, translucent and scaled, at the learner, with lines between corresponding links.

    The learner's links keep their number while its joints are locked, so that the lines stay where they are.
    """

    def __init__(self, server: viser.ViserServer, shape: ArmShape, match: LinkMatch):
        self._match = match
        position, wxyz = shape.base_pose()
        scene, path = server.scene, "/learner/ghost"
        scene.add_frame(path, show_axes=False, position=position, wxyz=wxyz)
        at_rest = match.ghost(np.zeros(match.expert.num_joints), np.zeros(match.learner.num_joints))
        self._num_links = match.expert.num_links
        self._links = []
        for index, capsule in enumerate(at_rest[: self._num_links]):
            (red, green, blue, alpha), mesh = capsule.rgba, capsule_mesh(capsule)
            self._links.append(
                scene.add_mesh_simple(f"{path}/link{index}", *mesh, color=(red, green, blue), opacity=alpha)
            )
        count = len(at_rest) - self._num_links
        self._lines = scene.add_line_segments(f"{path}/lines", np.zeros((count, 2, 3), np.float32), colors=(40, 40, 40))

    def move_to(self, frame: Frame) -> None:
        arms = (self._match.expert, frame.expert), (self._match.learner, frame.learner)
        poses = [np.array([angles[name] for name in arm.joint_names]) for arm, angles in arms]
        capsules = self._match.ghost(*poses)
        for mesh, capsule in zip(self._links, capsules, strict=False):
            mesh.position, mesh.wxyz = capsule.start, along_z(capsule.end - capsule.start)
        lines = [(capsule.start, capsule.end) for capsule in capsules[self._num_links :]]
        self._lines.points = np.asarray(lines, np.float32).reshape(-1, 2, 3)


def _mesh(scene: viser.SceneApi, path: str, part: Part) -> Any:
    red, green, blue, alpha = part.rgba
    return scene.add_mesh_simple(
        path,
        part.vertices,
        part.faces,
        color=(red, green, blue),
        opacity=alpha if alpha < 1 else None,
        visible=part.locked_joint is None,
        side="double",
    )


def _set_stage(server: viser.ViserServer, reach: float, is_flat: bool) -> None:
    server.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()
    server.scene.set_up_direction("+z")
    server.scene.configure_default_lights(True, cast_shadow=True)
    server.scene.add_grid(
        "/ground", width=8.0, height=8.0, cell_size=_GRID[0], section_size=_GRID[1],
        cell_color=(225, 228, 232), section_color=(196, 201, 208), plane_color=(246, 247, 249), plane_opacity=1.0,
        position=(0.0, 0.0, -0.002),
    )  # fmt: skip
    target: Float[np.ndarray, "3"] = np.array([0.0, 0.0, 0.0 if is_flat else 0.38 * reach])
    camera = server.initial_camera
    camera.look_at = target
    camera.position = target + reach * (_FROM_ABOVE if is_flat else _STANCE)
    camera.fov = _FIELD_OF_VIEW
