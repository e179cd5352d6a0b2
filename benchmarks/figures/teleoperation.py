"""Draws a leader and the follower that it drives, as a GIF.

    python -m benchmarks.figures.teleoperation --data FOLDER --robots FOLDER [--pair so101-piper] --out FILE.gif
    ... --pair person-panda --clip FILE.bvh --hand relative --scale 0.5 --start 16    # s of the clip

Folders as of `benchmarks.teleoperation`. The SO-101 plays a recorded episode to a Piper, and `person` the captured arm
of `--clip`; another leader wanders. A frame tells what the follower does, and how far its hand is from where it should
be.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

import mimic
from benchmarks.teleoperation import BASE, SPEED, arm, config, person, recordings, resampled, wander
from mimic.arms.arm import ArmConfig, build_arm
from mimic.retargeting.teleoperation import HANDS

EPISODE, SECONDS = 0, 9.0
RATE, FRAME = 100.0, 100  # Hz; ms of a frame
SIZE, CAPTION, COLOURS = (560, 320), 48, 64  # pixels; colours of the GIF
INK = "#333333"


def lead(pair: str, options: argparse.Namespace, folder: str) -> tuple[ArmConfig, np.ndarray]:
    """The leader of a pair, a person's model written to a folder, and its motion at the follower's rate [rad]."""
    name, shown = pair.split("-")[0], slice(int(options.start * RATE), int((options.start + SECONDS) * RATE))
    if name == "person":
        model, path = person(options.clip, folder)
        return model, path[shown]
    if pair == "so101-piper":
        path = resampled(recordings(arm(name, options), "deg", options)[EPISODE], 15.0)
        return config(name, options), path[shown]
    paths, home = wander(arm(name, options), shown.stop, np.random.default_rng(1)), np.asarray(arm(name, options).home)
    return config(name, options), (home + 0.35 * (paths - paths[0]))[shown]


def drive(pair: str, model: ArmConfig, samples: np.ndarray, options: argparse.Namespace) -> list[mimic.FollowerCommand]:
    """The follower's commands, from when the hand is reached."""
    follower, base = pair.split("-")[1], BASE if pair == "so101-piper" else None
    operator = mimic.Teleoperator(
        build_arm(model, "hardware").embodiment, arm(follower, options),
        hand=options.hand, scale=options.scale, base=base, velocity=SPEED[follower], rate=RATE,
    )  # fmt: skip
    operator.engage()
    for _ in range(1000):
        if operator.step(samples[0]).status.state in ("tracking", "nearest"):
            break
    return [operator.step(sample) for sample in samples]


def draw(pair: str, options: argparse.Namespace, folder: str) -> list[Image.Image]:
    """The frames."""
    (model, samples), every = lead(pair, options, folder), round(FRAME / 1000 * RATE)
    commands = drive(pair, model, samples, options)[::every]
    poses = samples[::every], np.array([command.qpos for command in commands])
    names = [f"{role}: {name}" for role, name in zip(("leader", "follower"), pair.split("-"), strict=True)]
    frames, font = [], ImageFont.load_default(15)
    arms = [model, config(pair.split("-")[1], options)]
    with mimic.ArmScene(arms, limits="hardware", width=SIZE[0], height=SIZE[1]) as scene:
        scene.fit(poses)
        for *pose, command in zip(*poses, commands, strict=True):
            frame = Image.new("RGB", (SIZE[0], SIZE[1] + CAPTION), "white")
            frame.paste(Image.fromarray(scene.image(pose)))
            status, pen = command.status, ImageDraw.Draw(frame)
            texts = "", f"{status.state}, hand {status.position_mm:.1f} mm, {status.rotation_deg:.1f} deg off"
            for centre, name, text in zip(scene.centres(), names, texts, strict=True):
                pen.text((centre * SIZE[0], SIZE[1] + 12), name, INK, font, anchor="mm")
                pen.text((centre * SIZE[0], SIZE[1] + 34), text, INK, font, anchor="mm")
            frames.append(frame)
    return frames


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("data", "robots", "out"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    parser.add_argument("--clip", type=Path)
    parser.add_argument("--pair", default="so101-piper")
    parser.add_argument("--hand", choices=HANDS, default="exact")
    for name, number in (("scale", 1.0), ("start", 0.0)):
        parser.add_argument(f"--{name}", type=float, default=number)
    options = parser.parse_args()
    options.episodes = EPISODE + 1
    with tempfile.TemporaryDirectory() as folder:
        frames = draw(options.pair, options, folder)
    palette = Image.fromarray(np.vstack([np.asarray(x) for x in frames[:: len(frames) // 4]])).quantize(COLOURS)
    indexed = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    indexed[0].save(options.out, save_all=True, append_images=indexed[1:], duration=FRAME, loop=0, optimize=False)
    print(f"results: {options.out}, {len(frames)} frames, {options.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
