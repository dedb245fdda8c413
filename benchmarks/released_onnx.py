"""Write the released network as ONNX files: ``released_onnx.py CODE CHECKPOINT OUT``, by torch_geometric's own layers.

CODE is a folder with the released ``tactileSGNet.py`` and ``to_graph.py``, which are run and not copied; OUT gets one
step with its state as inputs and outputs, and all steps of a short recording, by each exporter of torch that works.
"""

from __future__ import annotations

import importlib.util
import sys
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

STEPS = 4
SIZES = ((39, 64), (128,), (256,), (36,))


class OneStep(nn.Module):
    """The body of the released loop over time, for one step."""

    def __init__(self, code: Any, net: nn.Module) -> None:
        super().__init__()
        self.code, self.net = code, net
        self.edges = net.graph.getEdge()

    def forward(self, x: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        """Spikes of the classes and the new state."""
        code, net = self.code, self.net
        after = [code.mem_update_conv(net.conv1, x, self.edges, state[0], state[1])]
        x = after[0][1].view(-1)
        for k, stage in enumerate((net.fc1, net.fc2, net.fc3), 1):
            after.append(code.mem_update(stage, x, state[2 * k], state[2 * k + 1]))
            x = after[-1][1]
        return x, *(tensor for pair in after[:-1] for tensor in pair), after[-1][0]


def main(code: str, checkpoint: str, out: str) -> None:
    """Write the files."""
    sys.path.insert(0, code)
    import tactileSGNet as released  # noqa: N813

    net = released.TactileSGNet(36, 0, device="cpu")
    net.load_state_dict(torch.load(checkpoint, weights_only=True)["net_list"][0])
    net.eval()
    state = [torch.zeros(size) for size in SIZES for _ in range(2)]
    exporters = {"legacy": False, **({"dynamo": True} if importlib.util.find_spec("onnxscript") else {})}
    for name, dynamo in exporters.items():
        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            step = OneStep(released, net)
            torch.onnx.export(
                step, (torch.zeros(39, 2), *state), str(Path(out) / f"step_{name}.onnx"), dynamo=dynamo
            )
            events = torch.zeros(39, 2, STEPS)
            torch.onnx.export(net, (events,), str(Path(out) / f"steps_{name}.onnx"), dynamo=dynamo)


if __name__ == "__main__":
    main(*sys.argv[1:])
