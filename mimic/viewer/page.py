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
_FIELD_OF_VIEW = 0.75  # rad, vertical
_UNMOVED = 1e-3  # of the height of the view: a camera that moved less, moved by rounding
_PANEL_WIDTH = 384.0  # pixels; the heat maps of two arms with seven joints fit
_MIN_WIDTH, _MIN_FLAT_WIDTH = 1.9, 2.6  # arm lengths that a narrow window shows: both arms, with room for elbows


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
        reach = max(shape.reach for shape in shapes)
        _set_stage(server, reach, is_flat)
        width = reach * (_MIN_FLAT_WIDTH if is_flat else _MIN_WIDTH)
        server.on_client_connect(lambda client: _keep_in_view(client.camera, server.initial_camera, width))
        self._arms = [
            _DrawnArm(server, f"/{role}", shape, place, f"{role}: {name}", -0.3 if is_flat else 0.3)
            for role, shape, place, name in zip(_ROLES, shapes, places(shapes), names, strict=True)
        ]
        self._ghost = _Ghost(server, shapes[1], match)
        self._title = html.title(title)
        self._numbers = server.gui.add_html("")
        self.show_note("compiling …")
        self._chart = server.gui.add_html("")
        self._maps = server.gui.add_html("", order=html.LAST)  # below the controls

    def show_note(self, note: str) -> None:
        """Shows a line in the place of the numbers, before the first frame."""
        self._numbers.content = self._title + html.numbers(float("nan"), float("nan"), note)

    def move(self, frame: Frame) -> None:
        """Moves the arms to those of a frame; numbers, chart and maps stay."""
        with self.server.atomic():
            self._move(frame)
        self.server.flush()  # viser's windows of 1/60 s would merge some of the frames that come as fast

    def show(self, frame: Frame, chart: str, note: str) -> None:
        """Shows a frame; all elements change together."""
        with self.server.atomic():
            self._move(frame)
            numbers = html.numbers(frame.distance, frame.bound, note, frame.similarity)
            self._numbers.content = self._title + numbers
            self._maps.content = html.heat_maps(frame.matrix, frame.links, frame.expert_links, frame.learner_links)
            self._chart.content = chart

    def _move(self, frame: Frame) -> None:
        self._arms[0].move_to(frame.expert, ())
        self._arms[1].move_to(frame.learner, frame.locked)
        self._ghost.move_to(frame)


class _DrawnArm:
    """The meshes of an arm in the scene."""

    def __init__(
        self, server: viser.ViserServer, path: str, shape: ArmShape, place: np.ndarray, label: str, label_at: float
    ):
        self._shape = shape
        scene = server.scene
        scene.add_frame(path, show_axes=False, position=place)
        place_of_label = (label_at * shape.reach, 0.0, 0.0)
        scene.add_label(f"{path}/label", label, position=place_of_label, anchor="top-center", font_screen_scale=1.1)
        bodies = sorted({part.body for part in shape.parts})
        positions, quaternions = shape.bodies({})
        self._frames = {
            body: scene.add_frame(
                f"{path}/body{body}", show_axes=False, position=positions[body], wxyz=quaternions[body]
            )
            for body in bodies
        }
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
    server.gui.main_panel.set_width(_PANEL_WIDTH)  # otherwise it may dock with the width before that of the theme
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


def _keep_in_view(camera: viser.CameraHandle, start: viser.InitialCameraConfig, width: float) -> None:
    """Moves a client's camera back until its window shows a width [m] at the target, unless the user moved it."""
    target, stance = np.array(start.look_at), start.position - start.look_at
    height = 2 * np.tan(_FIELD_OF_VIEW / 2) * np.linalg.norm(stance)  # of the view at the target
    last = start.position

    @camera.on_update
    def _(_: Any) -> None:
        nonlocal last
        position = target + stance * max(1.0, width / (height * camera.aspect))
        is_ours = np.linalg.norm(camera.position - last) < _UNMOVED * height
        if is_ours and np.linalg.norm(position - last) > _UNMOVED * height:
            camera.position = last = position
            camera.look_at = target
