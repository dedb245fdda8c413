"""How closely the chip's spikes follow the float model, and which deviation costs what.

The reference is the float model in the released operator order, in float32. A float64 run stands beside it: spikes
in which the two differ are ill-posed, decided by the rounding of a sum and not by the chip.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from spikeloom.compiler import lift
from spikeloom.compiler.dynamics import Clocks, with_clocks
from spikeloom.compiler.errors import DataError, ModelError
from spikeloom.compiler.fixedpoint import MEMBRANE_SHIFT, FloatArray, IntArray
from spikeloom.compiler.formats.checkpoint import Checkpoint
from spikeloom.compiler.interpret import BoolArray, channels_last, cut, run_float, run_integer, vote
from spikeloom.compiler.ir import IntegerNetwork, Network, Projection, Sparse
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.systems import GRAPH_SYSTEMS
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.storage.range_proof import prove_ranges
from spikeloom.runtime.equivalence import onnx_check
from spikeloom.runtime.equivalence.breakdowns import Breakdown, breakdowns
from spikeloom.runtime.equivalence.certificates import Certificate, certify
from spikeloom.runtime.equivalence.divergence import Divergence, first_divergence
from spikeloom.runtime.machines.loihi1 import engine, spec
from spikeloom.runtime.machines.loihi1.trace import ENGINES, Trace, aligned, check_channels, heard
from spikeloom.runtime.machines.votes import class_counts, readout_counts

LADDER = ("float64", "beta", "weights", "bias_threshold", "rounding", "saturation")
"""Deviations in the order in which they are added; the last one is the chip."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerSpikes:
    """Spikes of one layer over all recordings.

    Parameters
    ----------
    float, chip : int
        Spikes of the float32 reference and of the chip.
    different : int
        Entries (recording, step, neuron) in which they differ.
    ill_posed : int
        Entries in which the float64 model differs from the float32 one.
    """

    float: int
    chip: int
    different: int
    ill_posed: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Verdict:
    """Everything that verify found.

    Parameters
    ----------
    files : tuple of str
        Recordings.
    labels, float_predictions, chip_predictions : (samples,) int64
        Classes.
    float_counts, chip_counts : (samples, classes) int64
        Votes per class.
    spikes : mapping of str to LayerSpikes
        Per layer.
    spec_samples : int
        Recordings on which the specification was run beside the engine.
    spec_equals_engine : bool
        Whether every spike, membrane and count was equal there; with onnxruntime beside, whether its spikes, its
        membranes after the reset and its votes were so too, and its spikes those of our engine on all recordings.
    first_divergence : Divergence or None
        None if no spike differs.
    ladder : tuple of (stage, mapping of layer to different entries)
        Differences from the float32 reference with one deviation more on each rung.
    same_checkpoint : bool
        Whether the netlist was compiled from this very checkpoint file and epoch.
    quantised_different : int or None
        Spikes of all layers in which a fine-tuned checkpoint's torch model, on chip integers, and the chip differ;
        None where the checkpoint was not fine-tuned.
    breakdowns : tuple of Breakdown
        Known failures that were found.
    not_compared : mapping of str to int
        Neurons of each layer that the chip leaves out because nobody hears them, where there are any.
    certificate : Certificate
        What of all this holds in whatever order the float model adds, and of registers for any input.
    engine : str
        One of ``ENGINES``.
    engine_different : int or None
        Spikes in which the further engine differs from ours, on all recordings; None where there is no further one.
    """

    files: tuple[str, ...]
    labels: IntArray
    float_predictions: IntArray
    chip_predictions: IntArray
    float_counts: IntArray
    chip_counts: IntArray
    spikes: Mapping[str, LayerSpikes]
    spec_samples: int
    spec_equals_engine: bool
    first_divergence: Divergence | None
    ladder: tuple[tuple[str, Mapping[str, int]], ...]
    same_checkpoint: bool
    quantised_different: int | None
    breakdowns: tuple[Breakdown, ...]
    not_compared: Mapping[str, int]
    certificate: Certificate
    engine: str
    engine_different: int | None

    @property
    def float_accuracy(self) -> float:
        """Share of recordings that the float model gets right."""
        return float(np.mean(self.float_predictions == self.labels))

    @property
    def chip_accuracy(self) -> float:
        """Share of recordings that the chip gets right."""
        return float(np.mean(self.chip_predictions == self.labels))

    @property
    def decision_agreement(self) -> float:
        """Share of recordings in which both decide alike."""
        return float(np.mean(self.float_predictions == self.chip_predictions))


