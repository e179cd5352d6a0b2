"""What `python -m mimic.render` does: a policy's rollout as a video, with the distance and its bound beside it."""

import os
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
from jaxtyping import Float, UInt8  # noqa: E402
from PIL import Image  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.progress import track  # noqa: E402

from mimic.distance import link_distances  # noqa: E402
from mimic.kinematics import link_states  # noqa: E402
from mimic.rendering import ArmScene  # noqa: E402
from mimic.trainers import runs, session  # noqa: E402
from mimic.trainers.checkpoints import check_checkpoint, load_checkpoint  # noqa: E402
from mimic.trainers.config import PPOConfig, RenderConfig  # noqa: E402
from mimic.trainers.evaluation import Evaluator, Rollouts  # noqa: E402
from mimic.trainers.ppo_job import PPOJob  # noqa: E402

_FRAMES_PER_SECOND = 30
_SIZE, _DPI = (1280, 640), 100  # pixels
_SCENE = 760  # pixels of the width that show the arms
_GIF_EVERY, _GIF_SCALE = 3, 0.5


def prepare_video(config: RenderConfig) -> Callable[[], None]:
    """What renders a video.

    Raises:
      ValueError: no run directory of PPO, no such checkpoint or demonstration, an `out` that exists, or no OpenGL.
    """
    session.use_compilation_cache(config.compilation_cache)
    if not config.run:
        raise ValueError("run: expected the run directory to show, as in run=runs/NAME")
    run_dir = Path(config.run).expanduser()
    trained = runs.load_config(run_dir)
    check_checkpoint(run_dir, config.checkpoint)
    if not isinstance(trained.trainer, PPOConfig):
        raise ValueError(f"run: expected a run of trainer=ppo, got one of {trained.trainer.name}")
    name = f"{config.split}-{config.demonstration}.mp4"
    out = Path(config.out).expanduser() if config.out else run_dir / "videos" / name
    if out.suffix != ".mp4":
        raise ValueError(f"out: expected a file that ends in .mp4, got {str(out)!r}")
    for path in (out, out.with_suffix(".gif")):
        if path.exists():
            raise ValueError(f"out: {str(path)!r} exists; name a new file")
    if config.out and not out.parent.is_dir():
        raise ValueError(f"out: there is no folder {str(out.parent)!r}")
    env = trained.env
    scene = ArmScene([env.expert, env.learner], limits=env.limits, width=_SCENE, height=_SIZE[1])
    job = session.make_job(trained, run_dir)
    assert isinstance(job, PPOJob)
    index = _index(job.evaluator, config)
    _, params = load_checkpoint(run_dir, job.params_template(), config.checkpoint)

    def run() -> None:
        console = Console()
        with console.status("running the policy"):
            rollouts = job.evaluate(params)
            story = _Story(job.evaluator, rollouts, index)
        out.parent.mkdir(exist_ok=True)
        with scene:
            frames = _frames(
                scene, story, f"{env.name}, {config.split.replace('_', '-')} demonstration {config.demonstration}"
            )
            kept = _write_video(out, track(frames, total=story.num_frames, description="rendering"))
        if config.gif:
            _write_gif(out.with_suffix(".gif"), kept)
        console.print(f"results: {out}", soft_wrap=True, highlight=False)

    return run


def _index(evaluator: Evaluator, config: RenderConfig) -> int:
    part = evaluator.parts[config.split]
    which = range(evaluator.env.demonstrations.count)[part]
    if not 0 <= config.demonstration < len(which):
        raise ValueError(
            f"demonstration: expected 0 to {len(which) - 1}, the {config.split} ones of the run, "
            f"got {config.demonstration}"
        )
    return which[config.demonstration]


class _Story:
    """One rollout, resampled for a video.

    Attributes:
      time: [frames] [s].
      expert, learner: [frames, joints] [rad].
      distance, bound, hold: [T] after each control step.
      by_link: [T, links] share of each learner link in the distance.
    """

    def __init__(self, evaluator: Evaluator, rollouts: Rollouts, index: int):
        env, demonstrations = evaluator.env, evaluator.env.demonstrations
        horizon, dt = env.config.horizon, env.config.control_dt
        home = np.asarray(env.learner.home)[None]
        qpos = np.concatenate([home, np.asarray(rollouts.qpos[index])])
        qvel = np.concatenate([0 * home, np.asarray(rollouts.qvel[index])])
        span = slice(0, horizon + 1)
        self.dt = dt
        self.time = np.arange(0, horizon * dt + 1e-9, 1 / _FRAMES_PER_SECOND)
        self.expert = _between(demonstrations.qpos[index, span], demonstrations.qvel[index, span], dt, self.time)
        self.learner = _between(qpos, qvel, dt, self.time)
        self.distance = np.asarray(rollouts.distance[index])
        self.bound, self.hold = evaluator.lower_bound[index], evaluator.hold_distance[index]
        self.by_link = _by_link(evaluator, index, qpos[1:], qvel[1:])
        self.link_names = env.learner.link_names
        self.num_frames = len(self.time)


