"""`python -m mimic.render`: a video of two arms, with the distance between them over time."""

import os
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from rich.console import Console
from rich.progress import track

from mimic.arms.link_match import Capsule
from mimic.arms.rendering import ArmScene
from mimic.base.compilation import use_compilation_cache
from mimic.base.config import check_new
from mimic.commands.clips import FRAMES_PER_SECOND, Clip, prepare_clip
from mimic.commands.config import RenderConfig
from mimic.commands.printed import say
from mimic.evaluation.labels import similarity_texts
from mimic.retargeting.hand_target import placed_hands, placement

_SIZE, _DPI = (1280, 640), 100  # pixels
_SCENE = 760, 548  # pixels of the arms' picture
_LEGEND = "same colour: corresponding links; translucent: expert, {}; red: locked joints{}"
_AXIS, _AXIS_RADIUS = 0.08, 0.006  # m, of the frames of objects
_CAPTIONS = 56  # pixels below it; the title is above it
_LEGEND_ROOM = 1.25  # height of the axes relative to the maximum distance, so that the legend hides no curve

_LABELS_SIDE_BY_SIDE = 8  # below the bars; more are upright
_Frame = UInt8[np.ndarray, "height width 3"]
Bounds = tuple[float, float, float, float]  # left, bottom, width, height as fractions of the frame


def prepare_video(config: RenderConfig) -> Callable[[], None]:
    """Checks the config of a video and opens the renderer.

    Raises:
      ValueError: see `prepare_clip`; `out` exists, or is missing for retargeted motions; or OpenGL is not available.
    """
    use_compilation_cache(config.compilation_cache)
    env, default_out, compute_clip = prepare_clip(config)
    out = _new_video(config, default_out)
    match = env.metric.match_links(*env.build_arms().embodiments)
    scene = ArmScene(
        [env.expert, env.learner], limits=env.limits, width=_SCENE[0], height=_SCENE[1], fast=True,
        colours=[match.expert_colours, match.learner_colours],
    )  # fmt: skip

    def run() -> None:
        console = Console()
        with console.status("computing the motion and its distances"):
            clip = compute_clip()
        out.parent.mkdir(exist_ok=True)
        with scene:
            frames = draw_frames(scene, clip)
            _write_video(out, track(frames, "rendering", len(clip.time), console=console, transient=True))
        say(console, f"results: {out}")

    return run


def _new_video(config: RenderConfig, default_out: Path | None) -> Path:
    """The file of the video: `out`, or its default in the run directory."""
    if not config.out and default_out is None:
        raise ValueError("out: expected a file, as in out=FILE.mp4")
    out = Path(config.out or default_out or "").expanduser()
    if out.suffix != ".mp4":
        raise ValueError(f"out: expected a file that ends in .mp4, got {str(out)!r}")
    check_new("out", out, "name a new file")
    if config.out and not out.parent.is_dir():
        raise ValueError(f"out: there is no folder {str(out.parent)!r}")
    return out


def draw_frames(scene: ArmScene, clip: Clip) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """The frames of a video.

    The static artists are drawn once and blitted: drawing all of them for each frame costs as much as rendering.
    """
    figure = Figure(figsize=(_SIZE[0] / _DPI, _SIZE[1] / _DPI), dpi=_DPI)
    scene_width = _SCENE[0] / _SIZE[0]  # fraction of the frame that shows the arms
    scene.fit(clip.poses, [objects[..., :3, 3].reshape(-1, 3) for objects in _objects(clip)])
    left, width = scene_width + 0.07, 1 - scene_width - 0.09
    bounds = 0, _CAPTIONS / _SIZE[1], scene_width, _SCENE[1] / _SIZE[1]
    picture = _add_scene(figure, bounds, scene, clip)
    now = _add_curves(figure, (left, 0.66, width, 0.28), clip)
    similarity = _add_similarity(figure, (left, 0.42, width, 0.12), clip)
    bars = _add_bars(figure, (left, 0.09, width, 0.25), clip)
    animated = [picture, now, *similarity.values(), *bars]
    for artist in animated:
        artist.set_animated(True)
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    background = canvas.copy_from_bbox(figure.bbox)
    for frame, time in enumerate(clip.time):
        sample = min(int(np.searchsorted(clip.curve_time, time - 1e-9)), len(clip.curve_time) - 1)
        picture.set_data(_image(scene, clip, frame))
        now.set_xdata([time, time])
        for bar, height in zip(bars, clip.bars[sample], strict=True):
            bar.set_height(height)
        for name, (_, value) in similarity_texts(_similarity_at(clip, frame)).items():
            similarity[name].set_text(value)
        canvas.restore_region(background)
        for artist in animated:
            figure.draw_artist(artist)
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _image(scene: ArmScene, clip: Clip, frame: int) -> UInt8[np.ndarray, "height width 3"]:
    """Both arms, the expert's ghost at the learner, and the axes of objects at both."""
    poses = [poses[frame] for poses in clip.poses]
    at_expert, at_learner = ([*_axes(objects[frame])] for objects in _objects(clip))
    return scene.image(poses, [*clip.match.ghost(*poses, base=clip.base), *at_learner], at_expert)


def _objects(clip: Clip) -> list[Float[np.ndarray, "frames objects 4 4"]]:
    """Poses of objects in the base frames of both arms."""
    objects = np.zeros((len(clip.time), 0, 4, 4)) if clip.objects is None else clip.objects
    return [objects, placed_hands(placement(clip.base), objects)]


