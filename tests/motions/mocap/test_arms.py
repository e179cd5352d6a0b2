"""Arms among the points of many tools, marker sets and skeletons, by names as these write them."""

import numpy as np
import pytest

from mimic.motions.mocap.arms import find_arms, find_facing
from mimic.motions.mocap.names import is_twist
from mimic.motions.mocap.points import PointMotion
from tests.helpers.bodies import RATE, person

ARM = ("LeftArm", "LeftForeArm", "LeftHand", "LeftHandMiddle1")


@pytest.fixture(scope="module")
def body():
    return person(10)


def _motion(body, points, parents=None):
    """A motion of points at joints of the person, or between two: {name: "LeftArm+LeftForeArm"}.

    A list of parents makes a skeleton of them.
    """
    places = [np.mean([body.point(joint) for joint in name.split("+")], axis=0) for name in points.values()]
    positions = np.stack(places, axis=1)
    return PointMotion(tuple(points), parents or (-1,) * len(points), positions, RATE)


@pytest.mark.parametrize(
    "names",
    [
        "l_shoulder l_elbow l_wrist l_middle1",  # of joints, as pose estimators
        "left_shoulder left_elbow left_wrist left_index",
        "LeftUpperArm LeftForeArm LeftHand LeftHandIndex1",
        "Bip01_L_UpperArm Bip01_L_Forearm Bip01_L_Hand Bip01_L_Finger1",
        "mixamorig:LeftArm mixamorig:LeftForeArm mixamorig:LeftHand mixamorig:LeftHandMiddle1",
        "lShldr lForeArm lHand lMid1",  # Poser
        "lShldrBend lForearmBend lHand lMid1",  # DAZ
        "lhumerus lradius lhand lfingers",  # of ASF files
        "upper_arm.L forearm.L hand.L palm.L",  # Rigify
        "upperarm01.L lowerarm01.L wrist.L finger3-1.L",  # MakeHuman
        "UpArm_L LoArm_L Hand_L Fingers_L",
        "J_Bip_L_UpperArm J_Bip_L_LowerArm J_Bip_L_Hand J_Bip_L_Middle1",  # VRM
        "CC_Base_L_Upperarm CC_Base_L_Forearm CC_Base_L_Hand CC_Base_L_Mid1",  # iClone
        "upperarm_l lowerarm_l hand_l middle_01_l",  # Unreal
        "LUArm LFArm LHand LHandMiddle",  # Motive
        "mShoulderLeft mElbowLeft mWristLeft mHandMiddle1Left",  # Second Life
        "leftarm leftforearm lefthand lefthandmiddle1",
        "LEFTARM LEFTFOREARM LEFTHAND LEFTHANDMIDDLE1",
        "左腕 左ひじ 左手首 左中指１",  # MMD
    ],
)
def test_skeletons(body, names):
    chain = ["Hips", *names.split()]
    motion = _motion(body, dict(zip(chain, ("Hips", *ARM), strict=True)), (-1, 0, 1, 2, 3))
    arm = find_arms(motion)["left"]
    assert [arm.shoulder, arm.elbow, arm.wrist, arm.hand] == [(name,) for name in chain[1:]]


