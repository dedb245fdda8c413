"""onnxruntime as a worker: ``rival_onnx.py TASK.npz all|few``; one step of the network is a graph of integer operators.

State goes in and comes out again, and the graph is called once a step. Spikes are uint8, weights int8; the decay is
an integer product and an integer division, which truncates as the chip does.
"""

from __future__ import annotations

import numpy as np
import onnxruntime
from onnx import TensorProto, helper, numpy_helper
from worker import Job, Task, serve


def step_graph(task: Task) -> bytes:
    """The model of one step, serialised: inputs ``s``, ``v0``, ``v1`` …; outputs ``s0``, ``w0`` and so on."""
    constants = {
        "kept": np.array(819, np.int32),
        "whole": np.array(4096, np.int32),
        "rest": np.array(0, np.int32),
    }
    inputs = [helper.make_tensor_value_info("s", TensorProto.UINT8, ["batch", task.events.shape[2]])]
    outputs, nodes, source = [], [], "s"
    for i, layer in enumerate(task.layers):
        weight, unit = layer.mantissas()
        constants[f"weight{i}"] = np.ascontiguousarray(weight.T)
        constants[f"unit{i}"] = np.array(64 * unit, np.int32)
        constants[f"bias{i}"] = layer.bias.astype(np.int32)
        constants[f"threshold{i}"] = layer.threshold.astype(np.int32)
        nodes += [
            helper.make_node("MatMulInteger", [source, f"weight{i}"], [f"sum{i}"]),
            helper.make_node("Mul", [f"sum{i}", f"unit{i}"], [f"inflow{i}"]),
            helper.make_node("Add", [f"inflow{i}", f"bias{i}"], [f"current{i}"]),
            helper.make_node("Mul", [f"v{i}", "kept"], [f"product{i}"]),
            helper.make_node("Div", [f"product{i}", "whole"], [f"decayed{i}"]),
            helper.make_node("Add", [f"decayed{i}", f"current{i}"], [f"membrane{i}"]),
            helper.make_node("Greater", [f"membrane{i}", f"threshold{i}"], [f"fired{i}"]),
            helper.make_node("Where", [f"fired{i}", "rest", f"membrane{i}"], [f"w{i}"]),
            helper.make_node("Cast", [f"fired{i}"], [f"s{i}"], to=TensorProto.UINT8),
        ]
        shape = ["batch", layer.size]
        inputs.append(helper.make_tensor_value_info(f"v{i}", TensorProto.INT32, shape))
        outputs.append(helper.make_tensor_value_info(f"s{i}", TensorProto.UINT8, shape))
        outputs.append(helper.make_tensor_value_info(f"w{i}", TensorProto.INT32, shape))
        source = f"s{i}"
    initial = [numpy_helper.from_array(array, name) for name, array in constants.items()]
    graph = helper.make_graph(nodes, "step", inputs, outputs, initial)
    return helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8
    ).SerializeToString()


def prepare_job(task: Task, options: list[str]) -> Job:
    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = settings.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(step_graph(task), settings, providers=["CPUExecutionProvider"])
    sizes = [layer.size for layer in task.layers]
    names = [f"{kind}{i}" for i in range(len(sizes)) for kind in "sw"]
    units = [task.events] if options == ["all"] else [task.events[i : i + 1] for i in task.few]

    def run(unit: int) -> list[np.ndarray]:
        events = units[unit]
        batch, steps, _ = events.shape
        state = [np.zeros((batch, size), np.int32) for size in sizes]
        kept = [np.empty((batch, steps, size), np.uint8) for size in sizes]
        for step in range(steps):
            feed = {"s": events[:, step]} | {f"v{i}": v for i, v in enumerate(state)}
            results = session.run(names, feed)
            state = results[1::2]
            for layer, fired in zip(kept, results[::2], strict=True):
                layer[:, step] = fired
        return kept

    def differing(results: list[list[np.ndarray]]) -> list[int]:
        which = task.few if options == ["all"] else slice(None)
        layers = [np.concatenate(parts)[which].view(np.bool_) for parts in zip(*results, strict=True)]
        return task.differing("aligned", layers)

    return Job(
        name=f"onnxruntime {onnxruntime.__version__}",
        units=len(units),
        recordings=sum(len(unit) for unit in units),
        run=run,
        differing=differing,
    )


if __name__ == "__main__":
    serve(prepare_job)
