"""A netlist as an integer ONNX graph: :data:`ABOUT`, which stands in the file, says what goes in and comes out."""

import hashlib
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import sparse

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.names import plain_names
from spikeloom.compiler.formats.onnx.builder import (
    Model,
    Nodes,
    Port,
    model_bytes,
    one_each,
    whole_recordings,
)
from spikeloom.compiler.ir import INPUT
from spikeloom.compiler.targets.loihi1.bounds import Reach, reach
from spikeloom.compiler.targets.loihi1.netlist import Netlist, netlist_bytes
from spikeloom.compiler.targets.loihi1.registers import (
    ACCUMULATOR_MAX,
    CURRENT_MAX,
    DECAY_ONE,
    MEMBRANE_MAX,
    MEMBRANE_SHIFT,
)
from spikeloom.compiler.types import IntArray

ABOUT = """A netlist as an integer ONNX graph: the chip's arithmetic, to be run by any program that reads the format.

Spikes are uint8 zeros and ones; membranes and currents are registers, int32 where no input can bring a product or a
sum beyond it and int64 otherwise. A layer is called by its name (``conv1``, ``fc1`` …), its neurons are those that the
chip holds, in the order of the layer; the metadata list them where some were left out.

Form ``step``: one chip step. Feed every output ``X_next`` back as input ``X``; at the start all are zero.

====================== ================== =============================================================================
``events``             (batch, channels)  input, uint8; channel ``taxel * polarities + polarity``, zeros after the end
``length``             ()                 input, int64: data steps of the recordings; run ``length + max_depth`` steps
``step``               ()                 int64, counts chip steps
``LAYER.spikes``       (batch, neurons)   uint8; received by others one step later
``LAYER.membrane``     (batch, neurons)   after the reset
``LAYER.current``      (batch, neurons)   only where a current outlasts its step
``votes``              (batch, classes)   int32, summed up; only where a layer votes
====================== ================== =============================================================================

Weights become matrices of int8 digits: ``weight = unit * sum_k digit_k * 256**k`` with digits from -128 to 127 and a
unit for each neuron. A product of spikes (0 and 1) with digits is ``MatMulInteger``, exact in its
int32 sums and faster than float32: most netlists need a single digit. Weights that several synapses of a pair store
(planes) are added up first.

Form ``scan``: whole recordings of the same length, a loop over the form ``step``. Everything is aligned with the data:
``LAYER.spikes[t]`` is what the layer did with data step ``t``, in chip step ``t + depth``.

====================== ======================= ========================================================================
``events``             (time, batch, channels) input, uint8
``LAYER.spikes``       (time, batch, neurons)  uint8
``LAYER.counts``       (batch, neurons)        int32, spikes of the recording
``votes``              (batch, classes)        int32
``class``              (batch,)                int64, most votes, the lowest on a tie
====================== ======================= ========================================================================
"""
"""What a file says of itself; no docstring, which Python may leave out."""

SIZE_LIMIT = 2**31 - 2**20
"""Bytes of weights that a file of this format can hold, a little below protobuf's 2 GiB."""

NARROW = 2**31 - 1
"""Largest number of an int32 layer."""

