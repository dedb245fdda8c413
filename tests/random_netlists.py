"""Netlists built by hand or drawn by hypothesis, for the tests of the two simulators."""

from dataclasses import dataclass, fields, replace

import numpy as np
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from spikeloom.compiler.arrays import read_only, read_only_float
from spikeloom.compiler.targets.loihi1.netlist import Layer, Netlist
from spikeloom.runtime.machines.loihi1 import engine, spec
from spikeloom.runtime.machines.loihi1.trace import Counts, Trace

KEPT = {"spikes": True, "membranes": True, "updated": True}
"""Options of a run that keeps all it can."""

MEMORYLESS = 4095
"""decay_u of a current that forgets everything in one step."""


@dataclass(frozen=True, kw_only=True)
class Neuron:
    """A compartment; `core` and `layer` are indices."""

    layer: int = 0
    core: int = 0
    decay_u: int = MEMORYLESS
    decay_v: int = 3277
    threshold: int = 100
    bias: int = 0
    bias_exponent: int = 0


@dataclass(frozen=True, kw_only=True)
class Axon:
    """An axon on `core`; `targets` are pairs of compartment within the core and mantissa."""

    source: int
    targets: tuple[tuple[int, int], ...]
    core: int = 0
    exponent: int = 0


def build(neurons: list[Neuron], axons: list[Axon], *, n_inputs: int, depths: list[int]) -> Netlist:
    """A netlist of these parts, sorted by core; neurons of a layer are numbered in the order given."""
    cores = 1 + max(neuron.core for neuron in neurons)
    order = sorted(range(len(neurons)), key=lambda i: neurons[i].core)
    number = [sum(other.layer == neuron.layer for other in neurons[:i]) for i, neuron in enumerate(neurons)]
    neurons, number = [neurons[i] for i in order], [number[i] for i in order]
    axons = sorted(axons, key=lambda axon: axon.core)
    exponents = sorted({axon.exponent for axon in axons} | {0})
    synapses = [synapse for axon in axons for synapse in axon.targets]

    def bounds(core_of):
        return np.searchsorted(core_of, np.arange(cores + 1))

    def column(name):
        return read_only([getattr(neuron, name) for neuron in neurons])

    return Netlist(
        target="loihi1",
        taxels=n_inputs,
        polarities=1,
        classes=1,
        layers=tuple(
            Layer(
                name=f"layer{i}",
                neurons=sum(neuron.layer == i for neuron in neurons),
                unread=(),
                depth=depth,
                beta=0.2,
                theta=0.5,
                weight_bits=8,
                synapses=0,
                max_fan_in=0,
            )
            for i, depth in enumerate(depths)
        ),
        core_tile=read_only(range(cores)),
        core_compartments=read_only(bounds([neuron.core for neuron in neurons])),
        core_axons=read_only(bounds([axon.core for axon in axons])),
        layer=column("layer"),
        neuron=read_only(number),
        decay_u=column("decay_u"),
        decay_v=column("decay_v"),
        threshold=column("threshold"),
        bias_mantissa=column("bias"),
        bias_exponent=column("bias_exponent"),
        scale=read_only_float([1.0] * len(neurons)),
        readout_class=read_only([-1] * len(neurons)),
        axon_source=read_only([axon.source for axon in axons]),
        axon_format=read_only([exponents.index(axon.exponent) for axon in axons]),
        axon_synapses=read_only(np.cumsum([0] + [len(axon.targets) for axon in axons])),
        synapse_target=read_only([target for target, _ in synapses]),
        synapse_weight=read_only([weight for _, weight in synapses]),
        format_weight_bits=read_only([8] * len(exponents)),
        format_exponent=read_only(exponents),
        format_index_bits=read_only([10] * len(exponents)),
        provenance={},
    )


def _extreme(low: int, high: int, *likely: int) -> st.SearchStrategy[int]:
    """Integers of a range, mostly its ends and the likely ones."""
    return st.one_of(st.sampled_from([low, *likely, high]), st.integers(low, high))


@st.composite
def netlists(draw: st.DrawFn, *, weight_exponents: tuple[int, ...] = (-1, 0, 0, 0, 1, 3, 7)) -> Netlist:
    """Networks of any wiring: recurrent, skipping, several layers on a core, several axons of one source."""
    n_inputs = draw(st.integers(1, 4))
    depths = draw(st.lists(st.integers(0, 4), min_size=1, max_size=4))
    neuron = st.builds(
        Neuron,
        layer=st.integers(0, len(depths) - 1),
        core=st.integers(0, 2),
        decay_u=_extreme(0, 4095, 4095, 2048),
        decay_v=_extreme(0, 4095, 3277),
        threshold=_extreme(0, 2**17 - 1, 0, 1, 2, 127, 254),
        bias=_extreme(-4095, 4095, 0, 0, 64, -1),
        bias_exponent=st.sampled_from([0, 0, 6, 7]),
    )
    neurons = draw(st.lists(neuron, min_size=1, max_size=10))
    on_core = [sum(neuron.core == core for neuron in neurons) for core in range(3)]
    weight = _extreme(-128, 127, 0, 1, -1, 2, 64).map(lambda half: 2 * half)
    axons = []
    for core, size in enumerate(on_core[: 1 + max(neuron.core for neuron in neurons)]):
        axon = st.builds(
            Axon,
            core=st.just(core),
            source=st.integers(0, n_inputs + len(neurons) - 1),
            exponent=st.sampled_from(weight_exponents),
            targets=st.lists(st.tuples(st.integers(0, size - 1), weight), max_size=8).map(tuple)
            if size
            else st.just(()),
        )
        axons += draw(st.lists(axon, max_size=10))
    return build(neurons, axons, n_inputs=n_inputs, depths=depths)