def test_rotation_bones_halves_and_props_are_no_joints(body):
    half, quarter = "LeftArm+LeftForeArm", "LeftForeArm+LeftHand"
    points = {
        "LeftShoulder": "LeftShoulder", "LeftArm": "LeftArm", "LeftArmRoll": half, "LeftForeArm": "LeftForeArm",
        "LeftForeArmRoll": quarter, "LeftHand": "LeftHand", "Racket": "LeftArm", "LeftHand_end": "LeftHandMiddle1",
    }  # fmt: skip
    arm = find_arms(_motion(body, points, (-1, 0, 1, 2, 3, 4, 5, 5)))["left"]
    assert arm[1:] == (("LeftArm",), ("LeftForeArm",), ("LeftHand",), ("LeftHand_end",))
    assert all(map(is_twist, ("lForearmTwist", "ForeArm_Roll_L", "ShoulderPart1_L", "左腕捩", "upperarm_twist_01_l")))
    assert not any(map(is_twist, ("LeftForeArm", "Controller_L_Hand", "part_of_LeftHand")))
    points = {
        "upper_arm.L": "LeftArm", "upper_arm.L.001": half, "forearm.L": "LeftForeArm", "forearm.L.001": quarter,
        "hand.L": "LeftHand",
    }  # fmt: skip
    assert find_arms(_motion(body, points, (-1, 0, 1, 2, 3)))["left"][1:4] == (
        ("upper_arm.L",), ("forearm.L",), ("hand.L",),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        ("LSHO LELB LWRA LWRB LFIN LUPA LFRA", "LSHO LELB LWRA+LWRB LFIN"),  # Plug-in Gait
        ("L.Acromium L.Elbow L.Wrist.Med L.Wrist.Lat L.Bicep L.Forearm", "L.Acromium L.Elbow L.Wrist.Med+L.Wrist.Lat"),
        ("l_acromion l_humerus_epicondyle l_radius_styloid", "l_acromion l_humerus_epicondyle l_radius_styloid"),
        ("LACR LUA1 LUA2 LLEL LMEL LFAradius LFAulna LFAsuperior", "LACR LLEL+LMEL LFAradius+LFAulna"),  # Rajagopal
        ("LShoulderTop LElbowOut LElbowIn LWristOut LWristIn LHandOut", "LShoulderTop LElbowOut+LElbowIn "
         "LWristOut+LWristIn LHandOut"),
        ("LShoulder LElbow LWrist L_shoulder_study L_lelbow_study L_melbow_study L_lwrist_study L_mwrist_study",
         "LShoulder+L_shoulder_study L_lelbow_study+L_melbow_study L_lwrist_study+L_mwrist_study"),  # OpenCap
        ("L_SAJ L_HLE L_HME L_RSP L_UHE L_HM2 L_HM5", "L_SAJ L_HLE+L_HME L_RSP+L_UHE L_HM2+L_HM5"),  # CAST
        ("LGH LEL LEM LRS LUS LAC", "LGH LEL+LEM LRS+LUS"),  # ISB
        ("LSAE LELB LMEL LWRA LWRB RELBL RELBM RMEL", "LSAE LELB+LMEL LWRA+LWRB"),  # the L of RELBL is lateral
        ("LSHO LEJC LELB LMEL LWRI LRAD", "LSHO LEJC LWRI"),
        ("Bob_LSHO Bob_LELB Bob_LWRI", "Bob_LSHO Bob_LELB Bob_LWRI"),
        ("LeftShoulder LeftArm LeftForeArm LeftHand", "LeftArm LeftForeArm LeftHand"),  # a skeleton without parents
    ],
)  # fmt: skip
def test_markers(body, points, expected):
    motion = _motion(body, dict.fromkeys(points.split(), "LeftArm"))
    assert find_arms(motion)["left"][1:] == (
        *(tuple(group.split("+")) for group in expected.split()), *([()] * (4 - len(expected.split()))),
    )  # fmt: skip


def test_what_names_no_arm(body):
    for points in (
        "LWristAngles LElbowMoment LShoulderForce",
        "WheelchairRearL LHEE LTOE",
        "AArm AForeArm AHand BForeArm",
    ):
        assert find_arms(_motion(body, dict.fromkeys(points.split(), "Head"))) == {}


def test_names_without_a_side_with_letters_of_anatomy(body):
    """In EPICl, EPICm the l is lateral, in STYLr, STYLu the r is radial, and in ASISl, ASISr they are sides."""
    points = "ASISl ASISr ACRO_tip CLAV_AC SCAP_RS ARMl ARMm EPICl EPICm LARMl LARMm STYLr STYLu WRIST INDEX"
    motion = _motion(body, dict.fromkeys(points.split(), "Head"))
    assert find_arms(motion)["right"][1:] == (("ACRO_tip",), ("EPICl", "EPICm"), ("STYLr", "STYLu"), ("INDEX",))
    assert find_facing(motion) == {"left": ("ASISl",), "right": ("ASISr",)}


def test_an_upper_arm_cluster_is_no_shoulder_and_the_other_shoulder_shows_the_front(body):
    joints = {"RELB": "RightForeArm", "RWRI": "RightHand", "LSHO": "LeftArm"}
    assert find_arms(_motion(body, {"R_UpperArm_1": "RightArm+RightForeArm", **joints})) == {}
    motion = _motion(body, {"RSHO": "RightArm", **joints})
    assert set(find_arms(motion)) == {"right"}
    assert find_facing(motion) == {"left": ("LSHO",), "right": ("RSHO",)}
