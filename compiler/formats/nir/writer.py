"""A netlist as a NIR file: the float network that comes closest to what the chip does.

Numbers are in weight units, so that weights and thresholds are the chip's integers and sums of them exact in
float32; decays are the registers' own. What remains different is rounding: a register is cut to a whole
number in every step, a float is not.

* A layer is an Affine or Linear for each layer that feeds it, and a LIF; an IF where it keeps its whole membrane, a
  CubaLIF where its current outlasts a step. A CubaLIF's bias, which the chip adds past the current, is a
  leak voltage.
* Time constants are those of the forward Euler method for the step given: ``1 - dt / tau`` is what a step keeps, and
  ``r = tau / dt`` makes a step add its input as it is.
* Inputs are one flat axis, ``taxel * polarities + polarity``, then the clocks. A vote of several neurons is a Linear.
* A channel that always has an event is a bias, as in the file that it was read from; so are the relays of it.

Neurons that the chip leaves out are there and receive nothing.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.dynamics import MOST_STEPS, Clocks
from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.hdf5 import Tree, hdf5_bytes
from spikeloom.compiler.formats.names import plain_names
from spikeloom.compiler.formats.nir.file import WRITER
from spikeloom.compiler.formats.nir.stages import require_step
from spikeloom.compiler.ir import INPUT, Sparse, added_up
from spikeloom.compiler.targets.loihi1.integers import IntegerNetwork, IntegerPopulation
from spikeloom.compiler.targets.loihi1.registers import MEMBRANE_SHIFT
from spikeloom.compiler.targets.loihi1.storage.weight_storage import FORGETS
from spikeloom.compiler.types import FloatArray

VERSION = "1.0.8"
"""Version of the layout that is written."""

DENSE_LIMIT = 2**28
"""Weights of a matrix: NIR writes zeros out."""

Float32 = npt.NDArray[np.float32]


def export(network: IntegerNetwork, dt: float, *, training: str | None = None) -> bytes:
    """Content of the file, for steps of `dt` seconds; equal networks give equal bytes.

    The file says how each layer is stored, so that it compiles to these very integers. `training` is how the
    network was made, as JSON, or what is known of its recordings.

    Raises ModelError if NIR cannot say what the network does, OptionError if there is no such time step.
    """
    require_step(dt)
    # what separates names in a file becomes an underscore
    names = plain_names(
        [population.name for population in network.populations], taken=["input", "output", "class_counts"]
    )
    always = _always(network)
    nodes: dict[str, Tree] = {"input": {"type": "Input", "shape": np.array([network.input.size - always])}}
    edges: list[tuple[str, str]] = []
    constant: list[int] = []
    for post, (population, name) in enumerate(zip(network.populations, names, strict=True)):
        bias = population.bias / (1 << MEMBRANE_SHIFT)
        sources = added_up((p.pre, p.effective()) for p in network.projections if p.post == post)
        added = np.zeros(population.size)
        if always and INPUT in sources:
            added += sources[INPUT][:, [-1]].toarray().ravel()
            sources[INPUT] = sources[INPUT][:, :-1]
        added += sum(sources.pop(pre).toarray().ravel() for pre in constant if pre in sources)
        received = any(weight.count_nonzero() for weight in sources.values())
        if always and population.size == 1 and not received and added[0] > population.threshold[0]:
            constant.append(post)  # it fires in every step: what it brings is a bias
            continue
        if population.decay_u == FORGETS:
            added += bias
        for number, (pre, weight) in enumerate(sorted(sources.items())):
            source = "input" if pre == INPUT else names[pre]
            synapses = f"{source}_to_{name}"
            while synapses in names or synapses in nodes:
                synapses += "_"
            nodes[synapses] = {"type": "Linear", "weight": _dense(population, weight)}
            if not number and (population.decay_u == FORGETS or added.any()):
                nodes[synapses] |= {"type": "Affine", "bias": added.astype(np.float32)}
            edges += [(source, synapses), (synapses, name)]
        nodes[name] = _neurons(population, bias, dt)
        nodes[name]["metadata"] = _form(network, post)
    voters = names[network.readout.population]
    label = network.readout.label
    if np.array_equal(label, np.arange(network.classes)):
        edges.append((voters, "output"))
    else:
        votes = np.zeros((network.classes, len(label)), np.float32)
        votes[label, np.arange(len(label))] = 1
        nodes["class_counts"] = {"type": "Linear", "weight": votes}
        edges += [(voters, "class_counts"), ("class_counts", "output")]
    nodes["output"] = {"type": "Output", "shape": np.array([network.classes])}
    said = _said(network, dt, constant) | ({"training": training} if training is not None else {})
    graph = {"type": "NIRGraph", "edges": edges, "metadata": said, "nodes": nodes}
    return hdf5_bytes({"version": VERSION, "node": graph})


def _always(network: IntegerNetwork) -> bool:
    """Whether the only clock is a channel that always has an event."""
    return network.input.clocks == Clocks(channels=1, steps=MOST_STEPS)


def _said(network: IntegerNetwork, dt: float, constant: Sequence[int]) -> Tree:
    """Metadata of the file, with the storage of those layers that are `constant`."""
    said: Tree = {
        "dt": np.array(dt),
        "writer": WRITER,
        "polarities": np.array(network.input.polarities),
    }
    bins = network.input.bins
    clocks = network.input.clocks
    said |= {"bins": np.array(bins)} if bins > 1 else {}
    said |= {"length": np.array(clocks.length)} if clocks.length is not None else {}
    if clocks.channels and not _always(network):
        said |= {"clocks": np.array(clocks.channels), "clock_steps": np.array(clocks.steps)}
    for number, post in enumerate(constant, 1):
        threshold = {"threshold": network.populations[post].threshold}
        said[f"always{number}"] = _form(network, post) | threshold
    return said


def _form(network: IntegerNetwork, post: int) -> Tree:
    """How a layer is stored."""
    form = network.forms[post]
    return {"bits": np.array(form.bits), "exponents": np.array(form.exponents)}


def _dense(population: IntegerPopulation, weight: Sparse) -> Float32:
    """Weights into a layer as a whole matrix; ModelError if it is too large."""
    if weight.shape[0] * weight.shape[1] > DENSE_LIMIT:
        raise ModelError(
            f"{population.name}: has {weight.shape[0]} x {weight.shape[1]} weights, zeros among them, "
            f"{DENSE_LIMIT} are allowed; NIR keeps whole matrices"
        )
    return np.asarray(weight.toarray().astype(np.float32))


def _neurons(population: IntegerPopulation, bias: FloatArray, dt: float) -> Tree:
    def each(value: float) -> Float32:
        return np.full(population.size, value, np.float32)

    leak = 1 - population.realised_beta
    common = {"v_threshold": population.threshold.astype(np.float32), "v_reset": each(0)}
    if population.decay_u != FORGETS:
        if not leak:
            raise ModelError(
                f"{population.name}: keeps its whole membrane and has a current that outlasts its step, NIR's CubaLIF "
                "always leaks; train with a decay below 1"
            )
        drained = 1 - population.realised_alpha
        return {
            "type": "CubaLIF",
            "tau_syn": each(dt / drained),
            "tau_mem": each(dt / leak),
            "r": each(1 / leak),
            "w_in": each(1 / drained),
            "v_leak": (bias / leak).astype(np.float32),
            **common,
        }
    if not leak:
        return {"type": "IF", "r": each(1 / dt), **common}
    return {"type": "LIF", "tau": each(dt / leak), "r": each(1 / leak), "v_leak": each(0), **common}