Digit = tuple[npt.NDArray[np.int8], IntArray]
"""Matrix (sources, neurons) of a digit, and what a one in it adds to each neuron, in weight units."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Layer:
    """One population as the graph computes it; arrays (n,) have an entry per compartment, ordered by neuron."""

    index: int  # into ``netlist.layers``
    name: str  # unique, without dots
    ids: IntArray  # compartments
    depth: int  # steps that it lags behind the data
    sources: dict[int, IntArray]  # weights (sources, neurons) by the index of a layer, or ``INPUT``
    remembers: bool  # a current outlasts its step
    saturates: bool  # some input could bring the membrane to the end of its register
    kind: type[np.int32] | type[np.int64]  # int32 where no input brings any product or sum beyond it

    @property
    def size(self) -> int:
        """Number of compartments."""
        return len(self.ids)


def digits(weight: IntArray) -> tuple[Digit, ...]:
    """Write a matrix of integers in int8 digits."""
    common = np.bitwise_or.reduce(np.abs(weight), axis=0)
    factor = np.where(
        common == 0, 1, common & -common
    )  # the largest power of two in all weights of a neuron
    found: list[Digit] = []
    rest = weight // factor
    while not found or rest.any():
        low = ((rest + 128) & 255) - 128
        found.append((low.astype(np.int8), factor))
        rest = (rest - low) >> 8
        factor = factor << 8
    return tuple(found)


def plan(netlist: Netlist) -> tuple[Layer, ...]:
    """Layers that have compartments, in the order of their depth.

    Raises ModelError if the netlist is free-running, their weights as dense matrices are more than a file
    holds, or some input may overflow a sum or a current, where the chip is not defined.
    """
    if netlist.blank:
        raise ModelError("onnx: a free-running netlist has no windows; compile it without --free-running")
    reached = reach(netlist)
    if np.any(over := (reached.sums > ACCUMULATOR_MAX) | (reached.current > CURRENT_MAX)):
        name = netlist.layers[netlist.layer[np.argmax(over)]].name
        raise ModelError(
            f"onnx: some input may overflow a register of {name}; train it with smaller weights"
        )
    names = plain_names([layer.name for layer in netlist.layers], taken=["input"])
    pre_of_axon = np.append(np.full(netlist.n_inputs, INPUT), netlist.layer)[netlist.axon_source]
    # zeros of dense lists are no synapses
    weight = netlist.effective_weight()
    real = weight != 0
    weight = weight[real]
    axon = netlist.axon_of_synapse()[real]
    target = netlist.synapse_compartment()[real]
    pre = pre_of_axon[axon]
    post = netlist.layer[target]
    pairs = np.unique(np.stack([post, pre], axis=1), axis=0)
    place = netlist.number_in_layer()
    counts = {INPUT: netlist.n_inputs} | dict(
        enumerate(np.bincount(netlist.layer, minlength=len(names)).tolist())
    )
    if (size := sum(counts[a] * counts[b] for b, a in pairs.tolist())) > SIZE_LIMIT:
        raise ModelError(
            f"onnx: dense, the weights need {size} bytes, a file holds {SIZE_LIMIT}; give a smaller one"
        )
    row = np.append(np.arange(netlist.n_inputs), place)[netlist.axon_source[axon]]

    def weights(a: int, b: int) -> IntArray:
        here = (pre == a) & (post == b)
        entries = weight[here], (row[here], place[target[here]])
        return np.asarray(sparse.coo_array(entries, shape=(counts[a], counts[b])).toarray())

    layers = [
        _layer(netlist, index, name, {a: weights(a, b) for b, a in pairs.tolist() if b == index}, reached)
        for index, name in enumerate(names)
        if counts[index]
    ]
    return tuple(sorted(layers, key=lambda layer: layer.depth))


def _layer(netlist: Netlist, index: int, name: str, sources: dict[int, IntArray], reached: Reach) -> Layer:
    ids = netlist.compartments_of(index)
    _, current, highest, stored = (bound[ids] for bound in reached)
    lost_u = netlist.decay_u[ids] + 1
    lost_v = netlist.decay_v[ids]
    bias = netlist.bias[ids]
    clipped = np.minimum(stored, MEMBRANE_MAX)
    widest = max(
        int((clipped * (DECAY_ONE - lost_v)).max()),
        int((current * (DECAY_ONE - lost_u)).max()),
        int((clipped + current + np.abs(bias)).max()) + _gathered(sources),
    )
    return Layer(
        index=index,
        name=name,
        ids=ids,
        depth=netlist.layers[index].depth,
        sources=sources,
        remembers=bool(np.any(lost_u != DECAY_ONE)),
        saturates=bool(np.any(np.maximum(highest, stored) > MEMBRANE_MAX)),
        kind=np.int32 if widest <= NARROW else np.int64,
    )


def _gathered(sources: dict[int, IntArray]) -> int:
    """Bound of any partial result while products with digits are added up, membrane units."""
    every = [digit for weight in sources.values() for digit in digits(weight)]
    sums = [(np.abs(digit.astype(np.int64)).sum(axis=0) * factor).max(initial=0) for digit, factor in every]
    return int(sum(sums)) << MEMBRANE_SHIFT


def export(netlist: Netlist, form: str) -> tuple[bytes, list[Port], list[Port]]:
    """Content of the ONNX file of a netlist in a form, see the module, its inputs and its outputs.

    Equal netlists give equal bytes; raises as :func:`plan`.
    """
    layers = plan(netlist)
    model = _chip_step(netlist, layers)
    if form == "scan":
        model = whole_recordings(
            model, {each.name: (each.size, each.depth) for each in layers}, netlist.classes
        )
    content = model_bytes(
        model,
        name=f"spikeloom-{form}",
        about=ABOUT,
        facts={
            "netlist_sha256": hashlib.sha256(netlist_bytes(netlist)).hexdigest(),
            "form": form,
            "input": _input_words(netlist),
            "max_depth": netlist.max_depth,
            "layers": [
                {
                    "name": layer.name,
                    "depth": layer.depth,
                    "neurons": netlist.layers[layer.index].neurons,
                    "held": netlist.neuron[layer.ids].tolist(),
                    "kind": np.dtype(layer.kind).name,
                }
                for layer in layers
            ],
        },
    )
    return content, *model[1:]


def _input_words(netlist: Netlist) -> str:
    """What the events of a file are, for its metadata."""
    polarities = netlist.polarities
    clocks = netlist.clocks
    words = f"{netlist.taxels} taxels x {polarities} polarities; channel = taxel * {polarities} + polarity; 0 or 1"
    if netlist.bins > 1:
        words += f"; a step joins {netlist.bins} bins of the recordings"
    if clocks.channels:
        words += f"; then {clocks.channels} clocks: the k-th, from 0, is 1 in the {clocks.steps} steps from "
        words += f"k * {clocks.steps}"
    if clocks.length is not None:
        words += f"; every recording is run for {clocks.length} steps, in silence after its end"
    return words


def _chip_step(netlist: Netlist, layers: tuple[Layer, ...]) -> Model:
    """The form ``step``: each layer takes what the others left in the step before."""
    graph = Nodes()
    states = [Port(name="step", kind=np.int64, shape=())]
    received = {INPUT: "events"} | {layer.index: f"{layer.name}.spikes" for layer in layers}
    graph.add("Add", ["step", np.int64(1)], "step_next")
    windows = {depth: _window(graph, depth) for depth in sorted({layer.depth for layer in layers})}
    for layer in layers:
        size = ("batch", layer.size)
        states.append(Port(name=f"{layer.name}.spikes", kind=np.uint8, shape=size))
        states.append(Port(name=f"{layer.name}.membrane", kind=layer.kind, shape=size))
        if layer.remembers:
            states.append(Port(name=f"{layer.name}.current", kind=layer.kind, shape=size))
        spikes = [received[pre] for pre in layer.sources]
        _integrate(graph, netlist, layer, spikes, windows[layer.depth])
    votes = "votes"
    voting = [layer for layer in layers if np.any(netlist.readout_class[layer.ids] >= 0)]
    for layer in voting:
        poll = (netlist.readout_class[layer.ids, None] == np.arange(netlist.classes)).astype(np.uint8)
        more = graph.add("MatMulInteger", [f"{layer.name}.spikes_next", poll], f"{layer.name}/votes")
        last = "votes_next" if layer is voting[-1] else f"{layer.name}/voted"
        votes = graph.add("Add", [votes, more], last)
    if voting:
        states.append(Port(name="votes", kind=np.int32, shape=("batch", netlist.classes)))
    events = Port(name="events", kind=np.uint8, shape=("batch", netlist.n_inputs))
    length = Port(name="length", kind=np.int64, shape=())
    return graph, [events, length, *states], [replace(state, name=f"{state.name}_next") for state in states]


def _window(graph: Nodes, depth: int) -> str:
    """Whether layers of a depth integrate in this chip step; bool scalar."""
    name = f"window{depth}"
    begin = np.int64(depth)
    begun = graph.add("GreaterOrEqual", ["step", begin], f"{name}/begun")
    since = graph.add("Sub", ["step", begin], f"{name}/since")
    return graph.add("And", [begun, graph.add("Less", [since, "length"], f"{name}/lasts")], name)


def _integrate(graph: Nodes, netlist: Netlist, layer: Layer, spikes: list[str], is_open: str) -> None:
    """One step of the neurons, as :mod:`loihi1.spec` defines them; a closed window holds all registers at zero."""
    name = layer.name
    kind = layer.kind
    ids = layer.ids
    window = graph.cast(is_open, f"{name}/window", kind)
    inflow = _sum(graph, layer, spikes)
    if layer.remembers:
        lasting = _decayed(graph, layer, f"{name}.current", netlist.decay_u[ids] + 1, f"{name}/lasting")
        inflow = graph.add("Add", [lasting, inflow], f"{name}/current") if inflow else lasting
        graph.add("Mul", [inflow, window], f"{name}.current_next")
    biases = netlist.bias[ids]
    if biases.any():
        bias = graph.constant(f"{name}/bias", one_each(biases, kind))
        inflow = graph.add("Add", [inflow, bias], f"{name}/inflow") if inflow else bias
    value = _decayed(graph, layer, f"{name}.membrane", netlist.decay_v[ids], f"{name}/decayed")
    if inflow:
        value = graph.add("Add", [value, inflow], f"{name}/driven")
    if layer.saturates:
        value = graph.add("Clip", [value, kind(-MEMBRANE_MAX), kind(MEMBRANE_MAX)], f"{name}/clipped")
    value = graph.add("Mul", [value, window], f"{name}/gated")
    fired = graph.add(
        "Greater", [value, one_each(netlist.threshold[ids] << MEMBRANE_SHIFT, kind)], f"{name}/fired"
    )
    graph.add("Where", [fired, kind(0), value], f"{name}.membrane_next")
    graph.cast(fired, f"{name}.spikes_next", np.uint8)


def _sum(graph: Nodes, layer: Layer, spikes: list[str]) -> str:
    """Synaptic sums, membrane units; empty where no layer feeds it."""
    total = ""
    every = zip(spikes, map(digits, layer.sources.values()), strict=True)
    parts = [(received, digit, factor) for received, found in every for digit, factor in found]
    for count, (received, digit, factor) in enumerate(parts):
        name = f"{layer.name}/product/{count}"
        product = graph.add("MatMulInteger", [received, digit], name)
        if layer.kind is not np.int32:
            product = graph.cast(product, f"{name}/wide", layer.kind)
        scaled = graph.add(
            "Mul", [product, one_each(factor << MEMBRANE_SHIFT, layer.kind)], f"{name}/scaled"
        )
        total = graph.add("Add", [total, scaled], f"{name}/sum") if total else scaled
    return total


def _decayed(graph: Nodes, layer: Layer, register: str, lost: IntArray, name: str) -> str:
    """Keep ``(4096 - lost) / 4096``: a product and an integer division, which truncates toward zero."""
    product = graph.add("Mul", [register, one_each(DECAY_ONE - lost, layer.kind)], f"{name}/product")
    return graph.add("Div", [product, layer.kind(DECAY_ONE)], name)
