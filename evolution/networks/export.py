"""Export of policies to ONNX: a graph computes n actions from n of the environment's observations.

Inputs of an `mlp`: `observation`, float32 [n, inputs]. Inputs of a `cnn`: `grid`, uint8 [n, frames, 80, 80], and
`speed`, float32 [n, 1], a share of `vehicle.speed_limit`. Outputs if actions are discrete: `outputs`, float32 [n, 8],
equal to those of the kernels up to rounding, and `action`, int64 [n], the index of the largest output. If actions are
continuous, the only output is `action`, float32 [n, 2]: pedal and wheel, each within [-1, 1].
"""

from __future__ import annotations

from typing import Any

import numpy as np

from evolution.networks.policy import (
    KERNEL_1,
    KERNEL_2,
    STRIDE_1,
    STRIDE_2,
    CnnSpec,
    MlpSpec,
    PolicySpec,
)
from gridsim.config import SimConfig, constants
from gridsim.packages import check_extra
from gridsim.sensing.grid import CELLS, FREE
from gridsim.sensing.observation import FEATURES, SPEED_SCALE, encoding

OPSET, IR_VERSION = 17, 8
"""Versions of ONNX's operators and file format: of 2022, so that runtimes on small computers read the files."""


def layers_of(spec: PolicySpec, genome: Any) -> list[tuple[Any, Any]]:
    """Weights [inputs, units] and biases [units] of each layer, as views of a genome [genes], a tensor or an array."""
    layers, at = [], 0
    for n, m in spec.shapes():
        layers.append((genome[at : at + n * m].reshape(n, m), genome[at + n * m : at + (n + 1) * m]))
        at += (n + 1) * m
    return layers


def to_onnx(spec: PolicySpec, genome: np.ndarray, config: SimConfig) -> bytes:
    """A genome float32 [genes] as an ONNX file.

    The same arguments always give the same bytes. `config` gives the scales of the environment's observations.
    Raises: GridSimError without onnx, ValueError if the genome does not fit the policy.
    """
    check_extra("evolve")
    from onnx import TensorProto, helper, numpy_helper  # takes 0.2 s

    if genome.shape != (spec.size,) or genome.dtype != np.float32:
        raise ValueError(f"a genome of {spec} is float32 [{spec.size}], not {genome.dtype} {genome.shape}")
    graph = _Graph()
    if isinstance(spec, CnnSpec):
        last = _add_cnn(graph, spec, genome, config)
    else:
        assert isinstance(spec, MlpSpec)
        last = _add_mlp(graph, spec, genome, config)
    if spec.actions == "continuous":
        graph.nodes.append(("Identity", (graph.squashed(last),), ("action",), {}))
        outputs = [helper.make_tensor_value_info("action", TensorProto.FLOAT, ["n", spec.outputs])]
        meaning = "pedal (below 0: brake) and wheel (left positive), each within [-1, 1]"
    else:
        graph.nodes.append(("Identity", (last,), ("outputs",), {}))
        graph.nodes.append(("ArgMax", (last,), ("action",), {"axis": 1, "keepdims": 0}))
        outputs = [
            helper.make_tensor_value_info("outputs", TensorProto.FLOAT, ["n", spec.outputs]),
            helper.make_tensor_value_info("action", TensorProto.INT64, ["n"]),
        ]
        meaning = "the index of the largest output"
    model = helper.make_model(
        helper.make_graph(
            [helper.make_node(kind, inputs, outputs, **more) for kind, inputs, outputs, more in graph.nodes],
            str(spec),
            [
                helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(x.dtype), ["n", *x.shape[1:]])
                for name, x in example(spec, config).items()
            ],
            outputs,
            [numpy_helper.from_array(array, name) for name, array in graph.constants.items()],
        ),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="gridsim",
        doc_string=f"Takes GridSim's observations. The action is {meaning}.",
    )
    return model.SerializeToString(deterministic=True)


