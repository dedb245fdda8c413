"""``.net`` files for tests, laid out as lava-dl's blocks export themselves."""

import h5py
import numpy as np


def neuron(*, u=4096, v=1024, threshold=25, kind="CUBA", **more):
    """Entries of a neuron."""
    return {
        "type": kind,
        "iDecay": u,
        "vDecay": v,
        "vThMant": threshold,
        "refDelay": 1,
        "gradedSpike": False,
    } | more


def dense(weight, *, bias=None, **more):
    """Entries of a dense block; weights are stored as float32, as slayer has them."""
    rows, columns = weight.shape
    found = {"type": ["dense"], "shape": [rows], "inFeatures": columns, "outFeatures": rows}
    found |= {"weight": weight.astype(np.float32), "neuron": neuron()}
    return found | ({} if bias is None else {"bias": np.asarray(bias, np.float32)}) | more


def conv(weight, shape, *, stride=(1, 1), padding=(0, 0), dilation=(1, 1), groups=1, bias=None, **more):
    """Entries of a conv block; `shape` is (channels, height, width) of what it gives."""
    found = {"type": ["conv"], "shape": list(shape), "inChannels": weight.shape[1] * groups}
    found |= {"outChannels": weight.shape[0], "kernelSize": list(weight.shape[2:4]), "stride": list(stride)}
    found |= {"padding": list(padding), "dilation": list(dilation), "groups": groups}
    found |= {"weight": weight.astype(np.float32), "neuron": neuron()}
    return found | ({} if bias is None else {"bias": np.asarray(bias, np.float32)}) | more


def given_input(*shape):
    """An input layer without neurons."""
    return {"type": ["input"], "shape": list(shape)}


def flatten(size):
    """Entries of a flatten block."""
    return {"type": ["flatten"], "shape": [1, 1, size]}


def write(path, *layers, **more):
    """Write layers to a file."""
    with h5py.File(path, "w") as file:
        for number, entries in enumerate(layers):
            _fill(file.create_group(f"layer/{number}"), entries)
        _fill(file, more)
    return path


def _fill(group, entries):
    for key, value in entries.items():
        if isinstance(value, dict):
            _fill(group.create_group(key), value)
        elif key == "type" and isinstance(value, list):
            group.create_dataset(key, (1,), "S10", [value[0].encode("ascii")])
        else:
            group.create_dataset(key, data=value)


def even(rng, *shape, most=60):
    """Random even weights."""
    return 2 * rng.integers(-most // 2, most // 2 + 1, shape)


def events(rng, size, steps=40):
    """A random recording, (steps, inputs) bool."""
    return rng.random((steps, size)) < 0.3
