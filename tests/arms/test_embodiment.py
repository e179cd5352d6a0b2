import numpy as np
import pytest

from mimic.arms.embodiment import load_mjcf, panda, panda_path, planar_arm
from mimic.metric.kinematics import forward_kinematics, link_states
from mimic.metric.similarity import centre_line
from tests.helpers import random_arms

pytestmark = pytest.mark.usefixtures("unchecked")  # the messages are those of mimic

# Craig's DH table from the manufacturer's manual, and the segments that the metric compares, at the zero pose .
DH = [  # a_{i-1} [m], d_i [m], alpha_{i-1} [rad]
    (0, 0.333, 0),
    (0, 0, -np.pi / 2),
    (0, 0.316, np.pi / 2),
    (0.0825, 0, np.pi / 2),
    (-0.0825, 0.384, -np.pi / 2),
    (0, 0, np.pi / 2),
    (0.088, 0, np.pi / 2),
]
FLANGE = 0.107
ENDS = [
    (0, 0, 0),
    (0, 0, 0.333),
    (0, 0, 0.491),
    (0.0825, 0, 0.649),
    (0, 0, 0.841),
    (0, 0, 1.033),
    (0.088, 0, 1.033),
    (0.088, 0, 0.926),
]


# --- the Panda --------------------------------------------------------------------------------------------------------


def test_an_arm_prints_as_a_line():
    assert repr(panda(locked=["joint3"])) == "Embodiment(panda-joint3: 6 joints, 7 links)"


def test_panda_has_the_manufacturers_kinematics(x64):
    """The flange of a random pose, by the DH table."""
    qpos = np.random.default_rng(0).uniform(-2, 2, 7)
    T = np.eye(4)
    for angle, (a, d, alpha) in zip(qpos, DH, strict=True):
        (sa, ca), (s, c) = (np.sin(alpha), np.cos(alpha)), (np.sin(angle), np.cos(angle))
        T = T @ [[c, -s, 0, a], [s * ca, c * ca, -sa, -d * sa], [s * sa, c * sa, ca, d * ca], [0, 0, 0, 1]]
    frames, arm = forward_kinematics(panda(), qpos), panda()
    np.testing.assert_allclose(frames.rotation[-1, :, 0], T[:3, 2], atol=1e-12)  # rounding: link 7 is along axis 7
    end = frames.position[-1] + 0.5 * arm.link_lengths[-1] * frames.rotation[-1, :, 0]
    np.testing.assert_allclose(end, T[:3, 3] + FLANGE * T[:3, 2], atol=1e-12)  # rounding


def test_panda_limits():
    paper, real = panda(), panda(limits="hardware")
    for arm in (paper, real):
        assert arm.torque_limit.tolist() == [87.0] * 4 + [12.0] * 3
        assert arm.velocity_limit.tolist() == [2.175] * 4 + [2.61] * 3
    assert paper.joint_range.tolist() == [[-np.pi, np.pi]] * 7
    assert not paper.home.any()
    assert real.joint_range.tolist() == [
        [-2.8973, 2.8973],
        [-1.7628, 1.7628],
        [-2.8973, 2.8973],
        [-3.0718, -0.0698],
        [-2.8973, 2.8973],
        [-0.0175, 3.7525],
        [-2.8973, 2.8973],
    ]
    ready = np.pi * np.array([0, -1 / 4, 0, -3 / 4, 0, 1 / 2, 1 / 4])
    np.testing.assert_allclose(real.home, ready, atol=1e-6)  # the MJCF has six decimals
    assert np.all(real.joint_range[:, 0] < real.home) and np.all(real.home < real.joint_range[:, 1])


def test_hardware_limits_lock_at_the_ready_pose():
    locked = panda(locked=(4, "joint6"), links="kept", limits="hardware")
    full = panda(limits="hardware")
    np.testing.assert_allclose(locked.home, np.delete(full.home, [3, 5]))
    here, there = link_states(locked, locked.home), link_states(full, full.home)
    np.testing.assert_allclose(here.position, there.position, atol=1e-6)  # float32
    free = panda(locked={4: -1.0, 6: 0.5}, links="merged", limits="hardware")
    assert free.joint_names == locked.joint_names  # named angles override the ready pose
    assert abs(link_states(free, free.home).position - there.position[:5]).max() > 0.01


def test_dissimilar_pandas_of_the_paper():
    four, three = panda(locked=(3, 6, 7), links="merged"), panda(locked=(2, 3, 6, 7), links="merged")
    assert four.joint_names == ("joint1", "joint2", "joint4", "joint5")
    assert four.link_names == ("link1", "link2+link3", "link4", "link5+link6+link7")
    assert four.link_joint == (0, 1, 2, 3)
    assert three.joint_names == ("joint1", "joint4", "joint5")
    assert three.link_names == ("link1+link2+link3", "link4", "link5+link6+link7")
    assert (four.num_joints, four.num_links, three.num_joints, three.num_links) == (4, 4, 3, 3)
    ends = np.array(ENDS)
    np.testing.assert_allclose(four.link_lengths, np.linalg.norm(np.diff(ends[[0, 1, 3, 4, 7]], axis=0), axis=1))
    np.testing.assert_allclose(three.link_lengths, np.linalg.norm(np.diff(ends[[0, 3, 4, 7]], axis=0), axis=1))
    assert four.velocity_limit.tolist() == [2.175, 2.175, 2.175, 2.61]


