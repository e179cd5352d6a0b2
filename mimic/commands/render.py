"""What `python -m mimic.render` does: two arms that move, as a video, with the distance over time beside them."""

import os
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
from jaxtyping import UInt8  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402
from matplotlib.text import Text  # noqa: E402
from PIL import Image  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.progress import track  # noqa: E402

from mimic.arms.rendering import ArmScene  # noqa: E402
from mimic.commands.clips import FRAMES_PER_SECOND, Clip, prepare_clip  # noqa: E402
from mimic.commands.config import RenderConfig  # noqa: E402
from mimic.compilation import use_compilation_cache  # noqa: E402
from mimic.config import check_new  # noqa: E402
from mimic.evaluation.labels import similarity_texts  # noqa: E402

_SIZE, _DPI = (1280, 640), 100  # pixels
_SCENE = 760  # pixels of the width that show the arms
_GIF_EVERY, _GIF_SCALE = 3, 0.5


def prepare_video(config: RenderConfig) -> Callable[[], None]:
    """What renders a video.

    Raises:
      ValueError: what `prepare_clip` rejects, an `out` that exists, none for retargeted motions, or no OpenGL.
    """
    use_compilation_cache(config.compilation_cache)
    env, own_out, make_clip = prepare_clip(config)
    out = _new_video(config, own_out)
    scene = ArmScene([env.expert, env.learner], limits=env.limits, width=_SCENE, height=_SIZE[1])

    def run() -> None:
        console = Console()
        with console.status("computing the motion and its distances"):
            clip = make_clip()
        out.parent.mkdir(exist_ok=True)
        with scene:
            frames = draw_frames(scene, clip)
            kept = _write_video(out, track(frames, total=len(clip.time), description="rendering"))
        if config.gif:
            _write_gif(out.with_suffix(".gif"), kept)
        console.print(f"results: {out}", soft_wrap=True, highlight=False)

    return run


def _new_video(config: RenderConfig, own_out: Path | None) -> Path:
    """Where the video goes: `out`, or the run directory's own place for it."""
    if not config.out and own_out is None:
        raise ValueError("out: expected a file, as in out=FILE.mp4")
    out = Path(config.out or own_out or "").expanduser()
    if out.suffix != ".mp4":
        raise ValueError(f"out: expected a file that ends in .mp4, got {str(out)!r}")
    for path in (out, out.with_suffix(".gif")):
        check_new("out", path, "name a new file")
    if config.out and not out.parent.is_dir():
        raise ValueError(f"out: there is no folder {str(out.parent)!r}")
    return out


def draw_frames(scene: ArmScene, clip: Clip) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """The pictures of a video. What never changes is drawn once: drawing all of it costs as much as rendering."""
    figure = plt.figure(figsize=(_SIZE[0] / _DPI, _SIZE[1] / _DPI), dpi=_DPI)
    share = _SCENE / _SIZE[0]
    room = figure.add_axes((0, 0, share, 1))
    room.axis("off")
    picture = room.imshow(scene.image([poses[0] for poses in clip.poses]), interpolation="nearest")
    texts = [
        room.text(place, 0.04, label, transform=room.transAxes, ha="center", fontsize=13)
        for place, label in zip((0.27, 0.73), clip.labels, strict=True)
    ]
    texts.append(room.text(0.02, 0.95, clip.title, transform=room.transAxes, fontsize=12))
    left, width = share + 0.07, 1 - share - 0.09
    over_time = figure.add_axes((left, 0.66, width, 0.28))
    for curve in clip.curves:
        over_time.plot(clip.curve_time, curve.values, label=curve.label, **curve.style)
    now = over_time.axvline(0, color="tab:red", lw=1)
    over_time.set(xlabel="time [s]", title="embodiment distance", ylim=(0, None), xlim=(0, clip.curve_time[-1]))
    over_time.legend(fontsize="small", loc="best")  # never over a curve where there is room
    over_time.grid(alpha=0.3)
    values = _add_similarity(figure, (left, 0.42, width, 0.12), clip)
    links = figure.add_axes((left, 0.09, width, 0.25))
    bars = links.bar(range(len(clip.bar_names)), clip.bars[0], color="tab:blue")
    links.set_xticks(range(len(clip.bar_names)), [name.replace("link", "") for name in clip.bar_names])
    links.set(title="by link of the learner", ylim=(0, 1.05 * clip.bars.max()))
    moving = [picture, *texts, now, *values.values(), *bars]
    for artist in moving:
        artist.set_animated(True)
    canvas: Any = figure.canvas
    canvas.draw()
    background = canvas.copy_from_bbox(figure.bbox)
    for frame, time in enumerate(clip.time):
        sample = min(int(np.searchsorted(clip.curve_time, time - 1e-9)), len(clip.curve_time) - 1)
        picture.set_data(scene.image([poses[frame] for poses in clip.poses]))
        now.set_xdata([time, time])
        for bar, height in zip(bars, clip.bars[sample], strict=True):
            bar.set_height(height)
        for name, (_, value) in similarity_texts(_similarity_at(clip, frame)).items():
            values[name].set_text(value)
        canvas.restore_region(background)
        for artist in moving:
            figure.draw_artist(artist)
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()
    plt.close(figure)


def _add_similarity(figure: Figure, place: tuple[float, float, float, float], clip: Clip) -> dict[str, Text]:
    """The measures of similarity in columns, label above value. Gives the values, which change with the frame."""
    panel = figure.add_axes(place)
    panel.axis("off")
    panel.set_title("similarity (0: alike; lengths in chain lengths)")
    texts = similarity_texts(_similarity_at(clip, 0))
    values = {}
    for column, (name, (label, value)) in enumerate(texts.items()):
        at: Any = {"x": (column + 0.5) / len(texts), "transform": panel.transAxes, "ha": "center", "va": "center"}
        panel.text(y=0.72, s=label.replace(" ", "\n"), fontsize=9, color="dimgrey", **at)
        values[name] = panel.text(y=0.12, s=value, fontsize=13, **at)
    return values


def _similarity_at(clip: Clip, frame: int) -> dict[str, float]:
    return {name: float(values[frame]) for name, values in clip.similarity.items()}


def _write_video(out: Path, frames: Any) -> list[Image.Image]:
    """Encodes the frames; the file has its name only when it is whole. Gives small copies of some."""
    partial = out.with_name(f".{out.stem}.partial.mp4")
    writer = imageio_ffmpeg.write_frames(str(partial), _SIZE, fps=FRAMES_PER_SECOND, quality=7, macro_block_size=2)
    with warnings.catch_warnings():  # JAX warns of forks; this one only starts the encoder
        warnings.filterwarnings("ignore", message=".*os.fork", category=RuntimeWarning)
        writer.send(None)
    kept = []
    try:
        for index, frame in enumerate(frames):
            writer.send(np.ascontiguousarray(frame))
            if index % _GIF_EVERY == 0:
                small = round(_GIF_SCALE * _SIZE[0]), round(_GIF_SCALE * _SIZE[1])
                kept.append(Image.fromarray(frame).resize(small, Image.Resampling.LANCZOS))
    finally:
        writer.close()
    os.replace(partial, out)
    return kept


def _write_gif(out: Path, frames: list[Image.Image]) -> None:
    partial = out.with_name(f".{out.stem}.partial.gif")
    duration = 1000 * _GIF_EVERY // FRAMES_PER_SECOND
    colours = [frame.quantize(128, dither=Image.Dither.NONE) for frame in frames]
    colours[0].save(partial, save_all=True, append_images=colours[1:], duration=duration, loop=0)
    os.replace(partial, out)