def require_match(netlist: Netlist, model: Checkpoint | Network) -> None:
    """Refuse a netlist and a checkpoint or float network of different architecture.

    Raises
    ------
    ModelError
        If taxels, channels, timing, or layer names or sizes differ.
    """
    ours = {"taxels": netlist.taxels, "channels": netlist.polarities}
    ours |= _timing(netlist.clocks, netlist.bins) | {layer.name: layer.neurons for layer in netlist.layers}
    what = "network" if isinstance(model, Network) else "checkpoint"
    if isinstance(model, Network):
        theirs = {"taxels": model.input.taxels, "channels": model.input.polarities}
        theirs |= _timing(model.input.clocks, model.input.bins) | {p.name: p.size for p in model.populations}
    else:
        theirs = {"taxels": model.taxels, "channels": model.hops.shape[2]}
        theirs |= _timing(model.dynamics.clocks, model.bins) | model.neurons
    if ours != theirs:
        sizes = [", ".join(f"{name} {neurons}" for name, neurons in side.items()) for side in (ours, theirs)]
        raise ModelError(
            f"netlist and {what} disagree: the netlist has {sizes[0]}, the {what} {sizes[1]}; "
            f"give the {what} that the netlist was compiled from"
        )


def _timing(clocks: Clocks, bins: int) -> dict[str, int]:
    found = {"clocks": clocks.channels, "steps of a clock": clocks.steps} if clocks.channels else {}
    return found | ({"bins of a step": bins} if bins > 1 else {})


def _same_run(slow: Trace, prepared: engine.Engine, events: npt.NDArray[np.uint8]) -> bool:
    """Whether specification and engine agree on one recording: every spike, membrane and count."""
    fast = engine.simulate(prepared, events[None], spikes=True, membranes=True, updated=True)
    pairs = [
        (slow.spikes, fast.spikes),
        (slow.membranes, fast.membranes),
        (slow.updated, fast.updated),
        (slow.counts.inputs, fast.counts.inputs),
        (slow.counts.spikes, fast.counts.spikes),
        (slow.counts.updates, fast.counts.updates),
        (slow.counts.saturations, fast.counts.saturations),
    ]
    return all(a is not None and b is not None and np.array_equal(a, b[0]) for a, b in pairs)


def _held_to_specification(
    netlist: Netlist,
    prepared: engine.Engine,
    further: onnx_check.Check | None,
    checked: int,
    events: npt.NDArray[np.uint8],
    lengths: IntArray | None,
    spikes: BoolArray,
) -> tuple[bool, int | None]:
    """Whether specification and engines agree; spikes of a further engine that differ from ours, if there is one."""
    ends = np.full(len(events), events.shape[2]) if lengths is None else lengths
    samples = [events[i, :, : ends[i]] for i in range(checked)]
    specified = [spec.simulate(netlist, sample) for sample in samples]
    equal = all(_same_run(slow, prepared, sample) for slow, sample in zip(specified, samples, strict=True))
    if further is None:
        return equal, None
    different = onnx_check.differing(further, events, lengths, spikes)
    return equal and different == 0 and onnx_check.as_specified(further, samples, specified), different


def realised(network: Network, integer: IntegerNetwork) -> tuple[Network, Network, Network]:
    """Float networks that carry the chip's decays; these and its weights; all of these, its biases and thresholds.

    Returns
    -------
    tuple of three Network
        In the float model's units, to be run in float64.
    """
    beta = replace(
        network,
        populations=tuple(
            replace(population, beta=chip.realised_beta, alpha=chip.realised_alpha)
            for population, chip in zip(network.populations, integer.populations, strict=True)
        ),
    )
    weights = replace(
        beta,
        projections=tuple(
            Projection(
                pre=projection.pre,
                post=projection.post,
                weight=_rows_scaled(projection.effective(), 1 / integer.populations[projection.post].scale),
            )
            for projection in integer.projections
        ),
    )
    # A neuron with another threshold fires as one with the model's threshold whose weights and bias are scaled to it.
    stretch = [population.theta / np.maximum(population.realised_theta, 1e-300) for population in integer.populations]
    bias_threshold = replace(
        weights,
        populations=tuple(
            replace(population, bias=chip.bias / (chip.scale * (1 << MEMBRANE_SHIFT)) * factor)
            for population, chip, factor in zip(beta.populations, integer.populations, stretch, strict=True)
        ),
        projections=tuple(
            replace(projection, weight=_rows_scaled(projection.weight, stretch[projection.post]))
            for projection in weights.projections
        ),
    )
    return beta, weights, bias_threshold


def _rows_scaled(weight: Sparse, factor: FloatArray) -> Sparse:
    """Multiply each row of a csr_array by a factor of its own; float64."""
    scaled = weight.astype(np.float64)
    scaled.data *= np.repeat(factor, np.diff(weight.indptr))
    return scaled


