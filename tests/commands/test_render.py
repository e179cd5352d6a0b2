"""`python -m mimic.render` for retargeted motions: what videos show, and what is rejected."""

import dataclasses
import functools
from typing import Any

import imageio_ffmpeg
import numpy as np
import pytest

import mimic
from mimic.arms.kinematic_tree import ALL_ENDS
from mimic.arms.rendering import ArmScene
from mimic.commands import render
from mimic.commands.clips import _static_clip, prepare_clip
from mimic.commands.config import RenderConfig
from mimic.commands.render import _write_video, draw_frames, prepare_video
from mimic.commands.retargeted_motions import save_motions
from mimic.envs import env_config
from mimic.metric.kinematics import link_states
from mimic.metric.similarity import centre_line, similarity
from mimic.motions.formats.episodes import Motion
from mimic.motions.mocap.ball_chain import ball_chain_xml, zero_frames
from mimic.motions.mocap.link_motion import arm_motion
from tests.helpers.bodies import person

STEPS = 2  # of a motion: 0.2 s, 7 frames
EVERY = 3  # frames from one sample to the next, 0.1 s at 30 frames a second
ROUNDING = 1e-5  # of distances of about 1 in float32


def swings(arm):
    """Sinusoidal motions of an arm."""
    time = 0.1 * np.arange(STEPS + 1)
    angles = (0.8 * np.sin(2 * time[:, None] + phase + np.arange(arm.num_joints)) for phase in range(2))
    return {f"motion {phase}": Motion(time, qpos, None) for phase, qpos in enumerate(angles)}


def saved(folder, arms, base=None) -> dict[str, Any]:
    save_motions(folder, arms, swings(arms[0]), swings(arms[1]), base)
    return {"retargeted": str(folder), "compilation_cache": ""}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """An expert's and a learner's motions, as keys of the command."""
    arms = env_config("planar4dof").build_arms().embodiments
    keys = saved(tmp_path_factory.mktemp("motions"), arms)
    return keys | dict.fromkeys(("expert", "learner"), "planar4dof")


@pytest.fixture(scope="module")
def plan(files):
    """The video of retargeted motions, whose content is computed once."""
    plan = prepare_clip(RenderConfig(**files, demonstration=1))
    return plan._replace(compute=functools.cache(plan.compute))


def curves(clip):
    return {curve.label: curve.values for curve in clip.curves}


@pytest.mark.slow
def test_a_turned_base_counts_in_all_measures():
    """As the expert turned the other way at its first joint; hands are compared in metres."""
    env, time = env_config("pair", limits="hardware"), np.arange(3) / 30
    qpos = np.asarray(env.build_arms().expert.embodiment.home) + np.random.default_rng(0).uniform(-0.3, 0.3, (3, 7))
    turned = qpos - 0.5 * np.eye(7)[0]
    placed = _static_clip(env, "", time, qpos, 0.9 * qpos, [0.1, 0.0, 0.0, 0.5])
    same = _static_clip(env, "", time, turned, 0.9 * qpos, [0.0, 0.0, 0.0, 0.0])
    assert "optimal poses" in curves(same) and "optimal poses" not in curves(placed)
    np.testing.assert_allclose(curves(placed)["retargeted"], curves(same)["retargeted"], atol=1e-4)
    for name in ("centre_line_distance", "tangent_angle_deg", "frechet_distance", "hand_rotation_deg"):
        np.testing.assert_allclose(placed.similarity[name], same.similarity[name], atol=1e-3)
    apart = _static_clip(env, "", time, qpos, qpos, [0.1, 0.0, 0.0, 0.0]).similarity["hand_position_mm"]
    np.testing.assert_allclose(apart, 100, atol=1e-2)


@pytest.mark.slow
def test_retargeted_motions_are_shown_as_they_are(plan):
    clip, env = plan.compute(), env_config("planar4dof")
    arms = env.build_arms().embodiments
    for shown, arm in zip(clip.poses, arms, strict=True):
        assert len(shown) == len(clip.time) == EVERY * STEPS + 1
        np.testing.assert_allclose(shown[::EVERY], swings(arm)["motion 1"].qpos, atol=1e-12)
    shown = curves(clip)
    assert np.all(shown["optimal poses"] <= shown["retargeted"] + ROUNDING)
    assert clip.bars.shape == (len(clip.time), 4)
    metric = env.metric.build(*arms)
    states = (link_states(arm, np.asarray(poses, np.float32)) for arm, poses in zip(arms, clip.poses, strict=True))
    np.testing.assert_allclose(shown["retargeted"], metric(*states), atol=ROUNDING)
    assert np.all(clip.bars.sum(axis=1) <= shown["retargeted"] + ROUNDING)  # the hand is no link
    frame = 5
    lines = (centre_line(arm, poses[frame]) for arm, poses in zip(arms, clip.poses, strict=True))
    for name, expected in similarity(*lines).items():
        assert clip.similarity[name].shape == clip.time.shape
        assert clip.similarity[name][frame] == pytest.approx(float(expected), rel=1e-4)  # degrees in float32


