"""What shipped networks become, held against integers, votes and costs that were recorded: nothing may move unseen."""

import hashlib
import json
from dataclasses import fields
from functools import cache

import numpy as np
import pytest

import spikeloom
from spikeloom.runtime.machines.base import machine_for
from spikeloom.runtime.report.encode import encode

NETWORKS = {
    "grasps": {},
    "objects": {"planes": "2", "scale_groups": "4"},
    "containers": {"weight_bits": "8,4,4,8", "chips": 2},
    "objects-200ms": {"weight_bits": "3"},
    "containers-100ms": {"chips": 4},
    "objects-truenorth": {"target": "truenorth"},
    "containers-truenorth": {"target": "truenorth"},
}
"""Name of a shipped network, and how it is stored."""


@cache
def grasps():
    return spikeloom.recordings("synthetic").test


def digest(values):
    array = np.ascontiguousarray(values)
    whole = array.astype(np.int64 if array.dtype.kind in "iub" else np.float64)
    return hashlib.sha256(f"{array.shape}".encode() + whole.tobytes()).hexdigest()[:16]


@pytest.mark.parametrize("name", NETWORKS)
def test_integers_votes_and_costs_are_as_recorded(name, golden):
    net = spikeloom.compile(f"pretrained:{name}", **NETWORKS[name])
    netlist = machine_for(net.path).netlist
    arrays = {each.name: getattr(netlist, each.name) for each in fields(netlist)}
    found = {key: digest(value) for key, value in arrays.items() if isinstance(value, np.ndarray)}
    done, price = machine_for(net.path).price(grasps().events[:12], bin_s=0.02)
    found["votes"] = done.votes.tolist()
    found["costs"] = encode([price.synaptic_operations, price.energy_j, price.time_s])
    golden(f"{name}.json", json.dumps(found, indent=1) + "\n")
