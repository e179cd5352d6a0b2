"""Parts of the conversion to ONNX: values, the operations with the same meaning, and the equations of a jaxpr."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

UNARY = {
    "abs": "Abs", "cos": "Cos", "exp": "Exp", "log": "Log", "logistic": "Sigmoid", "neg": "Neg", "not": "Not",
    "round": "Round", "sign": "Sign", "sin": "Sin", "sqrt": "Sqrt", "tanh": "Tanh",
}  # fmt: skip
BINARY = {
    "add": "Add", "add_any": "Add", "and": "And", "div": "Div", "eq": "Equal", "ge": "GreaterOrEqual", "gt": "Greater",
    "le": "LessOrEqual", "lt": "Less", "max": "Max", "min": "Min", "mul": "Mul", "or": "Or", "pow": "Pow", "sub": "Sub",
}  # fmt: skip
REDUCTIONS = {"reduce_sum": "ReduceSum", "reduce_max": "ReduceMax", "reduce_min": "ReduceMin"}


class Tensor(NamedTuple):
    """A value of the graph: its name, and its shape without the batch axis."""

    name: str
    shape: tuple[int, ...]


Value = Tensor | np.ndarray  # arrays are constant over the batch


def einsum_equation(left: Value, right: Value, contracted: Any, batch: Any) -> str:
    """The equation of a general product, such as zab,zcb->zac; z is the batch axis, which constants do not have."""
    letters = iter("abcdefghijklmnopqrstuvwxy")
    of_left = [next(letters) for _ in left.shape]
    of_right = [next(letters) for _ in right.shape]
    for pairs in (contracted, batch):
        for i, j in zip(*pairs, strict=True):
            of_right[j] = of_left[i]
    shared = [of_left[i] for i in batch[0]]
    summed = {of_left[i] for i in contracted[0]}
    free = [letter for letter in (*of_left, *of_right) if letter not in summed and letter not in shared]
    terms = ("z" * isinstance(x, Tensor) + "".join(own) for x, own in ((left, of_left), (right, of_right)))
    return f"{','.join(terms)}->z{''.join((*shared, *free))}"


def live_equations(jaxpr: Any, outputs: Sequence[Any]) -> list[Any]:
    """The equations that some of the results depend on.

    They are without the standard deviation of PPO's network, for example.
    """
    live_variables, live = {variable for variable in outputs if not hasattr(variable, "val")}, []
    for equation in reversed(jaxpr.eqns):
        if live_variables.intersection(equation.outvars):
            live.append(equation)
            live_variables.update(variable for variable in equation.invars if not hasattr(variable, "val"))
    return live[::-1]


def carried_in_use(body: Any, first: int, wanted: Sequence[int]) -> list[int]:
    """Which of the values that a loop carries determine the wanted ones at its end.

    Args:
      body: the traced function of a step.
      first: index of the first carried value among its arguments.
      wanted: indices of carried values.
    """
    used = set(wanted)
    while True:
        outputs = [body.outvars[i] for i in used]
        read = {variable for equation in live_equations(body, outputs) for variable in equation.invars
                if not hasattr(variable, "val")}  # fmt: skip
        read.update(variable for variable in outputs if not hasattr(variable, "val"))
        more = {i for i, variable in enumerate(body.invars[first:]) if variable in read} - used
        if not more:
            return sorted(used)
        used |= more


def used_nodes(nodes: Sequence[Any], outputs: Sequence[str]) -> list[Any]:
    """The nodes, in their order, that outputs of a graph depend on."""
    read, used = set(outputs), []
    for node in reversed(nodes):
        if read.intersection(node.output):
            used.append(node)
            read.update(read_names(node))
    return used[::-1]


def read_names(node: Any) -> Iterator[str]:
    """The names that a node reads, in the body of a loop too."""
    yield from node.input
    for attribute in node.attribute:
        for inner in attribute.g.node:
            yield from read_names(inner)


def read_value(values: Mapping[Any, Value], variable: Any) -> Value:
    """The value of a variable or of a literal."""
    return np.asarray(variable.val, variable.aval.dtype) if hasattr(variable, "val") else values[variable]


def ints(values: Sequence[int]) -> np.ndarray:
    """A vector of integers, as attributes of shape."""
    return np.asarray(list(values), np.int64)
