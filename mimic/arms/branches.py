"""Finds the branch of a MuJoCo model that is its arm: the longest without grippers, heads and legs, up to a tool."""

import dataclasses
from collections.abc import Callable, Iterator

import mujoco

from mimic.arms.model_tree import ancestors, is_revolute, joint_ids
from mimic.arms.names import hand_rank, is_gripper_joint, is_other_limb
from mimic.arms.tool_frames import named_frame
from mimic.base.overrides import setting

_MAX_ENDS = 6  # in a message


@dataclasses.dataclass(frozen=True)
class _ArmJoints:
    """The revolute joints of a model that may be an arm's.

    Attributes:
      counts: number of joints of each body.
      distal: number of joints on the longest chain from each body on.
      with_fingers: bodies at which fingers begin that are not counted.
    """

    counts: list[int]
    distal: list[int]
    with_fingers: set[int]


def longest_branch(model: mujoco.MjModel, start: int) -> int:
    """The last body with a joint of an arm, on the longest chain distal to a body.

    Raises:
      ValueError: several chains are equally long. The line names ends that work as `tip`.
    """
    joints = _arm_joints(model, start)
    ends = list(_ends(model, start, joints, 0, start))
    if len(ends) == 1:
        return _before_tool(model, ends[0], joints)
    total = sum(joints.counts[body] for body in ancestors(model, ends[0]))
    tools = [named_frame(model, end) for end in ends]
    names = [tool or named_frame(model, end, hand_rank) or model.body(end).name
             for tool, end in zip(tools, ends, strict=True)]  # fmt: skip
    likeliest = next(filter(None, tools), names[0])
    listed = ", ".join(map(repr, names[:_MAX_ENDS])) + " and others" * (len(names) > _MAX_ENDS)
    raise ValueError(
        f"the model branches: {len(ends)} chains of {total} revolute joints end at {listed}; name one, as in "
        f"{setting('tip', likeliest)}, several, as in {setting('tip', names[:2])}, or all ends of the model with "
        'tip=["*"]'
    )


def _arm_joints(model: mujoco.MjModel, start: int) -> _ArmJoints:
    """The joints distal to a body without those of grippers and other limbs, if some remain."""
    rules = (lambda *names: is_gripper_joint(*names) or is_other_limb(*names), is_gripper_joint, lambda *_: False)
    for is_left_out in rules:
        counts = _counts(model, start, is_left_out)
        if any(counts):
            break
    distal = list(counts)
    for body in range(model.nbody - 1, 0, -1):  # children come after their parents
        parent = int(model.body_parentid[body])
        distal[parent] = max(distal[parent], counts[parent] + distal[body])
    begins = [body for body in range(1, model.nbody) if not distal[body] and _begins(model, body, is_gripper_joint)]
    carriers = {int(model.body_weldid[model.body_parentid[body]]) for body in begins}
    return _ArmJoints(counts, distal, {body for body in range(model.nbody) if model.body_weldid[body] in carriers})


def _counts(model: mujoco.MjModel, start: int, is_left_out: Callable[[str, str], bool]) -> list[int]:
    """Number of revolute joints of each body distal to a body, but not where what is left out begins."""
    counts, left_out = [0], {0}
    for body in range(1, model.nbody):
        if int(model.body_parentid[body]) in left_out - {0} or _begins(model, body, is_left_out):
            left_out.add(body)
        is_part = body not in left_out and start in ancestors(model, body)
        counts.append(sum(is_revolute(model, joint) for joint in joint_ids(model, body)) if is_part else 0)
    return counts


def _begins(model: mujoco.MjModel, body: int, is_such: Callable[[str, str], bool]) -> bool:
    """Whether a joint of a body is such, by its name and that of the body."""
    return any(is_such(model.joint(joint).name, model.body(body).name) for joint in joint_ids(model, body))


def _ends(model: mujoco.MjModel, body: int, joints: _ArmJoints, chain: int, last: int) -> Iterator[int]:
    """The last body with a joint on each of the longest chains distal to a body, several if they are equally long.

    A hand ends the chain: branches, fingers among them, that all have fewer joints than the chain so far.

    Args:
      model: with the chains.
      body: at which they start.
      joints: of the model.
      chain: number of joints up to this body.
      last: the last body with a joint up to this one.
    """
    while True:
        last = body if joints.counts[body] else last
        children = [child for child in range(1, model.nbody) if model.body_parentid[child] == body]
        branches = [child for child in children if joints.distal[child]]
        longest = [child for child in branches if joints.distal[child] == max(joints.distal[x] for x in branches)]
        is_hand = len(branches) > 1 or body in joints.with_fingers
        if not branches or (is_hand and chain > joints.distal[longest[0]]):
            yield last
            return
        if len(longest) > 1:
            for child in longest:
                yield from _ends(model, child, joints, chain + joints.counts[child], last)
            return
        body = longest[0]
        chain += joints.counts[body]


def _before_tool(model: mujoco.MjModel, last: int, joints: _ArmJoints) -> int:
    """The last body of a chain, or an earlier one with a tool, if fewer joints are distal of it than proximal."""
    distal = 0
    for body in (body for body in ancestors(model, last) if joints.counts[body]):
        if distal >= sum(joints.counts[part] for part in ancestors(model, body)):
            break
        if named_frame(model, body):
            return body
        distal += joints.counts[body]
    return last
