"""Conversion of JAX functions to ONNX graphs: each operation of a traced function, with a leading batch axis.

The graph is converted from what JAX runs, so that no second definition of a network must be kept consistent. Only the
operations that the exported functions use are supported.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from mimic.base.compat import scan_sizes
from mimic.trainers.export.onnx_operations import (
    BINARY,
    REDUCTIONS,
    UNARY,
    Tensor,
    Value,
    carried_in_use,
    einsum_equation,
    ints,
    live_equations,
    read_names,
    read_value,
    used_nodes,
)

OPSET, IR_VERSION = 18, 8  # of 2022: reductions take axes as inputs; supported by all runtimes since then
_TINY = np.float32(1e-30)  # replaces a divisor of 0: the quotient has the same arc tangent


def to_onnx(
    function: Callable[..., Mapping[str, jax.Array]],
    *,
    name: str,
    inputs: Mapping[str, int],
    metadata: Mapping[str, str],
) -> onnx.ModelProto:
    """Converts a function of float32 vectors to an ONNX model with any batch size.

    Args:
      function: maps a vector for each input to the named output vectors.
      name: name of the graph.
      inputs: length of the vector of each input [batch, length], which all have the same batch size.
      metadata: `metadata_props` of the model.

    Raises:
      NotImplementedError: the function uses an unsupported operation.
    """
    vectors = [jnp.zeros(size, jnp.float32) for size in inputs.values()]
    traced, shapes = jax.make_jaxpr(function, return_shape=True)(*vectors)
    graph = _Graph(next(iter(inputs)))
    arguments = [Tensor(key, (size,)) for key, size in inputs.items()]
    results = graph.run(traced.jaxpr, list(map(np.asarray, traced.consts)), arguments)
    outputs = []
    for result, output_name in zip(results, sorted(shapes), strict=True):  # JAX sorts the keys of a dict
        graph.nodes.append(helper.make_node("Identity", [graph.batched(result)], [output_name]))
        outputs.append(_value_info(output_name, shapes[output_name].shape[0]))
    input_infos = [_value_info(*item) for item in inputs.items()]
    nodes = used_nodes(graph.nodes, [output.name for output in outputs])
    read = {key for node in nodes for key in read_names(node)}
    constants = [constant for constant in graph.constants.values() if constant.name in read]
    proto = helper.make_graph(nodes, name, input_infos, outputs, constants)
    opset = [helper.make_opsetid("", OPSET)]
    model = helper.make_model(proto, opset_imports=opset, ir_version=IR_VERSION, producer_name="mimic")
    helper.set_model_props(model, dict(metadata))
    onnx.checker.check_model(model, full_check=True)
    return model


def _value_info(name: str, size: int) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])


def _value_infos(names: Sequence[str], avals: Sequence[Any]) -> list[onnx.ValueInfoProto]:
    """Names, types and shapes, from JAX's description of a sample."""
    types = [helper.np_dtype_to_tensor_dtype(np.dtype(aval.dtype)) for aval in avals]
    shapes = [["batch", *aval.shape] for aval in avals]
    return [helper.make_tensor_value_info(*info) for info in zip(names, types, shapes, strict=True)]


