"""What a learner's hand keeps of its expert's: speed in closed form, and how it is shown."""

import dataclasses
import io

import matplotlib.pyplot as plt
import numpy as np
import pytest
from rich.console import Console

import mimic
from mimic.commands import hand_reach
from mimic.commands.hand_reach import HandReach
from mimic.metric.config import MetricConfig
from mimic.retargeting.base_placement import repeated
from tests.helpers import original_model


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    file = original_model.ur_file(tmp_path_factory.mktemp("arm"))
    return mimic.build_arm(mimic.ArmConfig(model=str(file)), "hardware")


def test_the_speed_that_is_kept_is_the_ratio_of_the_limits(arm):
    """An arm keeps its own speed; with a third of the limits a third of it, whatever the yaw of its base."""
    expert, exact = arm.embodiment, np.ones(20, bool)
    poses = np.random.default_rng(2).uniform(*expert.joint_range.T, (20, 6))
    learner = dataclasses.replace(expert, velocity_limit=np.full(6, np.pi / 3))
    expert = dataclasses.replace(expert, velocity_limit=np.full(6, np.pi))
    in_place, turned_base = (repeated(np.array([[0, 0, 0, yaw]]), len(poses)) for yaw in (0.0, 1.1))
    assert hand_reach._speed((expert, expert), poses, poses, in_place, exact) == pytest.approx(1, abs=1e-4)
    turned = poses - [1.1, 0, 0, 0, 0, 0]  # about the vertical: the hand stays where it is
    assert hand_reach._speed((expert, learner), poses, turned, turned_base, exact) == pytest.approx(1 / 3, abs=1e-4)
    position = hand_reach._speed((expert, learner), poses, poses, in_place, ~exact)
    assert position.mean() > 0.4  # the linear velocity alone takes less


def test_the_table_and_the_picture_show_each_kind_of_pose(arm):
    position, rotation = np.array([0, 2e-4, 5e-4, 0.3]), np.radians([0, 0.4, 20, 0])
    hands, speed = np.arange(12.0).reshape(4, 1, 3), np.array([0.2, 0.4, 0.9, np.nan])
    reach = HandReach(np.array([0.1, 0, 0, 0]), hands, position, rotation, speed, np.array([True, False, False, False]))
    pair = arm.embodiment, dataclasses.replace(arm.embodiment, name="other")
    console = Console(width=100, record=True, file=io.StringIO())
    console.print(hand_reach.reach_table(reach, pair))
    for line in hand_reach.reach_lines(reach, pair, is_searched=False):
        console.print(line, soft_wrap=True, markup=False)
    said = console.export_text()
    for text in (
        "50.0%",
        "25.0%",
        "20.0 deg",
        "300 mm",
        "40%",
        "[0.1, 0, 0, 0]",
        "base=auto",
        "other touch each other",
    ):
        assert text in said, said
    figure, axes = plt.subplots(1, 2)
    hand_reach.plot_reach(tuple(axes), reach, pair)
    drawn = {dots.get_label(): len(dots.get_offsets()) for dots in axes[0].collections}
    assert drawn == {"exact: 50%": 2, "position alone: 25%": 1, "not reached: 25%": 1}
    plt.close(figure)


def test_without_such_a_pose_there_is_no_number(arm):
    none = HandReach(np.zeros(4), np.zeros((2, 1, 3)), np.ones(2), np.zeros(2), np.full(2, np.nan), None)
    assert none.summary()["speed"] is None and none.summary()["touching"] is None and none.score == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["panda", "base=[0,1]"], "base: expected same, auto or [x,y,z,yaw], got [0, 1]"),
        (["panda", "base=[0,0,0,90]"], "base: expected a yaw of at most 2 pi rad, got 90"),
        (["panda", "base=auto", "bound=false"], "base: expected none with bound=false, which compares no hands"),
        (["panda", "capture.yaw=90"], "capture: expected none without clip=FILE"),
        (["clip.bvh", "out=pictures"], "out: expected none with clip="),
    ],
)
def test_keys_without_effect_and_bad_bases(reason, arguments, message):
    assert message in reason("inspect", *arguments)


@pytest.mark.slow
def test_no_hand_is_reached_that_is_farther_than_the_arm_is_long(arm, tmp_path):
    file = original_model.ur_file(tmp_path)
    learner = mimic.ArmConfig()
    reach = hand_reach.hand_reach(mimic.ArmConfig(model=str(file)), learner, MetricConfig(), "auto")
    distance = np.linalg.norm(reach.hands[:, 0] - reach.base[:3], axis=-1)
    exact, alone, missed = reach.kinds
    assert exact.mean() > 0.5 and np.all(exact ^ alone ^ missed)
    assert distance[~missed].max() < mimic.build_arm(learner).embodiment.chain_length
    np.testing.assert_array_equal(np.isnan(reach.speed), missed)
    here = hand_reach.hand_reach(mimic.ArmConfig(model=str(file)), learner, MetricConfig(), None)
    assert here.score <= reach.score and not here.base.any()
