"""Recorded motions as they come: noise, wraps, jumps, gaps, doubled and missing samples, velocities that are wrong."""

from typing import Any

import numpy as np
import pytest

import mimic
from mimic.motions.cleaning import Notes, cleaned
from mimic.motions.formats.episodes import Motion
from mimic.motions.importing import read_recording
from mimic.motions.resampling import angles_and_velocities
from tests.helpers.real_data import PANDA_LOG, needs

NAMES, FREE = ("a", "b"), np.array([[-np.pi, np.pi]] * 2)
TIME = np.arange(0, 6, 0.02)  # s


def swing(time=TIME, amplitude=0.5) -> Any:  # its velocities are not None
    """Two joints that swing, one of them with half the amplitude, and their velocities."""
    scale = amplitude * np.array([1, 0.5])
    return Motion(time, scale * np.sin(2 * time)[:, None], 2 * scale * np.cos(2 * time)[:, None])


def clean(motion, joint_range=FREE):
    notes = Notes()
    return list(cleaned("swing", motion, NAMES, joint_range, notes).values()), notes.lines()


def test_a_clean_motion_is_not_changed():
    (motion,), lines = clean(swing())
    assert not lines
    for before, after in zip(swing(), motion, strict=True):
        np.testing.assert_array_equal(before, after)


def test_noise_of_dense_samples_is_no_velocity():
    """At 1 kHz, two neighbours would give up to 4 rad/s; the truth is at most 1."""
    quantum, jitter = 0.00153, 5e-4  # rad: 4096 steps a turn; s
    true = np.arange(0, 6, 1e-3)
    stamps = np.maximum.accumulate(true + np.random.default_rng(0).exponential(jitter, len(true)))
    (motion,), _ = clean(Motion(stamps, np.round(swing(true).qpos / quantum) * quantum, None))
    steps = 0.1 * np.arange(50)
    angles, velocities = angles_and_velocities(motion, motion.time[0] + steps)
    np.testing.assert_allclose(angles, swing(steps).qpos, atol=2e-3)
    np.testing.assert_allclose(velocities, swing(steps).qvel, atol=0.03)


@needs(PANDA_LOG)
def test_a_real_log_moves_as_fast_as_its_robot_says():
    recording = read_recording(PANDA_LOG, mimic.panda())
    ((_, motion),) = recording.motions.items()
    assert motion.qvel is not None
    steps = np.arange(0, 20.9, 0.1)
    _, velocities = angles_and_velocities(motion._replace(qvel=None), steps)
    stated = np.abs(motion.qvel).max(axis=0)  # of the robot's own filter
    np.testing.assert_allclose(np.abs(velocities).max(axis=0), stated, rtol=0.03)
    assert stated[6] == pytest.approx(1.692, abs=1e-3)  # where neighbours give 3.2


def test_full_turns_are_undone_and_a_joint_is_rotated_into_its_range():
    motion = swing()
    beyond = motion._replace(qpos=motion.qpos + [3.0, 0])
    wrapped = beyond._replace(qpos=(beyond.qpos + np.pi) % (2 * np.pi) - np.pi)
    (unwrapped,), lines = clean(wrapped)
    np.testing.assert_allclose(unwrapped.qpos, beyond.qpos, atol=1e-12)
    assert any(line.startswith("full turns undone: 4 in swing") for line in lines)
    (rotated,), lines = clean(motion._replace(qpos=motion.qpos + 2 * np.pi), np.array([[-1.0, 1.0]] * 2))
    np.testing.assert_allclose(rotated.qpos, motion.qpos, atol=1e-12)
    assert lines == ["rotated by full turns into the joint range: a of swing"]


@pytest.mark.parametrize("order", [np.random.default_rng(0).permutation(len(TIME)), np.arange(len(TIME))[::-1]])
def test_rows_in_no_order_are_sorted_where_their_times_differ(order):
    (motion,), lines = clean(swing().take(order))
    np.testing.assert_array_equal(motion.qpos, swing().qpos)
    assert lines == ["samples put in the order of their times: all 300 in swing"]
    twice = swing(np.tile(TIME, 2)).take(np.random.default_rng(0).permutation(2 * len(TIME)))
    with pytest.raises(ValueError, match="has rows in no order, at times that repeat"):
        clean(twice)