def spikes_of(
    model: Checkpoint | Network, adjacency: FloatArray | None, events: npt.NDArray[np.uint8], dtype: str
) -> list[BoolArray]:
    """Float spikes of each layer: of a checkpoint in its own operator order, of a network as sums over synapses."""
    from spikeloom.models.networks.reference import float_spikes  # torch, so only here

    if isinstance(model, Network):
        inputs = channels_last(events, model.input.clocks)
        return list(run_float(model, inputs, dtype=np.dtype(dtype)).spikes)
    assert adjacency is not None, "a checkpoint has a graph"
    return list(float_spikes(model, adjacency, events, dtype=dtype).values())


def membranes_of(
    model: Checkpoint | Network, adjacency: FloatArray | None, events: npt.NDArray[np.uint8]
) -> list[npt.NDArray[np.floating]]:
    """Membranes of each layer in float32, likewise."""
    from spikeloom.models.networks.reference import float_membranes  # torch, so only here

    if isinstance(model, Network):
        inputs = channels_last(events, model.input.clocks)
        kept = run_float(model, inputs, dtype=np.float32, membranes=True).membranes
        assert kept is not None, "membranes were asked for"
        return list(kept)
    assert adjacency is not None, "a checkpoint has a graph"
    return list(float_membranes(model, adjacency, events).values())


def _tuned_spikes(
    checkpoint: Checkpoint, adjacency: FloatArray | None, events: npt.NDArray[np.uint8]
) -> list[BoolArray]:
    """Spikes of each layer of a fine-tuned checkpoint's torch model, on chip integers."""
    from spikeloom.models.networks.quantised import quantised_spikes

    assert adjacency is not None, "a checkpoint has a graph"
    return list(quantised_spikes(checkpoint, adjacency, events).values())


def _network(model: Checkpoint | Network, adjacency: FloatArray | None) -> Network:
    """The float stage of a model."""
    if isinstance(model, Network):
        return model
    assert adjacency is not None, "a checkpoint has a graph"
    return expand(model, adjacency)


def _from_this(netlist: Netlist, checkpoint: Checkpoint | Network, sha256: str | None) -> bool:
    """Whether a netlist says that it was compiled from this file, and this epoch."""
    made = netlist.provenance
    if isinstance(checkpoint, Network):
        return made.get("checkpoint_sha256") == sha256
    return made.get("checkpoint_sha256") == checkpoint.sha256 and made.get("weights") == checkpoint.weights


def _rungs(
    network: Network, integer: IntegerNetwork, inputs: BoolArray, tell: Callable[[str], None]
) -> Iterator[tuple[str, tuple[BoolArray, ...] | None]]:
    """Spikes of the rungs between float64 and the chip; None for one that is proven to be the chip itself."""
    for stage, rung in zip(LADDER[1:4], realised(network, integer), strict=True):
        tell(f"ladder: {stage}")
        yield stage, run_float(rung, inputs).spikes
    if all(proof.holds for proof in prove_ranges(integer)):
        tell("ladder: proven")  # no register leaves its range on any input: without limits the chip is the same
        yield "rounding", None
    else:
        tell("ladder: rounding")
        yield "rounding", run_integer(integer, inputs, saturates=False).spikes


