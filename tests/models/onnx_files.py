"""Random nets with the interface that `model=features` asks for, as ONNX files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from onnx import TensorProto, helper, numpy_helper, save_model


def weights(dim: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(3, dim)).astype(np.float32)


def write_encoder(path: Path, dim: int = 6, seed: int = 0, **changes: object) -> Path:
    """max_i relu(x_i W): [B, N, 3] to [B, dim].

    `changes`: "scale" of the weights, "axes" of the maximum, "inputs" (further ones), "out" is the
    output's shape.
    """
    value = weights(dim, seed) * np.float32(changes.get("scale", 1.0))
    axes = changes.get("axes", [1])
    nodes = [
        helper.make_node("MatMul", ["points", "w"], ["z"]),
        helper.make_node("Relu", ["z"], ["r"]),
        helper.make_node("ReduceMax", ["r"], ["f"], axes=axes, keepdims=0),
    ]
    shape = ["b", "n", 3]
    inputs = [helper.make_tensor_value_info("points", TensorProto.FLOAT, shape)]
    for name in changes.get("inputs", ()):  # type: ignore[attr-defined]
        inputs.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, [1]))
    out = helper.make_tensor_value_info("f", TensorProto.FLOAT, changes.get("out", ["b", dim]))
    graph = helper.make_graph(nodes, "g", inputs, [out], [numpy_helper.from_array(value, "w")])
    opset = [helper.make_opsetid("", 17)]
    model = helper.make_model(graph, opset_imports=opset, ir_version=8)
    save_model(model, str(path))
    return path