def _axes(poses: Float[np.ndarray, "objects 4 4"]) -> Iterator[Capsule]:
    """The axes of frames, x red, y green and z blue."""
    for pose in poses:
        for axis, colour in zip(pose[:3, :3].T, np.eye(3), strict=True):
            yield Capsule(pose[:3, 3], pose[:3, 3] + _AXIS * axis, _AXIS_RADIUS, (*(0.15 + 0.75 * colour), 1.0))


def _add_scene(figure: Figure, bounds: Bounds, scene: ArmScene, clip: Clip) -> Any:
    """Adds the picture of the arms, its title above it and the captions of the arms below it; returns the picture."""
    axes = figure.add_axes(bounds)
    axes.axis("off")
    picture = axes.imshow(_image(scene, clip, 0), interpolation="nearest", aspect="auto")
    left, bottom, width, height = bounds
    for place, label in zip(scene.centres(), clip.labels, strict=True):
        figure.text(left + place * width, 0.6 * bottom, label, ha="center", va="center", fontsize=13)
    objects = "; axes: objects" if clip.objects is not None and clip.objects.size else ""
    legend = _LEGEND.format("scaled to the learner" if clip.base is None else "where it is", objects)
    figure.text(left + width / 2, 0.2 * bottom, legend, ha="center", va="center", fontsize=9, color="dimgrey")
    figure.text(left + 0.02, (1 + bottom + height) / 2, clip.title, va="center", fontsize=12)
    return picture


def _add_curves(figure: Figure, bounds: Bounds, clip: Clip) -> Any:
    """Adds the distances over time and returns the line that marks the current time."""
    axes = figure.add_axes(bounds)
    for curve in clip.curves:
        axes.plot(clip.curve_time, curve.values, label=curve.label, **curve.style)
    now = axes.axvline(0, color="tab:red", lw=1)
    top = _LEGEND_ROOM * max(float(np.nanmax(curve.values)) for curve in clip.curves)
    axes.set(xlabel="time [s]", title="embodiment distance", ylim=(0, top), xlim=(0, clip.curve_time[-1]))
    axes.legend(
        fontsize=8, loc="upper center", ncols=len(clip.curves), handlelength=1.5, columnspacing=1.2, frameon=False
    )
    axes.grid(alpha=0.3)
    return now


def _add_bars(figure: Figure, bounds: Bounds, clip: Clip) -> Any:
    """Adds the bars of the learner's links and returns them."""
    axes = figure.add_axes(bounds)
    colours = [clip.match.learner_colours[name.split("+")[0]] for name in clip.bar_names]
    bars = axes.bar(range(len(clip.bar_names)), clip.bars[0], color=colours)
    labels = [name.replace("link", "").replace("_", " ") for name in clip.bar_names]
    upright = 90 if len(labels) > _LABELS_SIDE_BY_SIDE else 0
    axes.set_xticks(range(len(labels)), labels, rotation=upright, fontsize=8 if upright else None)
    axes.set(title="contribution of each learner link", ylim=(0, 1.05 * clip.bars.max()))
    return bars


def _add_similarity(figure: Figure, bounds: Bounds, clip: Clip) -> dict[str, Text]:
    """Adds the similarity measures in columns and returns the texts of their values, which change with the frame."""
    panel = figure.add_axes(bounds)
    panel.axis("off")
    panel.set_title("similarity (0: identical; lengths in chain lengths)")
    texts = similarity_texts(_similarity_at(clip, 0))
    values = {}
    for column, (name, (label, value)) in enumerate(texts.items()):
        position: Any = {"x": (column + 0.5) / len(texts), "transform": panel.transAxes, "ha": "center", "va": "center"}
        panel.text(y=0.72, s=label.replace(" ", "\n"), fontsize=9, color="dimgrey", **position)
        values[name] = panel.text(y=0.12, s=value, fontsize=13, **position)
    return values


def _similarity_at(clip: Clip, frame: int) -> dict[str, float]:
    return {name: float(values[frame]) for name, values in clip.similarity.items()}


def _write_video(out: Path, frames: Iterable[_Frame]) -> None:
    """Encodes the frames. The file gets its name when it is complete."""
    partial = out.with_name(f".{out.stem}.partial.mp4")
    try:
        count = _encode(partial, frames)
        if _num_frames(partial) != count:
            raise OSError(f"{str(out)!r}: the encoder did not write all {count} frames; the disk may be full")
        os.replace(partial, out)
    finally:
        partial.unlink(missing_ok=True)


def _encode(file: Path, frames: Iterable[_Frame]) -> int:
    """Sends the frames to the encoder; returns the number sent."""
    writer = imageio_ffmpeg.write_frames(str(file), _SIZE, fps=FRAMES_PER_SECOND, quality=7, macro_block_size=2)
    with warnings.catch_warnings():  # JAX warns about forks; this one only starts the encoder
        warnings.filterwarnings("ignore", message=".*os.fork", category=RuntimeWarning)
        writer.send(None)
    count = 0
    try:
        for frame in frames:
            count += 1
            try:
                writer.send(np.ascontiguousarray(frame))
            except OSError:  # the encoder has ended
                break
    finally:
        writer.close()  # does not tell whether the encoder failed
    return count


def _num_frames(file: Path) -> int:
    """The number of frames that can be read from a video; 0 if it is damaged."""
    try:
        return imageio_ffmpeg.count_frames_and_secs(str(file))[0]
    except RuntimeError:
        return 0