def _between(
    qpos: Float[np.ndarray, "samples joints"], qvel: Float[np.ndarray, "samples joints"], dt: float, time: np.ndarray
) -> Float[np.ndarray, "frames joints"]:
    """Angles at any time: cubics through angles and velocities."""
    step = np.minimum((time / dt).astype(int), len(qpos) - 2)
    s = (time / dt - step)[:, None]
    start, end, out, into = qpos[step], qpos[step + 1], dt * qvel[step], dt * qvel[step + 1]
    return (
        (2 * s**3 - 3 * s**2 + 1) * start + (3 * s**2 - 2 * s**3) * end + (s**3 - 2 * s**2 + s) * out
        + (s**3 - s**2) * into
    )  # fmt: skip


def _by_link(evaluator: Evaluator, index: int, qpos: np.ndarray, qvel: np.ndarray) -> Float[np.ndarray, "time links"]:
    """What each learner link adds to the distance: the sums of the columns of W o D', over all entries."""
    env = evaluator.env

    def one(qpos: jax.Array, qvel: jax.Array, step: jax.Array) -> jax.Array:
        learner = link_states(env.learner, qpos, qvel)
        measure: Any = env.config.metric.rotation_measure
        distances = link_distances(env.expert_at(jnp.asarray(index), step), learner, env.weights, rotation=measure)
        matrix = env.correspondence(distances) if callable(env.correspondence) else jnp.asarray(env.correspondence)
        return (matrix * distances).sum(axis=0) / distances.size

    return np.asarray(jax.jit(jax.vmap(one))(qpos, qvel, jnp.arange(1, len(qpos) + 1)))


def _frames(scene: ArmScene, story: _Story, title: str) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """The pictures of a video."""
    figure = plt.figure(figsize=(_SIZE[0] / _DPI, _SIZE[1] / _DPI), dpi=_DPI)
    share = _SCENE / _SIZE[0]
    room = figure.add_axes((0, 0, share, 1))
    room.axis("off")
    picture = room.imshow(scene.image([story.expert[0], story.learner[0]]))
    for place, label in ((0.27, "expert"), (0.73, "learner")):
        room.text(place, 0.04, label, transform=room.transAxes, ha="center", fontsize=13)
    room.text(0.02, 0.95, title, transform=room.transAxes, fontsize=12)
    over_time = figure.add_axes((share + 0.07, 0.57, 1 - share - 0.09, 0.36))
    steps = story.dt * np.arange(1, len(story.distance) + 1)
    over_time.plot(steps, story.hold, ":", color="grey", label="holding still")
    over_time.plot(steps, story.distance, color="tab:blue", label="policy")
    over_time.plot(steps, story.bound, "k--", lw=1, label="lower bound")
    now = over_time.axvline(0, color="tab:red", lw=1)
    over_time.set(xlabel="time [s]", title="embodiment distance", ylim=(0, None), xlim=(0, steps[-1]))
    over_time.legend(fontsize="small", loc="upper left")
    over_time.grid(alpha=0.3)
    links = figure.add_axes((share + 0.07, 0.09, 1 - share - 0.09, 0.32))
    bars = links.bar(range(len(story.link_names)), story.by_link[0], color="tab:blue")
    links.set_xticks(range(len(story.link_names)), [name.replace("link", "") for name in story.link_names])
    links.set(title="by link of the learner", ylim=(0, 1.05 * story.by_link.max()))
    for frame, time in enumerate(story.time):
        step = min(int(time / story.dt), len(story.distance) - 1)
        picture.set_data(scene.image([story.expert[frame], story.learner[frame]]))
        now.set_xdata([time, time])
        for bar, height in zip(bars, story.by_link[step], strict=True):
            bar.set_height(height)
        figure.canvas.draw()
        yield np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()  # type: ignore[attr-defined]
    plt.close(figure)


def _write_video(out: Path, frames: Any) -> list[Image.Image]:
    """Encodes the frames; the file has its name only when it is whole. Gives small copies of some."""
    partial = out.with_name(f".{out.stem}.partial.mp4")
    writer = imageio_ffmpeg.write_frames(str(partial), _SIZE, fps=_FRAMES_PER_SECOND, quality=7, macro_block_size=2)
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
    duration = 1000 * _GIF_EVERY // _FRAMES_PER_SECOND
    colours = [frame.quantize(128, dither=Image.Dither.NONE) for frame in frames]
    colours[0].save(partial, save_all=True, append_images=colours[1:], duration=duration, loop=0)
    os.replace(partial, out)