@st.composite
def recordings(draw: st.DrawFn, netlist: Netlist, *, max_length: int = 10) -> np.ndarray:
    """Events of one recording; shape (n_inputs, T)."""
    length = draw(st.integers(0, max_length))
    bits = draw(st.integers(0, 2 ** (netlist.n_inputs * length) - 1))
    flat = [bits >> i & 1 for i in range(netlist.n_inputs * length)]
    return np.array(flat, np.uint8).reshape(netlist.n_inputs, length)


def large_netlist(seed: int, *, proved: bool) -> Netlist:
    """Some hundred compartments on five cores, wired at random, lively; `proved` keeps the sums in range."""
    rng = np.random.default_rng(seed)
    n, n_inputs, depths = 300, 20, [0, 1, 1, 3]
    decays = [(4095, 3277), (2048, 100), (4095, 0), (1000, 4095)]
    neurons = []
    for i in range(n):
        layer = int(rng.integers(len(depths)))
        decay_u, decay_v = decays[layer]
        neurons.append(
            Neuron(
                layer=layer,
                core=i * 5 // n,
                decay_u=decay_u,
                decay_v=decay_v,
                threshold=int(rng.choice([2, 60, 254, 2**17 - 1])),
                bias=int(rng.choice([0, 0, -300, 300, 4095])),
                bias_exponent=int(rng.choice([0, 0, 7])),
            )
        )
    axons = []
    for core in range(5):
        for _ in range(120):
            targets = rng.permutation(n // 5)[: rng.integers(1, n // 5)]
            weights = 2 * rng.integers(-40, 50, len(targets))
            axons.append(
                Axon(
                    core=core,
                    source=int(rng.integers(n_inputs + n)),
                    exponent=int(rng.choice([-1, 0, 1] if proved else [-1, 1, 5])),
                    targets=tuple(zip(targets.tolist(), weights.tolist(), strict=True)),
                )
            )
    return build(neurons, axons, n_inputs=n_inputs, depths=depths)


def voting(netlist: Netlist, classes: int = 3) -> Netlist:
    """Let compartments vote for the classes in turn, and every so often for none."""
    votes = np.arange(netlist.n_compartments) % (classes + 1) - 1
    return replace(netlist, classes=classes, readout_class=read_only(votes))


def lively() -> Netlist:
    """Some hundred compartments, 10 taxels with two polarities, three classes, a lag of three steps."""
    return replace(voting(large_netlist(10, proved=True)), taxels=10, polarities=2)


def recording_of(batch: Trace, index: int) -> Trace:
    """One recording of a batch that kept all it can, as the plain simulator would hand it back."""
    counts = Counts(**{field.name: getattr(batch.counts, field.name)[index] for field in fields(Counts)})
    return Trace(counts=counts, **{name: getattr(batch, name)[index] for name in KEPT})


def ungated(netlist: Netlist) -> Netlist:
    """The netlist without windows: all layers integrate in each data step, biases included."""
    return replace(netlist, layers=tuple(replace(layer, depth=0) for layer in netlist.layers))


def by_engine(netlist: Netlist, events: np.ndarray, **options: bool) -> Trace:
    """Run one recording through the fast simulator."""
    prepared = engine.prepare(netlist, **options)
    return recording_of(engine.simulate(prepared, events[None], threads=1, **KEPT), 0)


def by_steps(netlist: Netlist, events: np.ndarray) -> Trace:
    """Run one recording through the fast simulator, step by step."""
    return by_engine(netlist, events, stepwise=True)


SIMULATORS = [spec.simulate, by_engine, by_steps]
"""Three ways to run one recording, all the same."""


def assert_equal(left: Trace, right: Trace) -> None:
    """Every spike, membrane and count of two traces is the same, of whatever chip."""
    for name in (name for name in KEPT if hasattr(right, name)):
        assert_array_equal(getattr(left, name), getattr(right, name), err_msg=name, strict=True)
    for field in fields(left.counts):
        pair = (getattr(trace.counts, field.name) for trace in (left, right))
        assert_array_equal(*pair, err_msg=field.name, strict=True)


def six_steps():
    """Two inputs, h0 and h1 one tile north of them, o one tile east of these; what SANA-FE 2.2.9 was run on."""
    neurons = [Neuron(threshold=80), Neuron(threshold=80), Neuron(threshold=80, core=1, layer=1)]
    axons = [
        Axon(source=0, targets=((0, 60), (1, -30))),
        Axon(source=1, targets=((0, 50), (1, 90))),
        Axon(source=2, core=1, targets=((0, 100),)),
        Axon(source=3, core=1, targets=((0, 70),)),
    ]
    netlist = build(neurons, axons, n_inputs=2, depths=[0, 1])
    netlist = replace(netlist, core_tile=read_only([8, 9]), format_index_bits=read_only([0]))
    # an event acts in the step after the one in which its channel fires there
    events = np.array([[0, 1, 1, 0, 1, 0], [0, 1, 0, 0, 1, 1]], np.uint8)
    return netlist, events, by_engine(ungated(netlist), events)