class _Graph:
    """A graph under construction, with its nodes in execution order."""

    def __init__(self, input_name: str):
        self.nodes: list[onnx.NodeProto] = []
        self.constants: dict[tuple, onnx.TensorProto] = {}
        self._input = input_name
        self._names = 0
        self._outputs: dict[tuple[str, ...], str] = {}  # of each node, by its operation and its inputs

    def run(
        self, jaxpr: Any, consts: Sequence[Value], arguments: Sequence[Value | None], kept: Sequence[int] | None = None
    ) -> list[Value]:
        """Adds a traced function and returns its results, or those that are kept; others may lack arguments."""
        outputs = jaxpr.outvars if kept is None else [jaxpr.outvars[i] for i in kept]
        values: dict[Any, Any] = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *arguments], strict=True))
        live = live_equations(jaxpr, outputs)
        read = {variable for equation in live for variable in equation.invars if not hasattr(variable, "val")}
        read |= {variable for variable in outputs if not hasattr(variable, "val")}
        for equation in live:
            inputs = [read_value(values, variable) for variable in equation.invars]
            if equation.primitive.name == "scan" and any(isinstance(value, Tensor) for value in inputs):
                results = self._loop(equation, inputs, [variable in read for variable in equation.outvars])
            else:
                results = self._apply(equation, inputs)
            values.update(zip(equation.outvars, results, strict=True))
        return [read_value(values, variable) for variable in outputs]

    def _apply(self, equation: Any, inputs: list[Value]) -> Sequence[Value | None]:
        primitive, params = equation.primitive, equation.params
        if primitive.name == "platform_index":  # of a function with another form on TPUs
            return [np.asarray(0)]
        if primitive.name == "cond" and params.get("branches_platforms"):
            default = params["branches"][params["branches_platforms"].index(None)]
            return self.run(default.jaxpr, default.consts, inputs[1:])
        if not any(isinstance(value, Tensor) for value in inputs):  # constant over the batch: folded
            results = primitive.bind(*inputs, **params)
            return list(map(np.asarray, results if primitive.multiple_results else [results]))
        inner = params.get("jaxpr", params.get("call_jaxpr"))
        if inner is not None:
            return self.run(getattr(inner, "jaxpr", inner), getattr(inner, "consts", []), inputs)
        name, shapes = primitive.name, [variable.aval.shape for variable in equation.outvars]
        if name == "split":
            return self._split(inputs[0], shapes, params["axis"])
        if name == "unstack":
            return self._unstack(inputs[0], shapes, params["axis"])
        if name == "sort":
            return self._sort(inputs, shapes, params)
        if name in ("copy", "optimization_barrier", "stop_gradient"):
            return inputs
        if name == "select_n" and equation.outvars[0].aval.dtype == bool:
            name = "select_bool"
        return [Tensor(self._single_output(name, inputs, shapes[0], params), shapes[0])]

    def _loop(self, equation: Any, inputs: list[Value], is_read: Sequence[bool]) -> list[Value | None]:
        """A loop over a constant number of steps: what it carries, at its end; None for what is not read."""
        params, body = equation.params, equation.params["jaxpr"]
        first, count = scan_sizes(params)
        consts, carried = inputs[:first], inputs[first:]
        if len(carried) != count or any(is_read[count:]):
            raise NotImplementedError("onnx: expected a loop without values for each step")
        kept = carried_in_use(body.jaxpr, first, [i for i in range(count) if is_read[i]])
        avals = [equation.invars[first + i].aval for i in kept]
        self._names += 1
        name = f"Loop_{self._names}"
        states, after, results = ([f"{name}_{key}_{i}" for i in kept] for key in ("before", "after", "end"))

        outer = self.nodes, self._outputs
        self.nodes, self._outputs = [], dict(self._outputs)  # a step reads what is outside, and not the reverse
        arguments: list[Value | None] = [*consts, *[None] * count]
        for i, state, aval in zip(kept, states, avals, strict=True):
            arguments[first + i] = Tensor(state, aval.shape)
        values = self.run(body.jaxpr, list(map(np.asarray, body.consts)), arguments, kept)
        pairs = [*zip(map(self.batched, values), after, strict=True), (f"{name}_runs", f"{name}_goes_on")]
        nodes = [*self.nodes, *(helper.make_node("Identity", [value], [output]) for value, output in pairs)]
        self.nodes, self._outputs = outer

        number = helper.make_tensor_value_info(f"{name}_number", TensorProto.INT64, [])
        runs, goes_on = (
            helper.make_tensor_value_info(f"{name}_{x}", TensorProto.BOOL, []) for x in ("runs", "goes_on")
        )
        step_inputs, step_outputs = [number, runs, *_value_infos(states, avals)], [goes_on, *_value_infos(after, avals)]
        graph = helper.make_graph(used_nodes(nodes, [f"{name}_goes_on", *after]), name, step_inputs, step_outputs)
        length = self.name(np.asarray(params["length"], np.int64))
        start = [self.batched(carried[i]) for i in kept]
        self.nodes.append(helper.make_node("Loop", [length, "", *start], results, body=graph))
        at_end: list[Value | None] = [None] * len(is_read)
        for i, result, aval in zip(kept, results, avals, strict=True):
            at_end[i] = Tensor(result, aval.shape)
        return at_end

    def _single_output(self, name: str, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        """Adds an operation with one output, and returns its name."""
        if name in UNARY:
            return self.node(UNARY[name], *inputs)
        if name in BINARY:
            return self.node(BINARY[name], *(self._aligned(value, shape) for value in inputs))
        if name in REDUCTIONS:
            return self.node(REDUCTIONS[name], inputs[0], ints([axis + 1 for axis in params["axes"]]), keepdims=0)
        if name in ("reshape", "squeeze", "expand_dims"):
            return self._reshape(inputs[0], shape)
        if name not in _RULES:
            raise NotImplementedError(f"onnx: unsupported operation {name!r}; supported are {', '.join(_supported())}")
        return _RULES[name](self, inputs, shape, params)

    def node(self, kind: str, *inputs: Value | str, **attributes: Any) -> str:
        """Adds a node, unless there is the same one already, and returns the name of its output."""
        names = [self.name(value) for value in inputs]
        key = kind, *names, repr(sorted(attributes.items()))
        if key not in self._outputs:
            self._names += 1
            self._outputs[key] = f"{kind}_{self._names}"
            self.nodes.append(helper.make_node(kind, names, [self._outputs[key]], **attributes))
        return self._outputs[key]

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
        """The name of a value with a batch axis, which is added to constants."""
        if isinstance(value, Tensor):
            return value.name
        batch = self.node("Shape", self._input, end=1)
        return self.node("Expand", value[None], self.node("Concat", batch, ints([1] * value.ndim), axis=0))

    def _aligned(self, value: Value, shape: tuple[int, ...]) -> Value | str:
        """A number of each sample with the axes of a result; JAX broadcasts numbers, and ONNX aligns the last axes."""
        is_number = isinstance(value, Tensor) and not value.shape and shape
        return self._reshape(value, [1] * len(shape)) if is_number else value

    def _reshape(self, value: Value | str, shape: Sequence[int]) -> str:
        return self.node("Reshape", value, ints([-1, *shape]))

    def _split(self, value: Value, shapes: list[tuple[int, ...]], axis: int) -> list[Value]:
        self._names += 1
        names = [f"Split_{self._names}_{part}" for part in range(len(shapes))]
        inputs = [self.name(value), self.name(ints([shape[axis] for shape in shapes]))]
        self.nodes.append(helper.make_node("Split", inputs, names, axis=axis + 1))
        return [Tensor(name, shape) for name, shape in zip(names, shapes, strict=True)]

    def _unstack(self, value: Value, shapes: list[tuple[int, ...]], axis: int) -> list[Value]:
        parts = self._split(value, [(*shape[:axis], 1, *shape[axis:]) for shape in shapes], axis)
        return [Tensor(self._reshape(part, shape), shape) for part, shape in zip(parts, shapes, strict=True)]

    def _sort(self, inputs: list[Value], shapes: list[tuple[int, ...]], params: Mapping[str, Any]) -> list[Value]:
        """Arrays in the ascending order of the first one."""
        if params["num_keys"] != 1:
            raise NotImplementedError(f"onnx: expected a sort by one array, got {params['num_keys']}")
        axis = params["dimension"] + 1
        self._names += 1
        names = [f"TopK_{self._names}_{part}" for part in range(2)]  # equal ones keep their order
        keys = [self.batched(inputs[0]), self.name(ints([shapes[0][axis - 1]]))]
        self.nodes.append(helper.make_node("TopK", keys, names, axis=axis, largest=0, sorted=1))
        others = (self.node("GatherElements", self.batched(value), names[1], axis=axis) for value in inputs[1:])
        return [Tensor(name, shape) for name, shape in zip([names[0], *others], shapes, strict=True)]

    def _any(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        numbers = self.node("Cast", inputs[0], to=TensorProto.INT32)
        largest = self.node("ReduceMax", numbers, ints([axis + 1 for axis in params["axes"]]), keepdims=0)
        return self.node("Cast", largest, to=TensorProto.BOOL)

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
        angle = self.node("Atan", self.node("Div", y, divisor))  # correct for x >= 0
        pi = np.asarray(math.pi, np.float32), np.asarray(-math.pi, np.float32)
        shift = self.node("Where", self.node("GreaterOrEqual", y, np.asarray(zero)), *pi)
        is_negative = self.node("Less", divisor, np.asarray(zero))
        return self.node("Where", is_negative, self.node("Add", angle, shift), angle)

    def _select(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        condition, if_false, if_true = inputs
        return self.node("Where", self._aligned(condition, shape), if_true, if_false)

    def _select_bool(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        """Runtimes have no Where of truth values."""
        condition, if_false, if_true = inputs
        condition = self._aligned(condition, shape)
        return self.node(
            "Or",
            self.node("And", condition, if_true),
            self.node("And", self.node("Not", condition), if_false),
        )

    def _convert(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        return self.node("Cast", inputs[0], to=helper.np_dtype_to_tensor_dtype(np.dtype(params["new_dtype"])))

    def _broadcast(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        dimensions = params["broadcast_dimensions"]
        aligned = [1] * len(shape)
        for axis, size in zip(dimensions, inputs[0].shape, strict=True):
            aligned[axis] = size
        reshaped = self._reshape(inputs[0], aligned)
        return reshaped if tuple(aligned) == shape else self.node("Expand", reshaped, ints([1, *shape]))

    def _slice(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        strides = params["strides"] or [1] * len(shape)
        axes = range(1, len(shape) + 1)
        ranges = params["start_indices"], params["limit_indices"], axes, strides
        return self.node("Slice", inputs[0], *map(ints, ranges))

    def _concatenate(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        return self.node("Concat", *map(self.batched, inputs), axis=params["dimension"] + 1)

    def _stack(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        axis = params["axis"]
        unit_shape = [*shape[:axis], 1, *shape[axis + 1 :]]
        return self.node("Concat", *(self._reshape(self.batched(value), unit_shape) for value in inputs), axis=axis + 1)

    def _transpose(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        return self.node("Transpose", inputs[0], perm=[0, *(axis + 1 for axis in params["permutation"])])

    def _dot(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        (contracted, batch) = params["dimension_numbers"]
        left, right = inputs
        dimensions = (tuple(map(tuple, contracted)), tuple(map(tuple, batch)))
        is_vector_times_matrix = dimensions == (((0,), (0,)), ((), ())) and isinstance(right, np.ndarray)
        is_product_of_matrices = dimensions == (((1,), (0,)), ((), ())) and len(right.shape) == 2
        if (is_vector_times_matrix and len(left.shape) == 1) or (is_product_of_matrices and len(left.shape) == 2):
            return self.node("MatMul", left, right)
        return self.node("Einsum", left, right, equation=einsum_equation(left, right, contracted, batch))

    def _cumsum(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        return self.node("CumSum", inputs[0], np.asarray(params["axis"] + 1), reverse=int(params["reverse"]))

    def _pad(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        values, filling = inputs
        low, high, inner = zip(*params["padding_config"], strict=True)
        if any(inner) or min(*low, *high) < 0:
            raise NotImplementedError(f"onnx: expected padding outside only, got {params['padding_config']}")
        return self.node("Pad", values, ints([0, *low, 0, *high]), filling)

    def _gather(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        """Entries along one axis, by a vector of indices; or numbers at constant positions, such as a diagonal."""
        values, indices = inputs
        numbers = params["dimension_numbers"]
        lead = len(values.shape) - len(numbers.start_index_map)
        last = tuple(range(lead, len(values.shape)))
        if isinstance(indices, np.ndarray) and tuple(numbers.start_index_map) == last == numbers.collapsed_slice_dims:
            whole, inner = values.shape[:lead], values.shape[lead:]
            positions = np.asarray(np.ravel_multi_index(tuple(np.moveaxis(indices, -1, 0)), inner))
            flat = self._reshape(values, [*whole, math.prod(inner)])
            return self.node("Gather", flat, ints(positions.tolist()), axis=lead + 1)
        (axis,) = map(int, numbers.start_index_map)
        kept = tuple(i for i in range(len(shape)) if i != axis)
        is_along_axis = tuple(map(int, numbers.offset_dims)) == kept and len(values.shape) == len(shape)
        if not is_along_axis or tuple(map(int, numbers.collapsed_slice_dims)) != (axis,) or len(indices.shape) != 2:
            raise NotImplementedError(f"onnx: expected entries along one axis, got {numbers}")
        aligned = [1] * len(shape)
        aligned[axis] = shape[axis]
        positions = self._reshape(self.node("Cast", self.batched(indices), to=TensorProto.INT64), aligned)
        everywhere = self.node("Expand", positions, ints([1, *shape]))
        return self.node("GatherElements", self.batched(values), everywhere, axis=axis + 1)

    def _clamp(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        low, values, high = inputs
        if low.shape or high.shape:
            raise NotImplementedError("onnx: expected a clamp between two numbers")
        return self.node("Clip", values, low, high)

    def _argmin(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        (axis,) = params["axes"]
        return self.node("Cast", self.node("ArgMin", inputs[0], axis=axis + 1, keepdims=0), to=TensorProto.INT32)

    def _take(self, inputs: list[Value], shape: tuple[int, ...], params: Mapping[str, Any]) -> str:
        """A dynamic slice that takes one entry along the first axis."""
        rows, index, *others = inputs
        if params["slice_sizes"] != (1, *rows.shape[1:]) or any(np.any(start) for start in others):
            raise NotImplementedError(f"onnx: expected one whole row of {rows.shape}, got {params['slice_sizes']}")
        position = self._reshape(self.node("Cast", index, to=TensorProto.INT64), [1])
        return self._reshape(self.node("GatherND", rows, position, batch_dims=1), shape)


_RULES: dict[str, Callable[[_Graph, list[Value], tuple[int, ...], Mapping[str, Any]], str]] = {
    "argmin": _Graph._argmin,
    "clamp": _Graph._clamp,
    "atan2": _Graph._atan2,
    "broadcast_in_dim": _Graph._broadcast,
    "concatenate": _Graph._concatenate,
    "convert_element_type": _Graph._convert,
    "cumsum": _Graph._cumsum,
    "dot_general": _Graph._dot,
    "dynamic_slice": _Graph._take,
    "gather": _Graph._gather,
    "integer_pow": _Graph._integer_pow,
    "ne": _Graph._not_equal,
    "pad": _Graph._pad,
    "reduce_or": _Graph._any,
    "rsqrt": _Graph._rsqrt,
    "select_bool": _Graph._select_bool,
    "select_n": _Graph._select,
    "slice": _Graph._slice,
    "square": _Graph._square,
    "stack": _Graph._stack,
    "transpose": _Graph._transpose,
}


def _supported() -> list[str]:
    return sorted(
        [*UNARY, *BINARY, *REDUCTIONS, *_RULES, "expand_dims", "reshape", "scan", "sort", "split", "squeeze", "unstack"]
    )
