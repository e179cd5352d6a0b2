"""The page of every view in viser: two arms in 3-D, numbers, heat maps and a chart."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import viser
from jaxtyping import Float

from mimic.arms.link_match import LinkMatch
from mimic.arms.model_tree import quaternion
from mimic.viewer import html
from mimic.viewer.hand_following import HandFrame
from mimic.viewer.live_session import Frame
from mimic.viewer.meshes import ArmShape, Part, along_z, capsule_mesh, places

_GRID = 0.1, 0.5  # m, sizes of a cell and of a section
_STANCE = np.array([2.5, -0.1, 0.75])  # camera position relative to its target, in arm lengths
_FROM_ABOVE = np.array([0.55, -0.01, 2.9])
_FIELD_OF_VIEW = 0.75  # rad, vertical
EXPERT_BASE, _LEARNER = "/expert/base", "/learner"  # base frame of the expert, and frame of the learner
_GOAL_SIZE, _GOAL_BALL = 0.12, 0.035  # axes of a goal of the hand, and the ball in it, in chain lengths
_STATE_COLOURS = {"tracking": (60, 170, 80), "nearest": (215, 40, 40)}  # of the ball by the state of a hand
_OTHER_STATE = (240, 160, 30)
_PANEL_WIDTH = 384.0  # pixels; the heat maps of two arms with seven joints fit


class Page:
    """The elements of the page that change with each `Frame`.

    Args:
      server: new server without elements.
      expert, learner: name and meshes of each.
      match: which of their links correspond.
      title: title of the page.
      is_flat: whether the camera looks from above.

    Attributes:
      server: the server.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        expert: tuple[str, ArmShape],
        learner: tuple[str, ArmShape],
        match: LinkMatch,
        title: str,
        is_flat: bool,
    ):
        self.server, shapes = server, (expert[1], learner[1])
        _set_stage(server, max(shape.reach for shape in shapes), is_flat)
        (left, right), label_at = places(shapes), -0.3 if is_flat else 0.3
        self._expert = _DrawnArm(server, "/expert", shapes[0], left, f"expert: {expert[0]}", label_at)
        _add_base(server, EXPERT_BASE, shapes[0])
        self._learner = _DrawnArm(server, _LEARNER, shapes[1], right, f"learner: {learner[0]}", label_at)
        self._ghost = _Ghost(server, shapes[1], match)
        self._goals = _HandGoals(server, shapes[1], len(match.learner.hand_joint))
        self._title = html.title(title)
        self._numbers = server.gui.add_html("")
        self._numbers.content = self._title + html.numbers(float("nan"), float("nan"), "compiling …")
        self._chart = server.gui.add_html("")
        self._maps = server.gui.add_html("", order=html.LAST)  # below the controls

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
        self._expert.move_to(frame.expert, ())
        self._learner.move_to(frame.learner, frame.locked)
        self._ghost.show(frame)
        self._goals.show(frame.hand)


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
        scene, path = server.scene, f"{_LEARNER}/ghost"
        self._root = _add_base(server, path, shape)
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

    def show(self, frame: Frame) -> None:
        """Shows the expert in a frame; hides it, as it is scaled, where hands are compared in metres."""
        if self._root.visible != (frame.hand is None):
            self._root.visible = frame.hand is None
        if frame.hand is None:
            self._move_to(frame)

    def _move_to(self, frame: Frame) -> None:
        arms = (self._match.expert, frame.expert), (self._match.learner, frame.learner)
        expert, learner = (np.array([angles[name] for name in arm.joint_names]) for arm, angles in arms)
        capsules = self._match.ghost(expert, learner)
        for mesh, capsule in zip(self._links, capsules, strict=False):
            mesh.position, mesh.wxyz = capsule.start, along_z(capsule.end - capsule.start)
        lines = [(capsule.start, capsule.end) for capsule in capsules[self._num_links :]]
        self._lines.points = np.asarray(lines, np.float32).reshape(-1, 2, 3)


class _HandGoals:
    """Axes where the learner's hands should be, each with a ball whose colour is the state of the hand."""

    def __init__(self, server: viser.ViserServer, shape: ArmShape, count: int):
        scene, path = server.scene, f"{_LEARNER}/goals"
        _add_base(server, path, shape)
        size, ball = _GOAL_SIZE * shape.reach, _GOAL_BALL * shape.reach
        names = [f"{path}/{hand}" for hand in range(count)]
        self._axes = [scene.add_frame(name, axes_length=size, axes_radius=0.04 * size, visible=False) for name in names]
        self._balls = [
            scene.add_icosphere(f"{name}/ball", ball, color=_OTHER_STATE, opacity=0.6, cast_shadow=False)
            for name in names
        ]

    def show(self, hand: HandFrame | None) -> None:
        """Shows the goals of a hand that follows."""
        for axes, ball, number in zip(self._axes, self._balls, range(len(self._axes)), strict=True):
            is_shown = hand is not None and number < len(hand.positions)
            if axes.visible != is_shown:
                axes.visible = is_shown
            if hand is not None and is_shown:
                axes.position, axes.wxyz = hand.positions[number], quaternion(hand.rotations[number])
                ball.color = _STATE_COLOURS.get(hand.status.state, _OTHER_STATE)


def _add_base(server: viser.ViserServer, path: str, shape: ArmShape) -> Any:
    """Adds the base frame of an arm."""
    position, wxyz = shape.base_pose()
    return server.scene.add_frame(path, show_axes=False, position=position, wxyz=wxyz)


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