def verify(
    netlist: Netlist,
    checkpoint: Checkpoint | Network,
    adjacency: FloatArray | None,
    events: npt.NDArray[np.uint8],
    labels: IntArray,
    files: tuple[str, ...],
    *,
    lengths: IntArray | None = None,
    original: Checkpoint | Network | None = None,
    sha256: str | None = None,
    spec_samples: int = 3,
    engine_name: str = ENGINES[0],
    progress: Callable[[str], None] | None = None,
) -> Verdict:
    """Compare float model, chip and specification.

    Parameters
    ----------
    netlist : Netlist
        Compiled network.
    checkpoint : Checkpoint or Network
        What it was compiled from, or another of the same architecture.
    adjacency : (taxels, taxels) float64, or None
        Normalised propagation matrix of a checkpoint's graph.
    events : (samples, taxels, polarities, steps) uint8
        Recordings.
    labels : (samples,) int64
        Their classes.
    files : tuple of str
        Their names.
    lengths : (samples,) int64, optional
        Steps of each recording where some are shorter than the array.
    original : Checkpoint or Network, optional
        Float model to compare with; by default the weights of `checkpoint` itself.
    sha256 : str, optional
        Of the file that a network was read from; a checkpoint knows its own.
    spec_samples : int
        Recordings on which the specification runs beside the engine.
    engine_name : str
        One of ``ENGINES``; any but the first runs beside ours.
    progress : callable, optional
        Told the name of each part as it starts.

    Raises
    ------
    ModelError, DataError, NumericRangeError
        If the parts do not belong together, or a register of the chip overflows; ModelError also if the format of
        the further engine cannot hold the netlist.
    OptionError
        If the further engine is not installed.
    """
    if not 1 <= spec_samples:
        raise DataError(f"--spec-samples {spec_samples}: at least 1 recording is needed; give a positive number")
    tell = progress or (lambda _part: None)
    model = checkpoint if original is None else original
    require_match(netlist, checkpoint)
    require_match(netlist, model)
    network, integer = _network(model, adjacency), lift(netlist)
    names = [layer.name for layer in netlist.layers]
    flat = with_clocks(events, netlist.clocks)
    check_channels(netlist, flat.shape[1])
    further = onnx_check.prepare(netlist) if engine_name == "onnx" else None

    tell("float32 reference")
    narrow = spikes_of(model, adjacency, events, "float32")
    kept = [heard(netlist, layer) for layer in range(len(names))]
    reference = [cut(spikes, lengths)[..., keep] for spikes, keep in zip(narrow, kept, strict=True)]
    tell("float64 beside it")
    double = spikes_of(model, adjacency, events, "float64")
    wide = [cut(spikes, lengths)[..., keep] for spikes, keep in zip(double, kept, strict=True)]

    tell("chip")
    prepared = engine.prepare(netlist)
    trace = engine.simulate(prepared, flat, lengths=lengths, spikes=True)
    assert trace.spikes is not None, "spikes were asked for"
    chip = [aligned(netlist, trace.spikes, layer)[..., keep] for layer, keep in enumerate(kept)]

    quantised_different = None
    if isinstance(checkpoint, Checkpoint) and checkpoint.forms is not None:
        tell("fine-tuned model")
        tuned = _tuned_spikes(checkpoint, adjacency, events)
        quantised_different = sum(
            int(np.count_nonzero(cut(spikes, lengths)[..., keep] != ours))
            for spikes, keep, ours in zip(tuned, kept, chip, strict=True)
        )

    tell("specification")
    checked = min(spec_samples, len(flat))
    equal, different = _held_to_specification(netlist, prepared, further, checked, flat, lengths, trace.spikes)

    def differences(stage: list[BoolArray] | tuple[BoolArray, ...]) -> dict[str, int]:
        return {name: int(np.count_nonzero(a != b)) for name, a, b in zip(names, reference, stage, strict=True)}

    def compared(stage: tuple[BoolArray, ...]) -> list[BoolArray]:
        return [cut(spikes, lengths)[..., keep] for spikes, keep in zip(stage, kept, strict=True)]

    ladder = [("float64", differences(wide))]
    for rung, stage in _rungs(network, integer, channels_last(events, netlist.clocks), tell):
        ladder.append((rung, differences(chip if stage is None else compared(stage))))
    ladder.append(("saturation", differences(chip)))

    tell("first divergence")
    divergence = first_divergence(
        netlist,
        prepared,
        reference,
        chip,
        wide,
        flat,
        files,
        lambda sample, layer: membranes_of(model, adjacency, events[sample : sample + 1])[layer][0],
    )
    if divergence is not None and (isinstance(model, Network) or model.system not in GRAPH_SYSTEMS):
        divergence = replace(divergence, taxel=None, feature=None)  # its neurons lie otherwise
    float_counts = readout_counts(network.readout, network.classes, reference[network.readout.population])
    chip_counts = class_counts(netlist, trace.counts.spikes)
    compared_neurons = [np.arange(layer.neurons)[keep] for layer, keep in zip(netlist.layers, kept, strict=True)]
    tell("certificate")
    certificate = certify(model, adjacency, integer, events, chip, vote(chip_counts), kept=kept, lengths=lengths)
    return Verdict(
        files=files,
        labels=labels,
        float_predictions=vote(float_counts),
        chip_predictions=vote(chip_counts),
        float_counts=float_counts,
        chip_counts=chip_counts,
        spikes={
            name: LayerSpikes(
                float=int(np.count_nonzero(reference[i])),
                chip=int(np.count_nonzero(chip[i])),
                different=ladder[-1][1][name],
                ill_posed=ladder[0][1][name],
            )
            for i, name in enumerate(names)
        },
        spec_samples=checked,
        spec_equals_engine=equal,
        first_divergence=divergence,
        ladder=tuple(ladder),
        same_checkpoint=_from_this(netlist, checkpoint, sha256),
        quantised_different=quantised_different,
        breakdowns=breakdowns(
            names, reference, chip, compared_neurons, (float_counts, chip_counts), flat, files, lengths
        ),
        not_compared={layer.name: len(layer.unheard) for layer in netlist.layers if layer.unheard},
        certificate=certificate,
        engine=engine_name,
        engine_different=different,
    )
