"""Draws a leader and the follower that it drives, as a GIF.

    python -m benchmarks.figures.teleoperation --data FOLDER --robots FOLDER [--pair so101-piper] --out FILE.gif

Folders as of `benchmarks.teleoperation`. The SO-101 plays a recorded episode, another leader wanders. A frame tells
what the follower does, and how far its hand is from where it should be.
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

import mimic
from benchmarks.teleoperation import BASE, SPEED, arm, config, recordings, resampled, wander

EPISODE, SECONDS = 0, 9.0
RATE, FRAME = 100.0, 100  # Hz; ms of a frame
SIZE, CAPTION, COLOURS = (560, 320), 48, 64  # pixels; colours of the GIF
INK = "#333333"


def motion(leader: str, options: argparse.Namespace) -> np.ndarray:
    """The leader's motion at the follower's rate [rad]."""
    samples = int(SECONDS * RATE)
    if leader == "so101":
        return resampled(recordings(arm(leader, options), "deg", options)[EPISODE], 15.0)[:samples]
    home = np.asarray(arm(leader, options).home)
    paths = wander(arm(leader, options), samples, np.random.default_rng(1))
    return home + 0.35 * (paths - paths[0])


def drive(pair: str, options: argparse.Namespace) -> tuple[np.ndarray, list[mimic.FollowerCommand]]:
    """The leader's samples and the follower's commands, from when the hand is reached."""
    one, other = pair.split("-")
    base = BASE if pair == "so101-piper" else None
    operator = mimic.Teleoperator(arm(one, options), arm(other, options), base=base, velocity=SPEED[other], rate=RATE)
    samples = motion(one, options)
    operator.engage()
    for _ in range(1000):
        if operator.step(samples[0]).status.state in ("tracking", "nearest"):
            break
    return samples, [operator.step(sample) for sample in samples]


def draw(pair: str, options: argparse.Namespace) -> list[Image.Image]:
    """The frames."""
    samples, commands = drive(pair, options)
    every = round(FRAME / 1000 * RATE)
    poses = samples[::every], np.array([command.qpos for command in commands[::every]])
    names = [f"{role}: {name}" for role, name in zip(("leader", "follower"), pair.split("-"), strict=True)]
    frames, font = [], ImageFont.load_default(15)
    arms = [config(name, options) for name in pair.split("-")]
    with mimic.ArmScene(arms, limits="hardware", width=SIZE[0], height=SIZE[1]) as scene:
        scene.fit(poses)
        for *pose, command in zip(*poses, commands[::every], strict=True):
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
    parser.add_argument("--pair", default="so101-piper")
    options = parser.parse_args()
    options.episodes = EPISODE + 1
    frames = draw(options.pair, options)
    palette = Image.fromarray(np.vstack([np.asarray(x) for x in frames[:: len(frames) // 4]])).quantize(COLOURS)
    indexed = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    indexed[0].save(options.out, save_all=True, append_images=indexed[1:], duration=FRAME, loop=0, optimize=False)
    print(f"results: {options.out}, {len(frames)} frames, {options.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