@pytest.mark.slow
def test_the_learner_is_shown_where_it_stands(files, tmp_path):
    base = [0.1, 0.2, 0.0, 0.5]
    keys = files | saved(tmp_path, env_config("planar4dof").build_arms().embodiments, base)
    assert prepare_clip(RenderConfig(**keys)).compute().base == base


def test_frames_show_both_arms_and_the_time(plan):
    clip = plan.compute()
    few = dataclasses.replace(clip, time=clip.time[:2], poses=tuple(poses[[0, -1]] for poses in clip.poses))
    with ArmScene([plan.env.expert, plan.env.learner], width=160, height=120) as scene:
        first, last = draw_frames(scene, few)
    assert first.shape == last.shape == (640, 1280, 3)
    changed = np.any(first != last, axis=-1)
    assert changed[:, :380].any() and changed[:, 380:760].any()  # both arms
    assert changed[:280, 760:].any() and changed[340:380, 760:].any()  # the line of the time; similarity


def test_a_video_has_all_frames(plan, files, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(render, "prepare_clip", lambda config: plan)
    monkeypatch.setattr(render, "_SCENE", (190, 137))  # pixels: a scene of full size takes a second a frame on a CPU
    out = tmp_path / "swing.mp4"
    prepare_video(RenderConfig(**files, out=str(out)))()
    assert capsys.readouterr().out.split() == ["results:", str(out)]
    assert imageio_ffmpeg.count_frames_and_secs(str(out))[0] == EVERY * STEPS + 1
    with pytest.raises(ValueError, match="exists; name a new file"):
        prepare_video(RenderConfig(**files, out=str(out)))


@pytest.mark.parametrize("options", [["-frames:v", "2"], ["-f", "null"]])
def test_a_video_that_lacks_frames_is_removed(tmp_path, monkeypatch, options):
    """The encoder ends before the last frames, or writes no file."""
    encode = functools.partial(imageio_ffmpeg.write_frames, output_params=options)
    monkeypatch.setattr(imageio_ffmpeg, "write_frames", encode)
    frames = np.zeros((5, 640, 1280, 3), np.uint8)
    with pytest.raises(OSError, match=r"swing\.mp4': the encoder did not write all"):
        _write_video(tmp_path / "swing.mp4", iter(frames))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({}, "out: expected a file, as in out=FILE.mp4"),
        ({"learner": ""}, "learner: expected with retargeted=FOLDER"),
        ({"expert": "planar7dof"}, "expert: expected the arm of the data set, .* got planar4 with"),
        ({"demonstration": 2}, "demonstration: expected a number from 0 to 1, got 2"),
        ({"run": "runs/NAME"}, "run: expected none with retargeted=FOLDER"),
        ({"locked": [3]}, "locked: expected none with retargeted=FOLDER"),
    ],
)
def test_bad_files_are_rejected_in_one_line(files, changes, message):
    with pytest.raises(ValueError, match=message) as error:
        prepare_video(RenderConfig(**{**files, **changes}))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("side", ["right", "both"])
def test_motions_of_an_expert_from_a_file(tmp_path, side):
    """As a person's, of one arm or of both."""
    motion = arm_motion(person(5), side)
    model = tmp_path / "person.xml"
    model.write_text(ball_chain_xml(motion, zero_frames(motion)))
    expert = mimic.load_mjcf(model, tip=[ALL_ENDS])
    keys = saved(tmp_path, (expert, mimic.panda()))
    plan = prepare_clip(RenderConfig(**keys, expert=str(model), learner="panda"))
    assert plan.env.build_arms().expert.embodiment.joint_names == expert.joint_names


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "run: expected a run directory"),
        (["run=missing", "split=test"], "expected one of train, held_out, got 'test'"),
    ],
)
def test_bad_input_of_the_command(reason, arguments, message):
    assert message in reason("render", *arguments)
