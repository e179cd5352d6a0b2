"""Draws docs/images/imitation.gif: a Panda moves, and learners with 7, 4 and 3 joints resemble it.

    python docs/draw_imitation.py [--out FILE]

The learners' motions are those of `imitate_trajectory` under the default metric. Each link of a learner has the colour
of the expert's links that it corresponds to; the translucent arm is the expert, and red discs are locked joints. Takes
some minutes on two CPU cores and needs EGL or OSMesa (see docs/install.md).
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import jax
import matplotlib
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

import mimic
from mimic.arms.link_match import LinkMatch

OUT = Path(__file__).resolve().parent / "images" / "imitation.gif"
LOCKED = (), (), (3, 6, 7), (2, 3, 6, 7)  # of the expert and the learners
SEED, DEMONSTRATION = 7, 25  # a long motion, above the floor, that all learners can follow in part
FRAME, LAST_FRAME = 60, 900  # ms; a GIF counts in 10 ms
WIDTH, HEIGHT = 200, 290  # pixels of an arm's panel
COLOURS = 128  # of the GIF
CAPTION = 52  # pixels below the panels
INK = "#333333"


def main() -> None:
    """Records, retargets, draws."""
    parser = argparse.ArgumentParser(prog="python docs/draw_imitation.py", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, default=OUT, help="the GIF")
    out = parser.parse_args().out
    expert, *learners = (mimic.panda(locked=locked) for locked in LOCKED)
    motion = _demonstration()
    solutions = [_retarget(expert, learner, motion) for learner in learners]
    labels = ["expert: 7 joints", *(f"learner: {learner.num_joints} joints" for learner in learners)]
    poses = [motion, *(qpos for qpos, _ in solutions)]
    metric = mimic.env_config("panda4dof").metric
    panels = [
        _draw(metric.match_links(expert, arm), LOCKED[index], motion, None if index == 0 else qpos)
        for index, (arm, qpos) in enumerate(zip([expert, *learners], poses, strict=True))
    ]
    frames = [
        _annotate(np.hstack(images), labels, [float(distance[step]) for _, distance in solutions])
        for step, images in enumerate(zip(*panels, strict=True))
    ]
    _save(frames, out)
    print(f"results: {out}, {len(frames)} frames, {out.stat().st_size / 1e6:.2f} MB")


def _demonstration() -> Float[np.ndarray, "frames joints"]:
    """A recorded motion [rad] at the times of the frames."""
    recorded = mimic.record_demonstrations(
        mimic.build_arm(mimic.ArmConfig()), DEMONSTRATION + 1, kind="computed_torque", seed=SEED
    )
    qpos = recorded.qpos[DEMONSTRATION]
    time = recorded.dt * np.arange(len(qpos))
    frames = np.arange(0, time[-1], FRAME / 1000)
    return np.stack([np.interp(frames, time, angles) for angles in qpos.T], axis=1).astype(np.float32)


def _retarget(
    expert: mimic.Embodiment, learner: mimic.Embodiment, motion: Float[np.ndarray, "frames joints"]
) -> tuple[Float[np.ndarray, "frames learner_joints"], Float[np.ndarray, " frames"]]:
    """The learner's motion [rad] and its distance."""
    metric = mimic.env_config("panda4dof").metric.build(expert, learner).arguments
    jump = np.asarray(learner.velocity_limit) * FRAME / 1000
    solution = jax.jit(lambda qpos: mimic.imitate_trajectory(expert, learner, qpos, **metric, largest_jump=jump))(
        motion
    )
    return np.asarray(solution.qpos), np.asarray(solution.distance)


def _draw(
    match: LinkMatch,
    locked: tuple[int, ...],
    motion: Float[np.ndarray, "frames joints"],
    learner_motion: Float[np.ndarray, "frames learner_joints"] | None,
) -> list[UInt8[np.ndarray, "height width 3"]]:
    """The expert in its poses, or a learner in its own over the expert's ghost; corresponding links have one colour."""
    colours = match.expert_colours if learner_motion is None else match.learner_colours
    arm = mimic.ArmConfig(locked=locked)
    with mimic.ArmScene([arm], width=WIDTH, height=HEIGHT, colours=[colours]) as scene:
        scene.fit([motion if learner_motion is None else learner_motion])
        if learner_motion is None:
            return [scene.image([pose]) for pose in motion]
        poses = zip(motion, learner_motion, strict=True)
        return [scene.image([pose], match.ghost(expert_pose, pose)) for expert_pose, pose in poses]


def _annotate(
    image: UInt8[np.ndarray, "height width 3"], labels: Sequence[str], distances: Sequence[float]
) -> Image.Image:
    """A frame with a label below each arm, and below each learner its distance."""
    frame = Image.new("RGB", (image.shape[1], image.shape[0] + CAPTION), "white")
    frame.paste(Image.fromarray(image))
    draw, font = ImageDraw.Draw(frame), _font(16)
    values = ["", *(f"distance {distance:.3f}" for distance in distances)]
    for index, (label, value) in enumerate(zip(labels, values, strict=True)):
        x = frame.width * (index + 0.5) / len(labels)
        draw.text((x, frame.height - 36), label, INK, font, anchor="mm")
        draw.text((x, frame.height - 14), value, INK, font, anchor="mm")
    return frame


def _font(size: int) -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), size)


def _save(frames: Sequence[Image.Image], out: Path) -> None:
    """One palette for all frames, so that what does not move is stored once."""
    chosen = frames[:: len(frames) // 4]
    sample = Image.fromarray(np.vstack([np.asarray(frame) for frame in chosen]))
    palette = sample.quantize(COLOURS, dither=Image.Dither.NONE)
    indexed = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    durations = [FRAME] * (len(frames) - 1) + [LAST_FRAME]
    indexed[0].save(out, save_all=True, append_images=indexed[1:], duration=durations, loop=0, optimize=False)


if __name__ == "__main__":
    main()
