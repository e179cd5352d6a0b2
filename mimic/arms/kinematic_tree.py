"""Which bodies of a MuJoCo model are the arm: the way from base to tip along its hinges."""

import dataclasses

import mujoco

# As ints: MuJoCo's enums equal an integer of NumPy's in one order of the operands and not in the other.
_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
_COUPLED_JOINTS = int(mujoco.mjtEq.mjEQ_JOINT)
_CONNECT, _WELD = int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)
_SITE = int(mujoco.mjtObj.mjOBJ_SITE)
_KINDS = {int(kind): kind.name.removeprefix("mjJNT_").lower() for kind in mujoco.mjtJoint.__members__.values()}


@dataclasses.dataclass(frozen=True)
class ChainIds:
    """The arm within a model, by ids.

    Attributes:
      bodies: those with hinges of the chain, base to tip.
      joints: the hinges of the chain.
      before: joints between the world and the chain, which are held.
      beyond: joints that the last body of the chain carries, which are held: a gripper's, a hand's.
      elsewhere: the model's other joints.
    """

    bodies: tuple[int, ...]
    joints: tuple[int, ...]
    before: tuple[int, ...]
    beyond: tuple[int, ...]
    elsewhere: tuple[int, ...]


def find_chain(model: mujoco.MjModel, base: str | None = None, tip: str | None = None) -> ChainIds:
    """The serial chain of hinges of a model.

    Args:
      model: any.
      base: body that the chain starts behind; the world where None.
      tip: body or site that the chain ends at. Where None, the chain goes into the longest branch wherever the model
        branches, but not into a hand: branches that all have fewer hinges than the chain had so far.

    Raises:
      ValueError: no hinge, another joint between two hinges, branches of equal length, a loop, or a name that the model
        lacks.
    """
    start = 0 if base is None else body_id(model, base)
    last = _longest(model, start) if tip is None else tip_body(model, tip)
    line = ancestors(model, last)[::-1]
    behind = line[line.index(start) + 1 :] if start in line else []
    joints = [joint for body in behind for joint in joint_ids(model, body)]
    hinges = [joint for joint in joints if is_hinge(model, joint)]
    if not hinges:
        raise ValueError("the model has no hinge joint" + (" between base and tip" if base or tip else ""))
    between = [j for j in joints[joints.index(hinges[0]) : joints.index(hinges[-1])] if not is_hinge(model, j)]
    if between:
        name = model.joint(between[-1]).name
        raise ValueError(
            f"expected hinges only; joint {name!r} on the chain is a {joint_kind(model, between[-1])}: start behind it "
            "with base=, or end before it with tip="
        )
    bodies = list(dict.fromkeys(int(model.jnt_bodyid[joint]) for joint in hinges))
    _refuse_loops(model, bodies)
    others = [joint for joint in range(model.njnt) if joint not in hinges]
    upstream = set(ancestors(model, bodies[0]))
    before = [joint for joint in others if model.jnt_bodyid[joint] in upstream]
    beyond = [j for j in others if j not in before and bodies[-1] in ancestors(model, int(model.jnt_bodyid[j]))]
    elsewhere = [joint for joint in others if joint not in before and joint not in beyond]
    return ChainIds(tuple(bodies), tuple(hinges), tuple(before), tuple(beyond), tuple(elsewhere))


def joint_kind(model: mujoco.MjModel, joint: int) -> str:
    """What a joint is: hinge, slide, ball or free."""
    return _KINDS[int(model.jnt_type[joint])]


def joint_ids(model: mujoco.MjModel, body: int) -> range:
    """Joints of a body, in order."""
    return range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])


def is_hinge(model: mujoco.MjModel, joint: int) -> bool:
    """Whether a joint is a hinge."""
    return int(model.jnt_type[joint]) == _HINGE


def ancestors(model: mujoco.MjModel, body: int) -> list[int]:
    """The body, its parent, … and the world."""
    line = [int(body)]
    while line[-1] != 0:
        line.append(int(model.body_parentid[line[-1]]))
    return line


def body_id(model: mujoco.MjModel, name: str) -> int:
    """Which body has a name.

    Raises:
      ValueError: none has.
    """
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    if body < 0:
        names = ", ".join(model.body(b).name or f"#{b}" for b in range(1, model.nbody))
        raise ValueError(f"the model has no body {name!r}; valid are {names}")
    return body


def tip_body(model: mujoco.MjModel, tip: str) -> int:
    """The body of a name, or that has the site of this name.

    Raises:
      ValueError: there is none.
    """
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, tip)
    if site >= 0:
        return int(model.site_bodyid[site])
    try:
        return body_id(model, tip)
    except ValueError as error:
        sites = ", ".join(filter(None, (model.site(s).name for s in range(model.nsite)))) or "none"
        raise ValueError(f"{error}, nor a site of that name; valid are {sites}") from None


def _longest(model: mujoco.MjModel, start: int) -> int:
    """The last body with a hinge on the longest chain behind a body."""
    hinges = [sum(is_hinge(model, joint) for joint in joint_ids(model, body)) for body in range(model.nbody)]
    below = list(hinges)  # on the longest way from each body on
    for body in range(model.nbody - 1, 0, -1):  # children come after their parents
        parent = int(model.body_parentid[body])
        below[parent] = max(below[parent], hinges[parent] + below[body])
    body, chain, last = start, 0, start
    while True:
        branches = [child for child in range(1, model.nbody) if model.body_parentid[child] == body and below[child]]
        branches.sort(key=lambda child: -below[child])
        if not branches or (len(branches) > 1 and chain > below[branches[0]]):
            return last
        if len(branches) > 1 and below[branches[0]] == below[branches[1]]:
            names = " and ".join(repr(model.body(child).name) for child in branches[:2])
            raise ValueError(
                f"the model branches: bodies {names} lead to {below[branches[0]]} hinges each; name one end with tip="
            )
        body = branches[0]
        chain += hinges[body]
        last = body if hinges[body] else last


def _refuse_loops(model: mujoco.MjModel, path: list[int]) -> None:
    """Refuses an equality constraint on the chain's joints, or between bodies that these joints move apart."""
    for equality in (i for i in range(model.neq) if model.eq_active0[i]):
        kind, objects = model.eq_type[equality], (model.eq_obj1id[equality], model.eq_obj2id[equality])
        if kind == _COUPLED_JOINTS:
            between = {int(model.jnt_bodyid[joint]) for joint in objects if joint >= 0}
        elif kind in (_CONNECT, _WELD):
            on_sites = model.eq_objtype[equality] == _SITE
            first, second = (model.site_bodyid[item] if on_sites else item for item in objects)
            if max(model.body_mocapid[first], model.body_mocapid[second]) >= 0:
                continue  # a handle that drags the arm about, not a part of it
            between = set(ancestors(model, first)) ^ set(ancestors(model, second))
        else:
            continue
        if between & set(path):
            name = model.eq(equality).name or f"number {equality + 1}"
            raise ValueError(f"expected a serial chain; the model has a loop, closed by equality constraint {name}")
