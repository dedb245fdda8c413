"""Read a spiking network from a NIR file: affine stages become weights, in float64, spiking nodes become layers."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

from spikeloom.compiler.arrays import read_only
from spikeloom.compiler.dynamics import MOST_CLOCKS, MOST_STEPS, RELAY_WEIGHT, Clocks
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.files import reading
from spikeloom.compiler.formats.affine import scaled, shifted
from spikeloom.compiler.formats.assemble import Layer, ReadNetwork, assemble, by_depth, class_of_each
from spikeloom.compiler.formats.hdf5 import AGAIN, entry_of, read_hdf5
from spikeloom.compiler.formats.names import named, printable, unique_names
from spikeloom.compiler.formats.nir import CONVENTIONS, stages
from spikeloom.compiler.formats.nir.file import (
    INPUT_NODE,
    OUTPUT_NODE,
    SPIKING,
    Graph,
    Node,
    graph_of,
    loops,
    only,
)
from spikeloom.compiler.formats.nir.file import in_order as nodes_in_order
from spikeloom.compiler.formats.sensor_layout import order_of, sensor_layout
from spikeloom.compiler.ir import INPUT, Form, Input, Network, Sparse
from spikeloom.compiler.targets.loihi1.registers import (
    THRESHOLD_MANTISSA_MAX,
    decay_registers,
    kept_shares,
    plane_distance,
)
from spikeloom.compiler.types import FloatArray, IntArray

AXES = 8
ELEMENTS = 2**20
"""Most axes and elements of an input."""

SOFT = ("subtract", "soft")
"""Words by which exporters tell a reset that leaves what exceeds the threshold."""


def read_nir(
    path: str | os.PathLike[str],
    *,
    dt: float | None = None,
    convention: str | None = None,
    polarities: int | None = None,
    polarities_first: bool | None = None,
    usual: Mapping[str, Any] | None = None,
) -> ReadNetwork[Network]:
    """Read a network, in steps of `dt` seconds, by default those that the metadata of the file tell.

    The `convention` (``euler`` by default) says how time constants become decays, see :mod:`nir.stages`;
    polarities are those of :func:`sensor_layout.sensor_layout`. `usual` has both where neither is given, nor
    stated by the file.

    Raises ModelError if the file cannot be read, or holds something else than a network that spikes,
    feed-forward but for recurrent layers, naming the node; OptionError if there is no time step, an option
    has no such value, or is another than the file states.
    """
    with reading(path, ModelError, AGAIN):
        graph = graph_of(*read_hdf5(Path(path), "NIR file"))
        stated = stages.stated_step(graph)
        if stated is not None:
            _require_stated(stated, dt, convention)
            usual = {"dt": stated}
        dt = (usual or {}).get("dt") if dt is None else dt
        convention = (usual or {}).get("convention") if convention is None else convention
        if dt is None:
            written = stages.written_step(graph)
            hint = (
                "" if written is None else f", but its r is tau / {written:g}, as of steps of {written:g} s"
            )
            raise OptionError(f"{path}: NIR keeps no time step{hint}; give --dt SECONDS")
        steps = stages.Steps(dt=dt, convention=convention or CONVENTIONS[0])
        stages.require_step(dt)
        with np.errstate(all="ignore"):  # what is not finite is refused at the end
            return network_of(graph, steps, polarities, polarities_first)


def _require_stated(stated: float, dt: float | None, convention: str | None) -> None:
    """Refuse options that contradict the steps that a file states of itself."""
    if dt is not None and dt != stated:
        raise OptionError(f"--dt {dt:g}: the file states steps of {stated:g} s; omit --dt")
    if convention not in (None, CONVENTIONS[0]):
        raise OptionError(
            f"--convention {convention}: the file states its steps, which are {CONVENTIONS[0]}; omit --convention"
        )


def network_of(
    graph: Graph, steps: stages.Steps, polarities: int | None = None, polarities_first: bool | None = None
) -> ReadNetwork[Network]:
    """Network of a graph that was read; parameters and errors as of :func:`read_nir`, without the path."""
    entry = only(graph.nodes, INPUT_NODE)
    end = only(graph.nodes, OUTPUT_NODE)
    shape = tuple(entry.integers("shape").ravel().tolist()) if entry.has("shape") else ()
    if not shape or len(shape) > AXES or min(shape) < 1 or math.prod(shape) > ELEMENTS:
        raise entry.fail(
            f"has the shape {list(shape[:AXES])}, allowed are up to {ELEMENTS} values; export it again"
        )
    sensor, positions, words = _sensor(graph, shape, polarities, polarities_first)
    _require_reset(graph.metadata, lambda words: ModelError(f"the graph {words}"))
    spiking, result = _walk(graph, steps, shape)
    if not spiking:
        raise ModelError("has no spiking neurons, so nothing can be counted; export a spiking network")
    voters, label = _readout(end, result, spiking)
    layers, constant = _layers(spiking, positions, sensor.clocks.channels)
    layers, sensor = _with_held(layers, constant, sensor)
    network = assemble(layers, sensor, voters, label, result.size)
    facts = _facts(graph, steps, spiking, f"input {printable(entry.name)}: {words}", sensor)
    facts.append(
        f"classes: the spikes of {printable(spiking[voters].node.name)} in output {printable(end.name)}"
    )
    training = json.loads(entry_of(graph.metadata, "training", str) or "null")
    return ReadNetwork(
        network=replace(network, forms=_forms(graph, spiking, network)),
        facts=tuple(facts),
        sha256=graph.sha256,
        read_as=asdict(steps) | order_of(sensor, positions),
        training=training if isinstance(training, dict) else None,
    )


def _sensor(
    graph: Graph, shape: tuple[int, ...], polarities: int | None, first: bool | None
) -> tuple[Input, IntArray, str]:
    """As :func:`sensor_layout.sensor_layout`, with polarities, bins and clocks that the file names; clocks are last."""
    said = {
        name: stages.stated_steps(graph, name) for name in ("polarities", "bins", "length", "clock_steps")
    }
    stated = said["polarities"]
    if stated is not None and ((polarities or stated) != stated or first):
        option = "--polarities-first" if first else f"--polarities {polarities}"
        raise OptionError(f"{option}: the file says {stated} polarities, taxel by taxel; omit it")
    channels = stages.stated_steps(graph, "clocks") or 0
    if channels and (channels > MOST_CLOCKS or len(shape) > 1 or shape[0] <= channels):
        raise ModelError(f"has {channels} clocks in an input of shape {list(shape)}; {AGAIN}")
    sensed = (shape[0] - channels,) if channels else shape
    count = stated if polarities is None else polarities
    sensor, positions, words = sensor_layout(sensed, polarities=count, polarities_first=first)
    clocks = Clocks(channels=channels, steps=said["clock_steps"] or 1, length=said["length"])
    positions = np.append(positions, np.arange(sensor.size, sensor.size + channels))
    words += f", then {channels} clocks of {clocks.steps} steps" if channels else ""
    return replace(sensor, bins=said["bins"] or 1, clocks=clocks), positions, words


def _relays(weight: Sparse, bias: FloatArray, clocks: int) -> int:
    """How many neurons at the end of a layer relay a clock each, and nothing else: all clocks have one, or none."""
    last = weight[-clocks:].tocoo()
    own = last.col - last.row == weight.shape[1] - clocks
    found = clocks and weight.shape[0] >= clocks == last.nnz and own.all() and not bias[-clocks:].any()
    return clocks if found else 0


def _forms(graph: Graph, spiking: Sequence[Neurons], network: Network) -> tuple[Form, ...] | None:
    """Storage that a network was fine-tuned for, where all nodes say so; ModelError if no chip has it."""
    forms = {}
    for name, one in zip(unique_names([one.node.name for one in spiking]), spiking, strict=True):
        stored = replace(one.node, values=one.node.metadata)
        if not stored.has("bits"):
            return None
        forms[name] = _form(stored, one.theta)
    for name in (population.name for population in network.populations if population.name not in forms):
        relay = Node(name=name, type="", values=entry_of(graph.metadata, name, dict), metadata={})
        if not relay.has("bits"):
            return None
        forms[name] = _form(relay, relay.numbers("threshold").ravel())
    return tuple(forms[each.name] for each in network.populations)


def _form(stored: Node, theta: FloatArray) -> Form:
    """Storage of one layer, with its thresholds in weight units."""
    bits = stored.few("bits")[0]
    exponents = stored.integers("exponents").ravel().tolist()
    gaps = (0 < after - before <= plane_distance(bits) for before, after in pairwise(exponents))
    within = 2 <= bits <= 8 and exponents and -8 <= exponents[0] and exponents[-1] < 8 and all(gaps)
    whole = (
        theta.size
        and np.all(theta == np.rint(theta))
        and 0 < theta.min() <= theta.max() <= THRESHOLD_MANTISSA_MAX
    )
    if not within or not whole:
        raise stored.fail("has no usable storage, or thresholds that are not whole; fine-tune it again")
    return Form(bits=bits, exponents=tuple(exponents), threshold=read_only(theta))


def _walk(graph: Graph, steps: stages.Steps, shape: tuple[int, ...]) -> tuple[list[Neurons], stages.Value]:
    """All spiking nodes in order, and what the output gets."""
    received: dict[str, list[str]] = {name: [] for name in graph.nodes}
    for source, target in graph.edges:
        received[target].append(source)
    values: dict[str, stages.Value] = {}
    spiking: list[tuple[Node, stages.Value]] = []
    late = loops(graph)
    for name in nodes_in_order(graph, late):
        node = graph.nodes[name]
        if node.type == INPUT_NODE:
            if received[name]:
                raise node.fail("gets values from other nodes; remove these edges")
            values[name] = stages.spikes_of(INPUT, shape)
            continue
        with named(node):
            value = stages.added(
                [values[source] for source in received[name] if source not in late.get(name, ())]
            )
        if node.type in SPIKING:
            values[name] = stages.spikes_of(len(spiking), value.shape)
            spiking.append((node, value))
        elif node.type in stages.STAGES:
            values[name] = stages.STAGES[node.type](node, value, steps)
        else:
            known = ", ".join(sorted([*SPIKING, *stages.STAGES]))
            raise node.fail(f"is of a type that has no place here, allowed are {known}; replace it")
    neurons = []
    for node, value in spiking:
        with named(node):
            every = stages.added([value, *(values[source] for source in late.get(node.name, ()))])
        neurons.append(_neurons(node, every, steps))
    return neurons, values[only(graph.nodes, OUTPUT_NODE).name]


def _layers(
    spiking: Sequence[Neurons], positions: IntArray, clocks: int
) -> tuple[list[Layer], list[Sparse | None]]:
    """A layer for each node, and what flows into its currents in every step, (neurons, 1); clocks are last."""
    layers: list[Layer] = []
    constant = []
    for place, (one, name) in enumerate(
        zip(spiking, unique_names([one.node.name for one in spiking]), strict=True)
    ):
        # Neurons of other thresholds are those of one, with their weights and biases in its units.
        theta = float(one.theta[0])
        value = scaled(one.value, theta / one.theta)
        sources = dict(value.terms)
        always = sources.pop(stages.ALWAYS, None)
        constant.append(always if always is not None and always.count_nonzero() else None)
        for weight in sources.values():
            weight.eliminate_zeros()
        if INPUT in sources:
            sources[INPUT] = sources[INPUT][:, positions]
        reached = {source: weight for source, weight in sources.items() if weight.nnz}
        sources = reached if reached.keys() - {place} else sources
        relays = _relays(sources[INPUT], value.bias, clocks) if INPUT in sources else 0
        layers.append(
            Layer(
                name=name,
                beta=one.beta,
                theta=theta,
                bias=value.bias,
                sources=sources,
                alpha=value.alpha,
                relays=relays,
            )
        )
    return layers, constant


def _with_held(layers: list[Layer], held: list[Sparse | None], sensor: Input) -> tuple[list[Layer], Input]:
    """Let a channel that always has an event bring biases that go through a filter: the chip adds them past it."""
    lasting = [index for index, channel in enumerate(held) if channel is not None]
    if not lasting:
        return layers, sensor
    if sensor.clocks.channels:
        raise ModelError(
            "has clocks, and biases that go through currents, which need a channel of their own"
        )
    depth = {index: deep for deep, ready in enumerate(by_depth(layers)) for index in ready}

    def with_channel(size: int, weight: Sparse | None, channel: Sparse | None) -> Sparse:
        """Weights of the input into so many neurons, if there are any, and beside them those of the channel."""
        sensed = sparse.csr_array((size, sensor.size)) if weight is None else weight
        return sparse.hstack(
            [sensed, sparse.csr_array((size, 1)) if channel is None else channel], format="csr"
        )

    extended = []
    for index, layer in enumerate(layers):
        sources = dict(layer.sources)
        deep = depth[index]
        if not deep or INPUT in sources:
            sources[INPUT] = with_channel(layer.size, sources.get(INPUT), None if deep else held[index])
        if deep and held[index] is not None:
            sources[len(layers) + deep - 1] = held[index]
        extended.append(replace(layer, sources=sources))
    relay = sparse.csr_array([[RELAY_WEIGHT]])
    for step in range(max(depth[index] for index in lasting)):  # one a depth, on the way to the deepest
        source = len(layers) + step - 1 if step else INPUT
        weight = relay if step else with_channel(1, None, relay)
        name = f"always{step + 1}"
        extended.append(
            Layer(name=name, beta=0.0, theta=1.0, bias=np.zeros(1), sources={source: weight}, relays=1)
        )
    return extended, replace(sensor, clocks=replace(sensor.clocks, channels=1, steps=MOST_STEPS))


def _readout(end: Node, result: stages.Value, spiking: Sequence[Neurons]) -> tuple[int, IntArray]:
    """The spiking node whose spikes are counted, and the class of each of its neurons."""
    remedy = "end the network with a spiking layer, one neuron or one group of neurons a class"
    if result.alpha:
        raise end.fail(f"gets the membranes of a leaky integrator, a chip counts spikes; {remedy}")
    if len(result.terms) != 1 or INPUT in result.terms:
        raise end.fail(f"gets no count of the spikes of one layer; {remedy}")
    if end.has("shape") and math.prod(declared := end.integers("shape").ravel().tolist()) != result.size:
        raise end.fail(
            f"is declared {declared}, it gets {list(result.shape)}; the shapes disagree, export it again"
        )
    ((source, counts),) = result.terms.items()
    label = class_of_each(counts)
    if label is None or (result.bias.size and np.ptp(result.bias) > 0):
        raise end.fail(
            f"gets weighted spikes of {printable(spiking[source].node.name)}, a vote counts them; {remedy}"
        )
    return source, label


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Neurons:
    """A spiking node in steps, reset to 0; all arrays (neurons,) float64.

    ``u <- beta * u * (1 - s) + value``, ``s = u > theta``. An IF neuron keeps its whole membrane and gets
    ``dt * r * I``. A neuron that resets to `v_reset` is one that resets to 0, with its threshold, leak and
    start shifted by it.
    """

    node: Node  # As the file has it
    value: stages.Value  # What it gets, scaled to its membrane, with its leak
    beta: float
    gain: FloatArray  # By which its input was scaled
    theta: FloatArray
    reset: FloatArray


def _neurons(node: Node, value: stages.Value, steps: stages.Steps) -> Neurons:
    """Neurons of a node of a type in ``SPIKING`` that gets a value; ModelError if the chip has no such neurons."""
    size = value.size
    shape = value.shape
    if not size:
        raise node.fail("has no neurons; export it again")
    _require_reset(node.metadata | {k: v for k, v in node.values.items() if "reset" in k}, node.fail)

    def each(key: str) -> FloatArray:
        return stages.spread(node, key, size, shape)

    nothing = np.zeros(size)
    alpha = 0.0
    beta = 0.0
    gain = np.ones(size)
    drive = nothing
    reset = each("v_reset") if node.has("v_reset") else nothing
    theta = each("threshold" if node.type == "Threshold" else "v_threshold") - reset
    if node.type == "IF":
        beta = 1.0
        gain = each("r") * steps.dt
    elif node.type in ("LIF", "CubaLIF"):
        key = "tau" if node.type == "LIF" else "tau_mem"
        kept = steps.keeps(node, key, size, shape)
        beta = stages.shared(node, key, kept)
        drive = (1 - kept) * (each("v_leak") - reset)
        gain = each("r") * (1 - kept)
        if node.type == "CubaLIF":
            alpha = stages.shared(node, "tau_syn", steps.keeps(node, "tau_syn", size, shape))
            gain = gain * (each("w_in") if node.has("w_in") else np.ones(size)) * (1 - alpha)
        # r = tau / dt, stored in float32, makes a gain of 1 that is not quite one
        gain = np.where(np.abs(gain - 1) < stages.TOLERANCE, 1.0, gain)
    if np.any(theta <= 0):
        raise node.fail(
            f"fires {theta.min():g} above its reset, allowed are thresholds above it; train it again"
        )
    with named(node):
        state = shifted(stages.filtered(value, alpha, gain, nothing), drive)  # a leak acts past the current
    return Neurons(node=node, value=state, beta=beta, gain=gain, theta=theta, reset=reset)


def _require_reset(said: Mapping[str, Any], fail: Callable[[str], Exception]) -> None:
    """Refuse what a node or the graph says of a reset that the chip does not have."""
    for key, value in said.items():
        if "reset" in key.lower() and isinstance(value, str) and any(word in value.lower() for word in SOFT):
            raise fail(
                f"resets by subtraction ({key} = {value!r}), which a neuron of this chip cannot; train with a reset "
                "to a value"
            )


def _facts(
    graph: Graph, steps: stages.Steps, spiking: Sequence[Neurons], sensor: str, clocked: Input
) -> list[str]:
    """How a file was read, its layers, what its input (`sensor`, in words) was taken for, and what files may lose."""
    version = printable(graph.version) or "of no version"
    facts = [f"NIR {version}, read in steps of {steps.dt:g} s ({steps.convention})", sensor]
    for one in spiking:
        _, realised = kept_shares(*decay_registers(one.beta))
        fact = f"layer {printable(one.node.name)} ({one.node.type}): {one.value.size} neurons, decay {one.beta:.6g}"
        if not math.isclose(one.beta, realised, abs_tol=stages.TOLERANCE):
            fact += f" ({realised:.6g} on the chip)"
        fact += f", current {one.value.alpha:.6g}" if one.value.alpha else ""
        fact += f", fires at v > {_span(one.theta + one.reset)}, then v = {_span(one.reset)}"
        if np.any(np.abs(one.gain - 1) > 1e-4):
            fact += f"; a step adds {_span(one.gain)} of its input"
        facts.append(fact)
    facts += [
        "v goes to its reset as NIR says; a framework that subtracts the threshold instead means another network"
    ]
    if moved := [printable(one.node.name) for one in spiking if np.any(one.reset)]:
        facts.append(
            f"{', '.join(moved)}: v starts at its reset, of which NIR says nothing; a framework that starts at another "
            "v spikes otherwise until the first reset"
        )
    if any(one.node.type == "CubaLIF" for one in spiking):
        facts += [
            "a reset leaves currents as they are, as NIR says; snnTorch's Synaptic with reset 'zero' clears them"
        ]
    if looped := [printable(one.node.name) for place, one in enumerate(spiking) if place in one.value.terms]:
        facts.append(
            f"{', '.join(looped)}: is recurrent, fed by its own spikes of the step before; snnTorch's RLeaky with "
            "reset 'zero' means this with reset_delay=False, else it loses the input of the step after each spike"
        )
    written = stages.written_step(graph)
    if written is not None and not math.isclose(written, steps.dt, rel_tol=1e-4):
        facts.append(
            f"drift: r is tau / {written:g} in every neuron, as of a file written in steps of {written:g} s; in steps "
            f"of {steps.dt:g} s its decays and gains are others than there"
        )
    if clocked.clocks.steps == MOST_STEPS:
        facts.append(
            "biases that go through a synaptic current come from a channel that always has an event"
        )
    return facts


def _span(values: FloatArray) -> str:
    low = float(values.min())
    high = float(values.max())
    return (
        f"{low:.6g}" if math.isclose(low, high, rel_tol=1e-6, abs_tol=1e-12) else f"{low:.6g} … {high:.6g}"
    )