def test_a_locked_joint_removes_no_link():
    kept, merged = panda(locked=(3, 6, 7)), panda(locked=(3, 6, 7), links="merged")
    assert (kept.num_joints, kept.link_joint) == (4, (0, 1, 1, 2, 3, 3, 3))
    assert kept.link_lengths.tolist() == panda().link_lengths.tolist()
    for arm in (kept, merged):  # the same centre line, however the metric groups it
        assert [arm.link_joint[link] for link in arm.segment_link] == list(kept.link_joint)
        np.testing.assert_allclose(arm.segment_start, ENDS[:-1], atol=1e-12)
        np.testing.assert_allclose(arm.segment_end, ENDS[1:], atol=1e-12)
    assert merged.segment_link == (0, 1, 1, 2, 3, 3, 3)


def test_segments_follow_a_joint_that_is_locked_at_an_angle():
    turned, free = (panda(locked={4: -1.0}, links=links) for links in ("kept", "merged"))
    expected = centre_line(panda(), np.array([0.1, 0.2, 0.3, -1.0, 0.5, 0.6, 0.7], np.float32))
    for arm in (turned, free):
        actual = centre_line(arm, np.array([0.1, 0.2, 0.3, 0.5, 0.6, 0.7], np.float32))
        np.testing.assert_allclose(actual.points, expected.points, atol=1e-6)  # float32


def test_locking_the_first_joint_leaves_a_link_on_the_base():
    arm = panda(locked="joint1")
    assert arm.link_joint == (-1, 0, 1, 2, 3, 4, 5)
    motion = link_states(arm, np.ones(6, np.float32), np.ones(6, np.float32))
    assert not motion.linear_velocity[0].any() and motion.linear_velocity[1].any()


def test_joints_can_be_named_in_any_way():
    by_name = panda(locked=("joint3", "joint6"))
    for locked in ([3, 6], np.array([3, 6]), {"joint3": 0, 6: 0.0}, iter(["joint3", 6])):
        arm = panda(locked=locked)
        assert (arm.name, arm.joint_names) == ("panda-joint3-joint6", by_name.joint_names)
        np.testing.assert_array_equal(arm.link_position, by_name.link_position)
    assert panda(locked=3).joint_names == panda(locked="joint3").joint_names


# --- the pytree -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("arm", [panda(), panda(locked={3: 1.0}), load_mjcf(random_arms.random_arm(8))])
def test_link_frames_are_rotations(arm):
    for rotation in arm.link_rotation:
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-11)  # entries are exact to 1e-12
        assert np.linalg.det(rotation) > 0


# --- planar arms ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "lengths", [[], [1.0, 0.0], [-0.1], [1.0, np.nan], [np.inf], [[1.0, 2.0]], 1.0], ids=lambda lengths: str(lengths)
)
def test_planar_arm_rejects_bad_lengths(lengths):
    with pytest.raises(ValueError, match=r"^link_lengths: expected one or more finite lengths above 0 \[m\], got .*$"):
        planar_arm(lengths)


@pytest.mark.parametrize("frame_at", [-0.1, 1.1, np.nan])
def test_planar_arm_rejects_a_frame_off_the_link(frame_at):
    with pytest.raises(ValueError, match=r"^frame_at: expected a fraction of the link in \[0, 1\], got "):
        planar_arm([1.0], frame_at=frame_at)


# --- bad input --------------------------------------------------------------------------------------------------------

LOCKED = [
    (["joint8"], "locked: unknown joint 'joint8'; valid are joint1, .*, joint7 or 1 to 7"),
    ([0], "locked: unknown joint 0; valid are "),
    ({"joint3": 40}, r"locked: expected a finite angle \[rad\] for joint 'joint3', at most 12.57, got 40"),
    ([2.5], "locked: unknown joint 2.5; valid are "),
    ("Joint3", "locked: unknown joint 'Joint3'; valid are "),
    (["joint3", "joint3"], "locked: joint 'joint3' is named twice"),
    ({"joint3": 0.1, 3: 0.1}, "locked: joint 'joint3' is named twice"),
    ({"joint3": np.nan}, "locked: expected a finite angle .* for joint 'joint3', at most 12.57, got nan"),
    ({"joint3": "bent"}, "locked: expected a finite angle .* for joint 'joint3', at most 12.57, got 'bent'"),
    (range(1, 8), "locked: all 7 joints are locked; at least one must stay free"),
]


@pytest.mark.parametrize(("locked", "message"), LOCKED, ids=[str(locked) for locked, _ in LOCKED])
def test_bad_locked_joints_are_rejected(locked, message):
    with pytest.raises(ValueError, match=f"^{message}") as error:
        load_mjcf(panda_path(), locked=locked)
    assert "\n" not in str(error.value)
