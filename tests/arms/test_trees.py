"""Embodiments of several chains: against MuJoCo, against serial chains, and their matching."""

import jax
import mujoco
import numpy as np
import pytest

from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.capsules import fit_capsules
from mimic.arms.chain_match import matched_chains
from mimic.arms.embodiment import load_mjcf, panda_path, segment_arm
from mimic.metric.kinematics import link_state_table, link_states
from tests.helpers.trees import TORSO_TIPS, hand, largest_error, torso

GENERATED = {
    "torso": (torso(2), TORSO_TIPS, {}),
    "torso with a locked waist and elbow": (torso(), TORSO_TIPS, {"waist": 0.4, "left_joint1": -0.3}),
    "hand of 19 joints": (hand(), ["*"], {}),
}


def tree(text=None, tips=TORSO_TIPS, **options):
    return load_mjcf(mujoco.MjModel.from_xml_string(text or torso()), tip=tips, **options)


@pytest.mark.parametrize("name", GENERATED)
def test_link_states_are_those_of_mujoco(x64, name):
    text, tips, locked = GENERATED[name]
    model = mujoco.MjModel.from_xml_string(text)
    arm = load_mjcf(model, tip=tips, locked=locked)
    if name != "torso with a locked waist and elbow":  # its compilation takes longest
        error = largest_error(model, arm, tips, locked, jax.jit(lambda q, v: link_states(arm, q, v, normalized=False)))
        print(f"{name}: {arm.num_joints} joints, {arm.num_links} links, {len(arm.chains)} chains: off by {error:.1e}")
        assert error < 1e-9
    by_numpy = largest_error(model, arm, tips, locked, lambda q, v: _in_metres(arm, link_state_table(arm, q, v, float)))
    assert by_numpy < 1e-9


def _in_metres(arm, states):
    length = float(arm.chain_length)
    return states.replace(position=length * states.position, linear_velocity=length * states.linear_velocity)


def test_a_tree_of_one_chain_is_that_chain_to_the_bit():
    one, chain = (load_mjcf(panda_path(), tip=tip, locked=[3]) for tip in (["tcp"], "tcp"))
    for name, leaf in vars(chain).items():
        assert np.array_equal(getattr(one, name), leaf), name
    # The same operations, so the same numbers at the same speed.
    qpos, qvel = np.full(6, 0.1), np.full(6, 0.2)
    programs = [str(jax.make_jaxpr(lambda *x, arm=arm: link_states(arm, *x))(qpos, qvel)) for arm in (one, chain)]
    assert programs[0] == programs[1]


def test_the_chain_length_is_that_of_the_longest_chain():
    arm = tree()
    lengths = [sum(arm.link_lengths[link] for link in chain) for chain in arm.chains]
    assert arm.chain_names == ("left_hand", "right_hand")
    assert float(arm.chain_length) == pytest.approx(max(lengths)) and lengths[1] > lengths[0]
    assert float(jax.jit(lambda arm: arm.chain_length)(arm)) == pytest.approx(max(lengths))
    assert float(segment_arm(arm).chain_length) == pytest.approx(max(lengths))


@pytest.mark.parametrize(
    ("tips", "message"),
    [
        ([], "tip: expected one name or more"),
        (["left_hand", "left_hand"], "tip: expected tips on different bodies"),
        (["left_hand", "nose"], "tip: expected a body or site of the model, .*, got 'nose'"),
        (["left_hand", "stand"], "no revolute joint between base and tip"),
    ],
)
def test_wrong_tips(tips, message):
    with pytest.raises(ValueError, match=message):
        tree(tips=tips)


def test_wrong_tips_of_a_config():
    with pytest.raises(ValueError, match="tip: expected the name of a body or site, or a list"):
        ArmConfig(tip=[1, 2])


def test_links_of_a_tree_are_not_merged():
    with pytest.raises(ValueError, match="links: expected kept for a tree of 2 chains"):
        tree(links="merged", locked=["waist"])


@pytest.mark.parametrize(
    ("expert", "learner", "pairs"),
    [
        (("left_hand", "right_hand"), ("r_wrist", "l_wrist"), ((0, 1), (1, 0))),
        (("leftHand", "RightHand", "head"), ("right", "left"), ((0, 1), (1, 0))),
        (("thumb", "index", "pinky"), ("robot0:ffdistal", "robot0:thdistal"), ((0, 1), (1, 0))),
        (("a", "b"), ("c", "d"), ((0, 0), (1, 1))),
        (("arm",), ("left_hand",), ((0, 0),)),
    ],
)
def test_matched_chains(expert, learner, pairs):
    assert matched_chains(expert, learner) == pairs


def test_numbers_of_chains_that_differ():
    with pytest.raises(ValueError, match="as many chains of the expert as of the learner"):
        matched_chains(("a", "b"), ("c",))


def test_capsules_of_both_arms_can_collide(tmp_path):
    file = tmp_path / "torso.xml"
    file.write_text(torso())
    config = ArmConfig(model=str(file), tip=TORSO_TIPS)
    capsules, arm = fit_capsules(config), build_arm(config).embodiment
    joints = {(capsules.joint[i], capsules.joint[j]) for i, j in capsules.pairs}
    last_left, first_right = (arm.joint_names.index(name) for name in ("left_joint2", "right_joint0"))
    assert (last_left, first_right) in joints  # neighbours by number, not in the tree
    assert not any(arm.joint_parent[b] == a or arm.joint_parent[a] == b for a, b in joints if min(a, b) >= 0)
