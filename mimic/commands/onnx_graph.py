"""JAX functions as ONNX graphs: the operations of a traced function, one by one, with a batch axis in front.

What is exported is what JAX runs, so that there is no second definition of a network to keep in step. Only operations
that the exported functions use are known.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

OPSET, IR_VERSION = 18, 8  # of 2022: reductions take their axes as inputs; runtimes since then can read it
_UNARY = {
    "abs": "Abs", "cos": "Cos", "exp": "Exp", "log": "Log", "logistic": "Sigmoid", "neg": "Neg", "not": "Not",
    "round": "Round", "sign": "Sign", "sin": "Sin", "sqrt": "Sqrt", "tanh": "Tanh",
}  # fmt: skip
_BINARY = {
    "add": "Add", "add_any": "Add", "and": "And", "div": "Div", "eq": "Equal", "ge": "GreaterOrEqual", "gt": "Greater",
    "le": "LessOrEqual", "lt": "Less", "max": "Max", "min": "Min", "mul": "Mul", "or": "Or", "pow": "Pow", "sub": "Sub",
}  # fmt: skip
_REDUCTIONS = {"reduce_sum": "ReduceSum", "reduce_max": "ReduceMax", "reduce_min": "ReduceMin"}
_TINY = np.float32(1e-30)  # in place of a divisor of 0, whose quotient has the same arc tangent


class Tensor(NamedTuple):
    """A value of the graph: its name there, and its shape in one sample."""

    name: str
    shape: tuple[int, ...]


Value = Tensor | np.ndarray  # arrays are the same for all samples


def to_onnx(
    function: Callable[[jax.Array], Mapping[str, jax.Array]],
    *,
    name: str,
    input_name: str,
    input_size: int,
    metadata: Mapping[str, str],
) -> onnx.ModelProto:
    """A function of one float32 vector as an ONNX model of a batch of any size.

    Args:
      function: gives a vector for each output, by name.
      name: of the graph.
      input_name: of the input, [batch, input_size].
      input_size: length of the vector.
      metadata: for the model's `metadata_props`.

    Raises:
      NotImplementedError: an operation that this module does not know.
    """
    traced, shapes = jax.make_jaxpr(function, return_shape=True)(jnp.zeros(input_size, jnp.float32))
    graph = _Graph(input_name)
    results = graph.run(traced.jaxpr, list(map(np.asarray, traced.consts)), [Tensor(input_name, (input_size,))])
    outputs = []
    for result, output_name in zip(results, sorted(shapes), strict=True):  # as JAX sorts the keys of a dict
        graph.nodes.append(helper.make_node("Identity", [graph.batched(result)], [output_name]))
        outputs.append(_described(output_name, shapes[output_name].shape[0]))
    inputs = [_described(input_name, input_size)]
    proto = helper.make_graph(graph.nodes, name, inputs, outputs, list(graph.constants.values()))
    opset = [helper.make_opsetid("", OPSET)]
    model = helper.make_model(proto, opset_imports=opset, ir_version=IR_VERSION, producer_name="mimic")
    helper.set_model_props(model, dict(metadata))
    onnx.checker.check_model(model, full_check=True)
    return model


def _described(name: str, size: int) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])


class _Graph:
    """A graph that grows: nodes in the order in which they run."""

    def __init__(self, input_name: str):
        self.nodes: list[onnx.NodeProto] = []
        self.constants: dict[tuple, onnx.TensorProto] = {}
        self._input = input_name
        self._names = 0

    def run(self, jaxpr: Any, consts: Sequence[Value], arguments: Sequence[Value]) -> list[Value]:
        """The results of a traced function."""
        known: dict[Any, Value] = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *arguments], strict=True))
        for equation in _needed(jaxpr):
            results = self._apply(equation, [_read(known, variable) for variable in equation.invars])
            known.update(zip(equation.outvars, results, strict=True))
        return [_read(known, variable) for variable in jaxpr.outvars]

    def _apply(self, equation: Any, inputs: list[Value]) -> list[Value]:
        primitive, params = equation.primitive, equation.params
        if not any(isinstance(value, Tensor) for value in inputs):  # the same for all samples: computed now
            results = primitive.bind(*inputs, **params)
            return list(map(np.asarray, results if primitive.multiple_results else [results]))
        inner = params.get("jaxpr", params.get("call_jaxpr"))
        if inner is not None:
            return self.run(getattr(inner, "jaxpr", inner), getattr(inner, "consts", []), inputs)
        name, shapes = primitive.name, [variable.aval.shape for variable in equation.outvars]
        if name == "split":
            return self._split(inputs[0], shapes, params["axis"])
        if name in ("copy", "optimization_barrier", "stop_gradient"):
            return inputs
        return [Tensor(self._one(name, inputs, shapes[0], params), shapes[0])]

    def _one(self, name: str, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        """The name of the result of an operation that has one."""
        if name in _UNARY:
            return self.node(_UNARY[name], *inputs)
        if name in _BINARY:
            return self.node(_BINARY[name], *inputs)
        if name in _REDUCTIONS:
            return self.node(_REDUCTIONS[name], inputs[0], _ints([axis + 1 for axis in params["axes"]]), keepdims=0)
        if name in ("reshape", "squeeze", "expand_dims"):
            return self._reshape(inputs[0], shape)
        if name not in _RULES:
            raise NotImplementedError(f"onnx: the operation {name!r} is not known; known are {', '.join(_known())}")
        return _RULES[name](self, inputs, shape, params)

    def node(self, kind: str, *inputs: Value | str, **attributes: Any) -> str:
        """Adds a node; the name of its output."""
        self._names += 1
        output = f"{kind}_{self._names}"
        self.nodes.append(helper.make_node(kind, [self.name(value) for value in inputs], [output], **attributes))
        return output

    def name(self, value: Value | str) -> str:
        """The name of a value in the graph."""
        if isinstance(value, str):
            return value
        if isinstance(value, Tensor):
            return value.name
        key = (value.tobytes(), value.shape, value.dtype.str)
        if key not in self.constants:
            self.constants[key] = numpy_helper.from_array(value, f"constant_{len(self.constants)}")
        return self.constants[key].name

    def batched(self, value: Value) -> str:
        """The name of a value with its batch axis, also where it is the same for all samples."""
        if isinstance(value, Tensor):
            return value.name
        batch = self.node("Shape", self._input, end=1)
        return self.node("Expand", value[None], self.node("Concat", batch, _ints([1] * value.ndim), axis=0))

    def _reshape(self, value: Value | str, shape: Sequence[int]) -> str:
        return self.node("Reshape", value, _ints([-1, *shape]))

    def _split(self, value: Value, shapes: list[tuple[int, ...]], axis: int) -> list[Value]:
        parts, start = [], 0
        for shape in shapes:
            bounds = _ints([start]), _ints([start + shape[axis]])
            parts.append(Tensor(self.node("Slice", value, *bounds, _ints([axis + 1])), shape))
            start += shape[axis]
        return parts

    def _integer_pow(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        return self.node("Pow", inputs[0], np.asarray(params["y"], np.float32))

    def _square(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        return self.node("Mul", inputs[0], inputs[0])

    def _rsqrt(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        return self.node("Reciprocal", self.node("Sqrt", inputs[0]))

    def _not_equal(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        return self.node("Not", self.node("Equal", *inputs))

    def _atan2(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        y, x = inputs
        zero = np.float32(0)
        divisor = self.node("Where", self.node("Equal", x, np.asarray(zero)), np.asarray(_TINY), x)
        near = self.node("Atan", self.node("Div", y, divisor))  # right where x is not negative
        half_turn = np.asarray(math.pi, np.float32), np.asarray(-math.pi, np.float32)
        turn = self.node("Where", self.node("GreaterOrEqual", y, np.asarray(zero)), *half_turn)
        is_behind = self.node("Less", divisor, np.asarray(zero))
        return self.node("Where", is_behind, self.node("Add", near, turn), near)

    def _select(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        which, otherwise, chosen = inputs  # of two cases, by a truth value
        return self.node("Where", which, chosen, otherwise)

    def _convert(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        return self.node("Cast", inputs[0], to=helper.np_dtype_to_tensor_dtype(np.dtype(params["new_dtype"])))

    def _broadcast(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        dimensions = params["broadcast_dimensions"]
        kept = [1] * len(shape)
        for axis, size in zip(dimensions, inputs[0].shape, strict=True):
            kept[axis] = size
        placed = self._reshape(inputs[0], kept)
        return placed if tuple(kept) == shape else self.node("Expand", placed, _ints([1, *shape]))

    def _slice(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        strides = params["strides"] or [1] * len(shape)
        axes = range(1, len(shape) + 1)
        ranges = params["start_indices"], params["limit_indices"], axes, strides
        return self.node("Slice", inputs[0], *map(_ints, ranges))

    def _concatenate(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        return self.node("Concat", *map(self.batched, inputs), axis=params["dimension"] + 1)

    def _stack(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        axis = params["axis"]
        one = [*shape[:axis], 1, *shape[axis + 1 :]]
        return self.node("Concat", *(self._reshape(self.batched(value), one) for value in inputs), axis=axis + 1)

    def _transpose(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        return self.node("Transpose", inputs[0], perm=[0, *(axis + 1 for axis in params["permutation"])])

    def _dot(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        (contracted, batch) = params["dimension_numbers"]
        left, right = inputs
        vector_times_matrix = (((0,), (0,)), ((), ()))
        dimensions = (tuple(map(tuple, contracted)), tuple(map(tuple, batch)))
        if dimensions != vector_times_matrix or not isinstance(right, np.ndarray) or len(left.shape) != 1:
            raise NotImplementedError(f"onnx: expected a vector times a constant matrix, got {dimensions}")
        return self.node("MatMul", left, right)

    def _argmin(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        (axis,) = params["axes"]
        return self.node("Cast", self.node("ArgMin", inputs[0], axis=axis + 1, keepdims=0), to=TensorProto.INT32)

    def _take(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        """A dynamic slice that takes one entry along the first axis."""
        rows, index, *others = inputs
        if params["slice_sizes"] != (1, *rows.shape[1:]) or any(np.any(start) for start in others):
            raise NotImplementedError(f"onnx: expected one whole row of {rows.shape}, got {params['slice_sizes']}")
        at = self._reshape(self.node("Cast", index, to=TensorProto.INT64), [1])
        return self._reshape(self.node("GatherND", rows, at, batch_dims=1), shape)


_RULES: dict[str, Callable[[_Graph, list[Value], tuple[int, ...], Mapping[str, Any]], str]] = {
    "argmin": _Graph._argmin,
    "atan2": _Graph._atan2,
    "broadcast_in_dim": _Graph._broadcast,
    "concatenate": _Graph._concatenate,
    "convert_element_type": _Graph._convert,
    "dot_general": _Graph._dot,
    "dynamic_slice": _Graph._take,
    "integer_pow": _Graph._integer_pow,
    "ne": _Graph._not_equal,
    "rsqrt": _Graph._rsqrt,
    "select_n": _Graph._select,
    "slice": _Graph._slice,
    "square": _Graph._square,
    "stack": _Graph._stack,
    "transpose": _Graph._transpose,
}


def _known() -> list[str]:
    return sorted([*_UNARY, *_BINARY, *_REDUCTIONS, *_RULES, "expand_dims", "reshape", "split", "squeeze"])


def _needed(jaxpr: Any) -> list[Any]:
    """The equations that lead to a result: PPO's network also gives a spread, which nobody exports."""
    wanted, kept = {variable for variable in jaxpr.outvars if not hasattr(variable, "val")}, []
    for equation in reversed(jaxpr.eqns):
        if wanted.intersection(equation.outvars):
            kept.append(equation)
            wanted.update(variable for variable in equation.invars if not hasattr(variable, "val"))
    return kept[::-1]


def _read(known: Mapping[Any, Value], variable: Any) -> Value:
    return np.asarray(variable.val) if hasattr(variable, "val") else known[variable]


def _ints(values: Sequence[int]) -> np.ndarray:
    return np.asarray(list(values), np.int64)
