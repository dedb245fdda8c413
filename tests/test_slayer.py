"""A recurrent network that ran on a Loihi, in SLAYER's file, beside a second reading of SLAYER's equations."""

import h5py
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from spikeloom.compiler.formats.netx.reader import read_netx
from spikeloom.compiler.targets.loihi1.integers import run_integer
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.runtime.machines.loihi1 import engine, onnx_engine, spec
from spikeloom.runtime.machines.loihi1.trace import aligned

RATES = 0.005, 0.02, 0.05, 0.1, 0.2, 0.4
STEPS = 270


def recordings(channels):
    """Four made recordings a rate, (recordings, steps, channels) bool: two even ones, two in bursts of ten steps."""
    rng = np.random.default_rng(20)
    shape = (2, STEPS // 10, channels)
    made = [np.stack([np.full(shape, rate), rng.gamma(0.3, rate / 0.3, shape)]) for rate in RATES]
    chance = np.repeat(np.concatenate(made).reshape(-1, *shape[1:]), 10, axis=1)
    return rng.random(chance.shape) < chance


def neurons(registers, arrive, steps, size):
    """Spikes (steps, size) of a layer by the equations of SLAYER's kernel for Loihi.

    `arrive(step, fired)` are the weights that arrive in a step, `fired` the layer's spikes of the steps before it. Row
    0 is the kernel's first step, in which it does nothing, whatever arrives.
    """
    kept_u, kept_v = 4096 - registers["iDecay"], 4096 - registers["vDecay"]
    theta, refractory = registers["vThMant"] << 6, registers["refDelay"]
    u, v, waiting = (np.zeros(size, np.int64) for _ in range(3))
    fired = np.zeros((steps, size), np.int64)
    for step in range(1, steps):
        u = np.where(u >= 0, (u * kept_u) >> 12, -((-u * kept_u) >> 12)) + 64 * arrive(step, fired)
        v = np.where(v >= 0, (v * kept_v) >> 12, -((-v * kept_v) >> 12)) + u
        if step >= refractory:
            waiting -= fired[step - refractory]
        fired[step] = (v > theta) & (waiting == 0)
        v = v * (1 - fired[step]) * (waiting == 0)
        waiting += fired[step]
    return fired


def slayer(path, given_):
    """Spikes of both layers, (steps, neurons), of a recording (steps, channels), aligned with its steps.

    The file is read here, as floats. SLAYER's first step does nothing, so a silent one is put before the recording.
    """
    with h5py.File(path) as file:
        hidden, out = file["layer/2"], file["layer/3"]
        weights = [hidden["weight"][()], hidden["recWeight"][()], out["weight"][()]]
        registers = [
            {key: int(block[f"neuron/{key}"][()]) for key in ("iDecay", "vDecay", "vThMant", "refDelay")}
            for block in (hidden, out)
        ]
    assert all(
        np.all(weight % 2 == 0) and weight.min() >= -256 and weight.max() <= 254 for weight in weights
    )
    first, own, last = (weight.astype(np.int64) for weight in weights)
    events = np.vstack([np.zeros((1, given_.shape[1]), np.int64), given_])
    spikes = neurons(
        registers[0], lambda t, fired: first @ events[t] + own @ fired[t - 1], len(events), len(own)
    )
    votes = neurons(registers[1], lambda t, _: last @ spikes[t], len(events), len(last))
    return spikes[1:], votes[1:]


@pytest.fixture(scope="module")
def expected(braille_net):
    """Recordings, and what the second reading makes of each."""
    given_ = recordings(48)
    return given_, [slayer(braille_net, each) for each in given_]


def test_the_integers_of_the_file(braille_net, expected):
    given_, layers = expected
    ours = run_integer(read_netx(braille_net).network, given_).spikes
    for index, found in enumerate(ours):
        assert_array_equal(found, np.stack([each[index] for each in layers]))
    hidden, out = ([each[index].sum() for each in layers] for index in range(2))
    assert min(hidden[4:]) > 100
    assert max(hidden) > 1000
    assert sum(out) > 1000


def test_the_chip_and_the_integer_graph(braille_net, expected):
    given_, layers = expected
    netlist = compile_network(read_netx(braille_net).network).netlist
    events = given_.transpose(0, 2, 1).astype(np.uint8)
    both = [
        engine.simulate(netlist, events, spikes=True).spikes,
        onnx_engine.simulate(onnx_engine.prepare(netlist), events)[0],
    ]
    for found in both:
        for index in range(2):
            assert_array_equal(
                aligned(netlist, found, index)[:, :STEPS], np.stack([each[index] for each in layers])
            )
    for which in (1, 9, 21):
        assert_array_equal(spec.simulate(netlist, events[which]).spikes, both[0][which])