class _Graph:
    """Nodes (operator, inputs, outputs, attributes) and constants of an ONNX graph."""

    def __init__(self) -> None:
        self.nodes: list[tuple[str, tuple[str, ...], tuple[str, ...], dict[str, Any]]] = []
        self.constants: dict[str, np.ndarray] = {}

    def constant(self, value: Any, dtype: type = np.float32) -> str:
        """Add a constant. Returns: its name."""
        name = f"c{len(self.constants)}"
        self.constants[name] = np.array(value, dtype=dtype, order="C")
        return name

    def add(self, kind: str, *inputs: str, **attributes: Any) -> str:
        """Add a node. Returns: the name of its output, as the methods below do."""
        name = f"{kind.lower()}{len(self.nodes)}"
        self.nodes.append((kind, inputs, (name,), attributes))
        return name

    def horner(self, x: str, first: Any, *more: Any) -> str:
        """Add a polynomial of x, whose coefficients begin with that of the highest power."""
        value = self.constant(first)
        for coefficient in more:
            value = self.add("Add", self.add("Mul", x, value), self.constant(coefficient))
        return value

    def dense(self, x: str, weights: np.ndarray, biases: np.ndarray) -> str:
        """Add a dense layer, without its activation."""
        return self.add("Gemm", x, self.constant(weights), self.constant(biases))

    def squashed(self, x: str) -> str:
        """Add the policies' hyperbolic tangent (`policy.squash`)."""
        x = self.add("Clip", x, self.constant(-4.97), self.constant(4.97))
        s = self.add("Mul", x, x)
        over = self.horner(s, 1.0, 378.0, 17325.0, 135135.0)
        under = self.horner(s, 28.0, 3150.0, 62370.0, 135135.0)
        return self.add("Div", self.add("Mul", x, over), under)


def _add_mlp(graph: _Graph, spec: MlpSpec, genome: np.ndarray, config: SimConfig) -> str:
    """Add a perceptron to a graph. Returns: the name of its outputs."""
    encoded = encoding(spec.features, constants(config))
    near, full, scale, shift = (encoded.each(numbers) for numbers in (encoded.near, encoded.full, *encoded[4:]))
    value = graph.add("Mul", "observation", graph.constant(full))
    resolved = graph.add("Div", value, graph.add("Add", value, graph.constant(scale)))
    rest = graph.horner("observation", scale, shift)
    x = graph.add("Where", graph.constant(near, bool), graph.horner(resolved, 2.0, -1.0), rest)
    *hidden, last = layers_of(spec, genome)
    for layer in hidden:
        x = graph.squashed(graph.dense(x, *layer))
    return graph.dense(x, *last)


def _add_cnn(graph: _Graph, spec: CnnSpec, genome: np.ndarray, config: SimConfig) -> str:
    """Add a convolutional network to a graph. Returns: the name of its outputs."""
    one, two, _ = spec.hidden
    (w1, b1), (w2, b2), dense, last = layers_of(spec, genome)
    x = graph.add("Mul", graph.add("Cast", "grid", to=1), graph.constant(1.0 / 255.0))  # to=1: float32
    # A genome orders a unit's inputs (frame, row, column) in the first layer, (row, column, channel) in the second.
    w1 = w1.reshape(spec.frames, KERNEL_1, KERNEL_1, one).transpose(3, 0, 1, 2)
    w2 = w2.reshape(KERNEL_2, KERNEL_2, one, two).transpose(3, 2, 0, 1)
    for weights, biases, stride in ((w1, b1, STRIDE_1), (w2, b2, STRIDE_2)):
        x = graph.add("Conv", x, graph.constant(weights), graph.constant(biases), strides=[stride, stride])
        x = graph.add("Relu", x)
    x = graph.add("Flatten", graph.add("Transpose", x, perm=[0, 2, 3, 1]), axis=1)
    x = graph.add("Concat", x, graph.horner("speed", config.vehicle.speed_limit / float(SPEED_SCALE), -1.0), axis=1)
    return graph.dense(graph.add("Relu", graph.dense(x, *dense)), *last)


def example(spec: PolicySpec, config: SimConfig) -> dict[str, np.ndarray]:
    """Two example observations, by the names of the graph's inputs: nothing in sight, at standstill and at 10 m/s."""
    shares = np.array([0.0, 10.0 / config.vehicle.speed_limit], dtype=np.float32)
    if isinstance(spec, CnnSpec):
        return {"grid": np.full((2, spec.frames, CELLS, CELLS), FREE, dtype=np.uint8), "speed": shares[:, None]}
    assert isinstance(spec, MlpSpec)
    observations = np.zeros((2, spec.inputs), dtype=np.float32)  # wheels straight ahead
    encoded = encoding(spec.features)
    observations += encoded.each(feature.near for feature in FEATURES)  # nothing in sight
    observations += shares[:, None] * encoded.each(feature.name == "speed" for feature in FEATURES)
    return {"observation": observations}
