"""Corrupted data sets: each is rejected in one line, or read with a line that says what looks wrong."""

import dataclasses
import re
import warnings

import pytest

from mimic.motions.rewriting import read_data_set
from tests.helpers.corruptions import ARM, FILES, FORMATS, NUMBERS, RANGE, corrupted, real_episodes, write
from tests.helpers.real_data import ROBOSUITE, needs

pytestmark = needs(ROBOSUITE)


def cases(formats_of):
    """Each corruption in one of its formats, each time another."""
    return [(formats[index % len(formats)], name) for index, (name, formats) in enumerate(formats_of.items())]


@pytest.fixture(scope="module")
def episodes():
    pytest.importorskip("h5py")
    pytest.importorskip("pyarrow")
    return real_episodes()


def lines_of(source, arm=ARM, **options):
    """What a user reads: an error, or notes, episodes that are left out, and that there is no gripper."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            data = read_data_set(source, arm, joint_range=RANGE, **options)
    except ValueError as error:
        return [str(error)]
    return [*data.notes, *data.faults.values(), *([] if data.gripper else ["gripper: none"])]


def assert_one_says(lines, pattern):
    assert any(re.search(pattern, line) for line in lines), lines
    assert not any("\n" in line for line in lines)


@pytest.mark.parametrize("kind", FORMATS)
def test_good_data_sets_have_no_warning(tmp_path, episodes, kind):
    lines = lines_of(write(tmp_path, kind, episodes), units="rad")
    assert not [line for line in lines if line.startswith("warning") or "left out" in line]


@pytest.mark.parametrize(("kind", "name"), cases({name: item.formats for name, item in NUMBERS.items()}))
def test_numbers(tmp_path, episodes, kind, name):
    corruption = NUMBERS[name]
    source = write(tmp_path, kind, corrupted(corruption, episodes))
    assert_one_says(lines_of(source, **{"units": "rad", **corruption.options}), corruption.line)


@pytest.mark.parametrize(("kind", "name"), cases({name: item[2] for name, item in FILES.items()}))
def test_files(tmp_path, episodes, kind, name):
    change, pattern, _ = FILES[name]
    source = write(tmp_path, kind, episodes)
    change(source)
    assert_one_says(lines_of(source, units="rad"), pattern)


@pytest.mark.parametrize("kind", FORMATS)
def test_another_arm(tmp_path, episodes, kind):
    """An arm with as many joints but other lengths, and one with fewer."""
    source = write(tmp_path, kind, episodes)
    larger = dataclasses.replace(ARM, joint_anchor=1.3 * ARM.joint_anchor, hand_position=1.3 * ARM.hand_position)
    assert_one_says(lines_of(source, larger, units="rad"), "do not fit the positions of the hand")