def test_a_reset_splits_a_motion():
    motion = swing()
    motion.qpos[150:, 1] += 1.0
    parts, (line,) = clean(motion)
    assert [len(part.time) for part in parts] == [150, 150]
    assert line.startswith("split where a joint jumps: swing, 1 times, first b by 1.")


def test_slow_samples_jump_too_and_fast_motions_do_not():
    motion = swing(np.arange(0, 6, 0.1))
    assert len(clean(motion)[0]) == 1
    motion.qpos[30:, 0] += 1.0
    assert len(clean(motion)[0]) == 2
    slowest = swing(np.arange(0, 6, 0.2))
    slowest.qpos[15:, 0] += 1.0
    assert len(clean(slowest)[0]) == 2
    assert len(clean(swing(amplitude=3.0))[0]) == 1  # 6 rad/s, 12 rad/s^2


def test_samples_that_jump_away_and_back_are_left_out():
    motion = swing()
    motion.qpos[100:102, 0] = 2.0
    (rest,), (line,) = clean(motion)
    assert len(rest.time) == 298 and line == "samples that jump away and back left out: 2 of 300 in swing"


def test_stamps_a_moment_apart_are_no_jump():
    """A reader that was late gives many samples nearly the same stamp, and then a long interval."""
    rng = np.random.default_rng(0)
    true = np.arange(0, 6, 1e-3)
    stamps = np.maximum.accumulate(true + rng.exponential(5e-4, len(true))) + 1e-9 * np.arange(len(true))
    for qvel in (None, swing(true).qvel):
        (motion,), lines = clean(Motion(stamps, swing(true).qpos, qvel))
        assert len(motion.time) == len(true) and not lines


def test_gaps_split_a_motion_unless_it_holds_still():
    kept = (TIME < 2) | (TIME > 3.5)
    parts, (line,) = clean(swing().take(kept))
    assert len(parts) == 2 and line == "split at gaps: swing, 1 times, first 1.54 s from 1.98 s"
    still = Motion(TIME, np.zeros((len(TIME), 2)), None).take(kept)
    assert len(clean(still)[0]) == 1


def test_repeated_times_missing_samples_and_restarts_are_told():
    motion = swing().take(np.repeat(np.arange(len(TIME)), 2))
    (once,), (line,) = clean(motion)
    np.testing.assert_array_equal(once.time, TIME)
    assert line == "repeated samples left out: 300 of 600 in swing"
    motion = swing()
    motion.qpos[7, 1] = np.nan
    (rest,), (line,) = clean(motion)
    assert len(rest.time) == 299 and line == "samples without numbers left out: 1 of 300 in swing"
    parts, (line,) = clean(swing().take(np.tile(np.arange(len(TIME)), 2)))
    assert len(parts) == 2 and line.startswith("split where time steps back: swing, 1 times")
    with pytest.raises(ValueError, match="two or more samples at times that increase"):
        clean(swing().take(slice(0, 1)))


def test_samples_out_of_order_and_doubled_ones_a_moment_later_are_repaired():
    order = np.arange(len(TIME))
    order[[50, 51]] = 51, 50
    (motion,), (line,) = clean(swing().take(order))
    np.testing.assert_array_equal(motion.time, TIME)
    assert line == "samples put in the order of their times: 1 of 299 in swing"
    twice = swing().take(np.repeat(np.arange(len(TIME)), 2))
    twice.time[1::2] += 1e-6
    (once,), _ = clean(twice)
    np.testing.assert_array_equal(once.time, TIME)


@pytest.mark.parametrize("factor", [0.0, np.nan, 180 / np.pi, -1.0])
def test_velocities_that_are_not_those_of_the_angles_are_dropped(factor):
    motion = swing()
    ((motion,), (line,)) = clean(motion._replace(qvel=factor * motion.qvel))
    assert motion.qvel is None and line.startswith("velocities computed, since the source's are")


def test_measurements_may_lie_slightly_beyond_a_range():
    narrow = np.array([[-0.495, 0.5], [-1, 1]])
    (_,), (line,) = clean(swing(), narrow)
    assert line.startswith("slightly beyond the joint range: a of swing by 0.00")
    with pytest.raises(ValueError, match=r"a of swing is at -0.5, expected rad in \[-0.4500, 0.5000\]"):
        clean(swing(), np.array([[-0.45, 0.5], [-1, 1]]))


def test_angles_that_no_arm_has_are_named():
    with pytest.raises(ValueError, match="source: swing has angles up to 5e.11 rad, which no arm has"):
        clean(swing(amplitude=5e11))
