"""Lost processes: who is named, and when."""

from typing import Any

import pytest

from mimic.trainers.distributed import heartbeats
from mimic.trainers.distributed.heartbeats import Heartbeats


@pytest.fixture
def clock(monkeypatch):
    """A clock that tests set."""

    class Clock:
        now = 100.0

    monkeypatch.setattr(heartbeats.time, "monotonic", lambda: Clock.now)
    return Clock


def run(beats, clock, seconds, alive, sign=""):
    """Some processes give signs for a time; the last verdict."""
    verdict: Any = None
    for step in range(int(seconds * 2)):
        clock.now += 0.5
        for process in alive:
            beats.hear(process, f"{sign}{step}")
        verdict = beats.lost()
        if verdict:
            break
    return verdict


def test_all_that_live_are_kept(clock):
    assert run(Heartbeats(3), clock, 200, [0, 1, 2]) is None


@pytest.mark.parametrize("lost", [0, 1, 2])
def test_the_silent_one_is_named_within_half_a_minute(clock, lost):
    beats = Heartbeats(3)
    run(beats, clock, 50, [0, 1, 2])
    process, silence = run(beats, clock, 60, {0, 1, 2} - {lost}, "later")
    assert process == lost and 30 < silence < 32


def test_the_first_one_is_named_if_nothing_is_heard(clock):
    beats = Heartbeats(3)
    run(beats, clock, 50, [0, 1, 2])
    clock.now += 1
    beats.hear(2, "late")  # read before the first process was stopped
    assert run(beats, clock, 60, [])[0] == 0


def test_the_same_sign_again_is_none(clock):
    beats = Heartbeats(2)
    lost: Any = None
    for _ in range(80):
        clock.now += 0.5
        beats.hear(0, f"{clock.now}")
        beats.hear(1, "same")
        if lost := beats.lost():
            break
    assert lost[0] == 1


def test_a_pause_of_this_process_is_no_silence_of_the_others(clock):
    beats = Heartbeats(2)
    run(beats, clock, 20, [0, 1])
    clock.now += 3600  # suspended with the machine, or stopped
    assert beats.lost() is None
    assert run(beats, clock, 100, [0, 1], "later") is None
