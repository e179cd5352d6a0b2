"""What the names of links, frames and joints say: tools, grippers, sensors, limbs that are no arm, sides."""

import re

_WORD = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+")

# Frames at the working point or the mount of a tool, the most telling first: each is a set of words.
_TOOLS = (
    {"tcp"}, {"pinch"}, {"grip"}, {"grasp"}, {"grasping"}, {"ee"}, {"eef"}, {"eff"}, {"endeffector"}, {"effector"},
    {"gripper", "frame"}, {"gripperframe"}, {"gripper", "center"}, {"tool"}, {"attachment"}, {"flange"},
)  # fmt: skip
_HANDS = ({"tip"}, {"hand"}, {"palm"}, {"gripper"}, {"end"})  # frames of a hand, which may be where it begins
_SENSORS = {
    "camera", "cam", "optical", "sensor", "imu", "lidar", "laser", "depth", "range", "torque", "light", "led", "marker",
    "tag",
}  # fmt: skip
_FINGERS = {"finger", "fingers", "jaw", "jaws", "claw", "thumb", "index", "pinky"}
_GRIPPERS = {"gripper", "grip", "grasp", *_FINGERS}
_MOVERS = {"moving", "mover", "movable", "prop"}  # of a gripper, if a link is called so
_WRISTS = {"wrist", "roll", "pitch", "yaw", "rotate", "rotation", "rot", "swivel", "twist", "flex", "elbow"}
_FIXED = {"fixed", "static", "base"}
# Limbs that are no arm, by the joint, or by the link, at which they begin.
_OTHER_LIMBS = {
    "head", "neck", "eye", "eyes", "ear", "camera", "cam", "leg", "hip", "thigh", "knee", "calf", "ankle", "foot",
    "toe", "wheel", "caster", "castor", "tail", "antenna", "propeller", "rotor", "fan",
}  # fmt: skip
_OTHER_LINKS = {"head", "neck", "leg", "hip", "thigh", "shank", "wheel"}
_SIDES = {"left": "left", "l": "left", "right": "right", "r": "right"}
# What may follow the letter of a side in one word: RARM, lh, lwrist.
_LIMB_PARTS = "arm|hand|h|wrist|w|elbow|shoulder|palm|gripper|finger|forearm|tool|tcp|ee|eef"
_SIDE = re.compile(rf"(left|right)[a-z]*|(l|r)(?:{_LIMB_PARTS})")


def words(name: str) -> list[str]:
    """The words of a name in lower case: `LeftHand_tool0` has left, hand, tool."""
    return [word.lower() for word in _WORD.findall(name)]


def tool_rank(name: str) -> int | None:
    """How telling the name of a frame is as that of a tool, 0 for the most telling; None for another name."""
    return _rank(name, _TOOLS)


def hand_rank(name: str) -> int | None:
    """As `tool_rank`, for the names of hands and their parts but fingers."""
    return None if set(words(name)) & _FINGERS else _rank(name, _HANDS)


def _rank(name: str, table: tuple[set[str], ...]) -> int | None:
    present = set(words(name))
    if present & _SENSORS:
        return None
    return next((rank for rank, telling in enumerate(table) if telling <= present), None)


def is_sensor(name: str) -> bool:
    """Whether a frame is that of a sensor or light."""
    return bool(set(words(name)) & _SENSORS)


def is_gripper_joint(joint: str, link: str) -> bool:
    """Whether a joint moves fingers or drives a gripper, by its name and that of the link that it moves.

    A wrist that moves a gripper as a whole does not: `wrist_roll` of `gripper_link`, `gripper_roll`.
    """
    of_joint, of_link = set(words(joint)), set(words(link))
    if of_joint & _WRISTS:
        return False
    if of_joint & _GRIPPERS:
        return True
    is_finger = bool(of_link & _FINGERS) or bool(of_link & {"gripper"} and of_link & _MOVERS)
    return is_finger and not of_link & _FIXED


def is_other_limb(joint: str, link: str) -> bool:
    """Whether a joint begins a head, a leg or wheels, by its name and that of the link that it moves."""
    return bool(set(words(joint)) & _OTHER_LIMBS or set(words(link)) & _OTHER_LINKS)


def side(name: str) -> str:
    """The side that a name tells first, left or right; "" for none."""
    return next(iter(_sides(name)), "")


def finger_side(name: str) -> str:
    """The side of a finger within its hand, which its name tells last: `right_hand_l_finger` is left; "" for none."""
    return (["", *_sides(name)])[-1]


def _sides(name: str) -> list[str]:
    sides = []
    for word in words(name):
        if part := _SIDE.fullmatch(word):
            sides.append(_SIDES[part[1] or part[2]])
        elif word in _SIDES:
            sides.append(_SIDES[word])
    return sides
