"""A tiny network that finds red squares: the share of red over green and blue in each cell of a grid is its score."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

INPUT_PX, CELL_PX = 160, 16


def red_detector(path: Path, output: str) -> Path:
    """Write the network with the output of a convention; its boxes are the cells."""
    cells = INPUT_PX // CELL_PX
    row, column = np.divmod(np.arange(cells * cells), cells)
    middle = np.column_stack([column, row]) * CELL_PX + (CELL_PX - 1) / 2.0
    sides = np.full_like(middle, CELL_PX)
    boxes = np.hstack([middle, sides]) if output != "boxes" else np.hstack([middle - sides / 2, middle + sides / 2])
    weight = np.zeros((1, 3, CELL_PX, CELL_PX), np.float32)
    weight[0, 0], weight[0, 1], weight[0, 2] = 1.0, -0.5, -0.5
    count = cells * cells
    known = {
        "weight": weight / CELL_PX**2, "flat": np.array([1, 1, count], np.int64),
        "boxes_t": boxes.T[None].astype(np.float32), "sure": np.ones((1, 1, count), np.float32),
        "boxes_n": boxes.astype(np.float32), "line": np.array([count], np.int64),
    }  # fmt: skip
    nodes = [
        helper.make_node("Conv", ["picture", "weight"], ["cells"], strides=[CELL_PX, CELL_PX]),
        helper.make_node("Relu", ["cells"], ["red"]), helper.make_node("Reshape", ["red", "flat"], ["score"]),
    ]  # fmt: skip
    if output == "yolov8":
        nodes.append(helper.make_node("Concat", ["boxes_t", "score"], ["out"], axis=1))
    elif output == "yolov5":
        nodes.append(helper.make_node("Concat", ["boxes_t", "sure", "score"], ["upright"], axis=1))
        nodes.append(helper.make_node("Transpose", ["upright"], ["out"], perm=[0, 2, 1]))
    else:
        nodes.append(helper.make_node("Identity", ["boxes_n"], ["out"]))
        nodes.append(helper.make_node("Reshape", ["red", "line"], ["scores"]))
    outputs = [helper.make_tensor_value_info("out", TensorProto.FLOAT, None)]
    if output == "boxes":
        outputs.append(helper.make_tensor_value_info("scores", TensorProto.FLOAT, None))
    graph = helper.make_graph(
        nodes, "red", [helper.make_tensor_value_info("picture", TensorProto.FLOAT, [1, 3, INPUT_PX, INPUT_PX])],
        outputs, [numpy_helper.from_array(v, n) for n, v in known.items()],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 9
    onnx.save(model, path)
    return path
