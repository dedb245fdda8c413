"""What shared synapse lists save: ``convolutions.py FOLDER NAME=NETWORK … OUT.json``, networks with convolutions.

FOLDER holds clones of public repositories as ``public_networks.py`` wants them; each NETWORK is a checkpoint of ours. A
convolutional network is added that torch exports as ONNX. All are compiled as they stand, once with the lists of each
core shared and once unrolled, and priced on recordings that are made; floats also with scales that these recordings
choose at 8 bits, without ``--share-lists`` and with it.
"""

import json
import sys
import tempfile
import warnings
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import public_networks
import torch
from made import made
from torch import Tensor, nn

import spikeloom
from spikeloom.compiler.targets.loihi1 import legalize
from spikeloom.compiler.targets.loihi1.layout import core_needs

PUBLIC = {"N-MNIST convolutions": "NIR", "tiny": "netx"}
"""Networks of ``public_networks.py``, and their format."""


class Steps(nn.Module):
    """Three layers over 16 × 16 taxels, for all steps of a recording, whose last axis is time."""

    def __init__(self) -> None:
        super().__init__()
        layers = nn.Conv2d(2, 8, 3, padding=1), nn.Conv2d(8, 16, 3, stride=2, padding=1), nn.Linear(1024, 10)
        lif = [spikeloom.LIF() for _ in layers]
        self.net = nn.Sequential(layers[0], lif[0], layers[1], lif[1], nn.Flatten(1), layers[2], lif[2])

    def forward(self, x: Tensor) -> Tensor:
        """Mean spikes of the classes."""
        return torch.stack([self.net(x[..., step]) for step in range(x.shape[-1])]).mean(0)


def unrolled(form: Any, *_: object) -> Any:
    """Every axon its own list."""
    return np.arange(len(form))


def figures(file: str, data: Path, options: dict[str, Any]) -> dict[str, Any]:
    """Memory, cores and price of a network."""
    net = spikeloom.compile(file, **options)
    facts = net.facts.netlist
    polarities = options.get("polarities", 2)
    if not data.exists():
        public_networks.recordings(data, facts.taxels, polarities, facts.classes, public_networks.RATES[0])
    price = net.estimate(str(data)).details
    agrees = {} if "calibrate" not in options else {"equal": net.verify(str(data)).decision_agreement}
    return agrees | {
        "synapse_words": facts.synapse_words,
        "synapse_words_unrolled": facts.synapse_words_unrolled,
        "cores": facts.cores,
        "compartments": facts.compartments,
        "per_inference": {
            key: getattr(price.per_inference, key)
            for key in ("synaptic_operations", "spikes", "packets", "energy_j")
        },
    }


def main(folder: str, *words: str) -> None:
    """Compile, price and write."""
    rows = []
    with tempfile.TemporaryDirectory() as place:
        onnx = str(Path(place, "conv.onnx"))
        torch.manual_seed(0)
        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            torch.onnx.export(Steps(), (torch.zeros(1, 2, 16, 16, 3),), onnx, dynamo=False)
        networks: list[tuple[str, str, str, dict[str, Any]]] = [
            (name, "checkpoint", file, {}) for name, file in (word.split("=") for word in words[:-1])
        ]
        for each in public_networks.NETWORKS:
            if each.name in PUBLIC:
                options = (
                    {"dt": 1.0}
                    if PUBLIC[each.name] == "NIR"
                    else {"polarities": 3, "polarities_first": True}
                )
                networks.append(
                    (each.name, PUBLIC[each.name], str(Path(folder, each.repository, each.path)), options)
                )
        networks.append(("two convolutions", "ONNX", onnx, {}))
        for name, kind, file, options in networks:
            row = {"name": name, "format": kind, "shared": figures(file, Path(place, name), options)}
            with (
                mock.patch.object(core_needs, "stored_once", unrolled),
                mock.patch.object(legalize, "stored_once", unrolled),
            ):
                row["unrolled"] = figures(file, Path(place, name), options)
            if kind != "netx":
                chosen = options | {"calibrate": str(Path(place, name)), "weight_bits": "8"}
                row["calibrated"] = figures(file, Path(place, name), chosen)
                row["share_lists"] = figures(file, Path(place, name), chosen | {"share_lists": True})
            rows.append(row)
            print(json.dumps(row))
    Path(words[-1]).write_text(json.dumps(made() | {"networks": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
