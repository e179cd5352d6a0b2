"""Finds the arm in a MuJoCo model: the serial chain of revolute joints to a tip, or the tree to several."""

import dataclasses
from collections.abc import Iterator, Sequence

import mujoco

from mimic.arms.branches import longest_branch
from mimic.arms.model_tree import ancestors, body_id, is_revolute, joint_ids, joint_kind, tip_body

# As ints: a MuJoCo enum equals a NumPy integer in one order of the operands and not in the other.
_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_COUPLED_JOINTS = int(mujoco.mjtEq.mjEQ_JOINT)
_CONNECT, _WELD = int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)
_SITE = int(mujoco.mjtObj.mjOBJ_SITE)

Tip = str | Sequence[str] | None
ALL_ENDS = "*"  # in a list of tips


@dataclasses.dataclass(frozen=True)
class ChainIds:
    """Ids of the bodies and joints of an arm within a model.

    Attributes:
      bodies: bodies with a joint of the arm, each after its parent.
      joints: revolute joints of the arm, in the order of these bodies.
      proximal: joints between the world and the arm, which are fixed.
      distal: joints distal to the last body of a chain, which are fixed: those of a gripper or hand.
      other: the model's other joints.
      base: body that carries the arm.
      chains: joints of each chain, base to tip; one chain unless the arm is a tree.
      tips: name of the body or site at the end of each chain, None where none is named.
      names: of the chains: of the tips, or of the last bodies.
    """

    bodies: tuple[int, ...]
    joints: tuple[int, ...]
    proximal: tuple[int, ...]
    distal: tuple[int, ...]
    other: tuple[int, ...]
    base: int
    chains: tuple[tuple[int, ...], ...]
    tips: tuple[str | None, ...]
    names: tuple[str, ...]

    def roots(self, model: mujoco.MjModel) -> tuple[int, ...]:
        """The first body of each chain, each once."""
        return tuple(dict.fromkeys(int(model.jnt_bodyid[chain[0]]) for chain in self.chains))


def find_chain(model: mujoco.MjModel, base: str | None = None, tip: Tip = None) -> ChainIds:
    """The revolute joints of an arm within a model: a serial chain, or a tree of chains to several tips.

    Args:
      model: any.
      base: name of the body that carries the arm; where None, the parent of the first body with a joint of the arm, or
        the nearest common ancestor of several; the body NAME for a NAME_inertia that is fixed to it.
      tip: name of the body or site at the end of the chain. Where None, the chain follows the longest branch, without
        grippers, heads and legs as far as names tell them, and up to the last tool that is named as one. It stops
        before a hand: branches that all have fewer revolute joints than the chain so far. A list of names gives a
        tree; ["*"] stands for the ends of all branches.

    Raises:
      ValueError: no revolute joint, a joint of another kind between two revolute ones, branches of equal length, two
        coupled joints, a loop, or a name that the model lacks or that is listed twice.
    """
    start = 0 if base is None else body_id(model, base)
    tips, lasts = _ends(model, start, tip)
    names = tuple(name or model.body(last).name for name, last in zip(tips, lasts, strict=True))
    chains = tuple(_revolute_joints(model, start, last) for last in lasts)
    of_tree = {joint for chain in chains for joint in chain}
    revolute = tuple(joint for joint in range(model.njnt) if joint in of_tree)
    bodies = tuple(dict.fromkeys(int(model.jnt_bodyid[joint]) for joint in revolute))
    _reject_coupled(model, of_tree)
    _reject_loops(model, set(bodies))
    roots = {int(model.jnt_bodyid[chain[0]]) for chain in chains}
    others = [joint for joint in range(model.njnt) if joint not in of_tree]
    trunk = {body for root in roots for body in ancestors(model, root)}
    proximal = [joint for joint in others if model.jnt_bodyid[joint] in trunk]
    ends = {int(model.jnt_bodyid[chain[-1]]) for chain in chains}
    distal = [j for j in others if j not in proximal and ends & set(ancestors(model, int(model.jnt_bodyid[j])))]
    rest = [joint for joint in others if joint not in proximal and joint not in distal]
    base_body = start if base is not None else _without_inertia(model, _common_parent(model, roots))
    return ChainIds(bodies, revolute, tuple(proximal), tuple(distal), tuple(rest), base_body, chains, tips, names)


def _ends(model: mujoco.MjModel, start: int, tip: Tip) -> tuple[tuple[str | None, ...], tuple[int, ...]]:
    """The name of each tip, None where none is named, and the last body of each chain."""
    if tip is None:
        return (None,), (longest_branch(model, start),)
    names = (tip,) if isinstance(tip, str) else tuple(tip)
    if names == (ALL_ENDS,) and not isinstance(tip, str):
        ends = tuple(_all_ends(model, start))
        names = (None,) * len(ends)
    else:
        ends = tuple(tip_body(model, str(name)) for name in names)
    if not ends:
        raise ValueError("tip: expected one name or more, and for '*' a model with revolute joints, got none")
    if len(set(ends)) < len(ends):
        raise ValueError(f"tip: expected tips on different bodies, got {', '.join(map(str, names))}")
    return names, ends


