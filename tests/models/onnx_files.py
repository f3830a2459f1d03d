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
    output's shape, "external" puts the weights into a file beside it, "some" gives as many features
    as the clouds say.
    """
    value = weights(dim, seed) * np.float32(changes.get("scale", 1.0))
    axes = changes.get("axes", [1])
    nodes = [
        helper.make_node("MatMul", ["points", "w"], ["z"]),
        helper.make_node("Relu", ["z"], ["r"]),
        helper.make_node("ReduceMax", ["r"], ["m"], axes=axes, keepdims=0),
    ]
    if changes.get("some"):
        nodes += [
            helper.make_node("ReduceMax", ["z"], ["most"], axes=[0, 1], keepdims=0),
            helper.make_node("Cast", ["most"], ["which"], to=TensorProto.BOOL),
            helper.make_node("Compress", ["m", "which"], ["f"], axis=1),
        ]
    else:
        nodes.append(helper.make_node("Identity", ["m"], ["f"]))
    shape = ["b", "n", 3]
    inputs = [helper.make_tensor_value_info("points", TensorProto.FLOAT, shape)]
    for name in changes.get("inputs", ()):  # type: ignore[attr-defined]
        inputs.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, [1]))
    out = helper.make_tensor_value_info("f", TensorProto.FLOAT, changes.get("out", ["b", dim]))
    graph = helper.make_graph(nodes, "g", inputs, [out], [numpy_helper.from_array(value, "w")])
    opset = [helper.make_opsetid("", 17)]
    model = helper.make_model(graph, opset_imports=opset, ir_version=8)
    save_model(
        model,
        str(path),
        save_as_external_data=bool(changes.get("external")),
        location="weights.bin",
        size_threshold=0,
    )
    return path