def _all_ends(model: mujoco.MjModel, start: int) -> list[int]:
    """Bodies with a revolute joint, distal to a body, that have no such body distal to them."""
    moved = [body for body in range(1, model.nbody) if any(is_revolute(model, j) for j in joint_ids(model, body))]
    lines = {body: ancestors(model, body)[1:] for body in moved}
    return [b for b in moved if start in lines[b] and not any(b in lines[other] for other in moved)]


def _without_inertia(model: mujoco.MjModel, body: int) -> int:
    """The base, in place of the body that carries its inertia, which ROS's tools do not take in the root.

    UR's base_link_inertia is rotated by pi in base_link, whose axes the users of these arms know.
    """
    parent = int(model.body_parentid[body])
    is_copy = model.body(body).name == f"{model.body(parent).name}_inertia"
    return parent if is_copy and not model.body_jntnum[body] else body


def _common_parent(model: mujoco.MjModel, bodies: set[int]) -> int:
    """The last body that is a proper ancestor of all bodies."""
    lines = [ancestors(model, body)[:0:-1] for body in sorted(bodies)]
    return [same[0] for same in zip(*lines, strict=False) if len(set(same)) == 1][-1]


def _revolute_joints(model: mujoco.MjModel, start: int, last: int) -> tuple[int, ...]:
    """The revolute joints from a body to another, without those of the first.

    From the world on, where a joint of another kind is between them: those distal of it, if they are the more.
    """
    line = ancestors(model, last)[::-1]
    bodies_from_base = line[line.index(start) + 1 :] if start in line else []
    joints = [joint for body in bodies_from_base for joint in joint_ids(model, body)]
    revolute = [joint for joint in joints if is_revolute(model, joint)]
    if not revolute:
        raise ValueError("the model has no revolute joint" + (" between base and tip" if start or last else ""))
    between = [j for j in joints[joints.index(revolute[0]) : joints.index(revolute[-1])] if not is_revolute(model, j)]
    if between:
        distal = tuple(joint for joint in revolute if joints.index(joint) > joints.index(between[-1]))
        if start == 0 and 2 * len(distal) > len(revolute):
            return distal  # an arm on a lift or a mobile base
        name = model.joint(between[-1]).name
        raise ValueError(
            f"expected revolute joints only; joint {name!r} on the chain is a {joint_kind(model, between[-1])}: start "
            "distal to it with base=, or end proximal to it with tip="
        )
    return tuple(revolute)


def _reject_coupled(model: mujoco.MjModel, joints: set[int]) -> None:
    """Rejects an equality constraint between joints of the arm; others follow it, and move nothing of it."""
    for equality in _active(model, _COUPLED_JOINTS):
        coupled = {int(j) for j in (model.eq_obj1id[equality], model.eq_obj2id[equality]) if j >= 0}
        if coupled <= joints:
            names = " and ".join(repr(model.joint(joint).name) for joint in sorted(coupled))
            raise ValueError(
                f"expected joints that move on their own; {names} of the arm "
                f"{'are coupled' if len(coupled) > 1 else 'is held'} by an equality constraint or <mimic>: end the arm "
                "before with tip=, or remove the coupling"
            )


def _active(model: mujoco.MjModel, *kinds: int) -> Iterator[int]:
    yield from (i for i in range(model.neq) if model.eq_active0[i] and model.eq_type[i] in kinds)


def _reject_loops(model: mujoco.MjModel, path: set[int]) -> None:
    """Rejects a constraint between bodies that the joints of the arm move apart, directly or by way of free bodies."""
    tied: dict[int, list[tuple[int, int]]] = {}  # by the free body: what is tied to it, and the constraint
    pairs: list[tuple[int, int, int]] = []
    for equality in _active(model, _CONNECT, _WELD):
        on_sites = model.eq_objtype[equality] == _SITE
        objects = model.eq_obj1id[equality], model.eq_obj2id[equality]
        first, second = (int(model.site_bodyid[item]) if on_sites else int(item) for item in objects)
        if max(model.body_mocapid[first], model.body_mocapid[second]) >= 0:
            continue  # a mocap handle that drags the arm, not a part of it
        pairs.append((first, second, equality))
    free = {body for pair in pairs for body in pair[:2] if _is_free(model, body, path)}
    for first, second, equality in pairs:
        for body, other in ((first, second), (second, first)):
            if body in free:
                tied.setdefault(int(model.body_rootid[body]), []).append((other, equality))
    pairs = [pair for pair in pairs if not free & set(pair[:2])]
    for ties in tied.values():  # what holds a free body is tied by it
        pairs += [(ties[0][0], other, equality) for other, equality in ties[1:]]
    for first, second, equality in pairs:
        if path & (set(ancestors(model, first)) ^ set(ancestors(model, second))):
            name = model.eq(equality).name or f"number {equality + 1}"
            raise ValueError(f"expected a chain or a tree; the model has a loop, closed by equality constraint {name}")


def _is_free(model: mujoco.MjModel, body: int, path: set[int]) -> bool:
    """Whether a body belongs to an object that moves freely and carries nothing of the arm."""
    root = int(model.body_rootid[body])
    is_arm = any(int(model.body_rootid[part]) == root for part in path)
    return not is_arm and any(int(model.jnt_type[joint]) == _FREE for joint in joint_ids(model, root))
