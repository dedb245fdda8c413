"""How closely the chip's spikes follow the float model, and which deviation costs what.

The reference is the float model in the released operator order, in float32. A float64 run stands beside it: spikes
in which the two differ are ill-posed, decided by the rounding of a sum and not by the chip.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from spikeloom.compiler import Netlist, lift
from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.errors import DataError
from spikeloom.compiler.fixedpoint import FloatArray, IntArray
from spikeloom.compiler.interpret import BoolArray, channels_last, cut, vote
from spikeloom.compiler.ir import Network
from spikeloom.compiler.systems import GRAPH_SYSTEMS
from spikeloom.runtime.equivalence import onnx_check
from spikeloom.runtime.equivalence.breakdowns import breakdowns
from spikeloom.runtime.equivalence.certificates import certify
from spikeloom.runtime.equivalence.divergence import first_divergence
from spikeloom.runtime.equivalence.ladder import rungs
from spikeloom.runtime.equivalence.levels import judged
from spikeloom.runtime.equivalence.reference import (
    float_network,
    membranes_of,
    require_match,
    spikes_of,
    tuned_spikes,
)
from spikeloom.runtime.equivalence.rounding import check_rounding
from spikeloom.runtime.equivalence.verdict import LayerSpikes, Rung, Verdict
from spikeloom.runtime.machines.loihi1 import engine, spec
from spikeloom.runtime.machines.loihi1.trace import ENGINES, Trace, aligned, check_channels, comparable
from spikeloom.runtime.machines.votes import class_counts, readout_counts


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


def _compiled_from(netlist: Netlist, checkpoint: Checkpoint | Network, sha256: str | None) -> bool:
    """Whether a netlist says that it was compiled from this file, and this epoch."""
    made = netlist.provenance
    if isinstance(checkpoint, Network):
        return made.get("checkpoint_sha256") == sha256
    return made.get("checkpoint_sha256") == checkpoint.sha256 and made.get("weights") == checkpoint.weights


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
    required: Mapping[str, float] | None = None,
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
    required : mapping of level to share, optional
        What has to be reached, see :func:`levels.parse_requirements`; the weights always have to be the checkpoint's.
    progress : callable, optional
        Called with the name of each part as it starts.

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
    begin = progress or (lambda _part: None)
    model = checkpoint if original is None else original
    require_match(netlist, checkpoint)
    require_match(netlist, model)
    network, integer = float_network(model, adjacency), lift(netlist)
    names = [layer.name for layer in netlist.layers]
    flat = with_clocks(events, netlist.clocks)
    check_channels(netlist, flat.shape[1])
    further = onnx_check.prepare(netlist) if engine_name == "onnx" else None
    tuned = isinstance(checkpoint, Checkpoint) and checkpoint.forms is not None
    weights = check_rounding(
        netlist,
        network if original is None else float_network(checkpoint, adjacency),
        integer,
        fine_tuned=tuned,
    )

    kept = [comparable(netlist, layer) for layer in range(len(names))]

    def compared(layers: Sequence[BoolArray]) -> list[BoolArray]:
        return [cut(spikes, lengths)[..., keep] for spikes, keep in zip(layers, kept, strict=True)]

    begin("float32 reference")
    reference = compared(spikes_of(model, adjacency, events, "float32"))
    begin("float64 beside it")
    wide = compared(spikes_of(model, adjacency, events, "float64"))

    begin("chip")
    prepared = engine.prepare(netlist)
    trace = engine.simulate(prepared, flat, lengths=lengths, spikes=True)
    assert trace.spikes is not None, "spikes were wanted"
    chip = [aligned(netlist, trace.spikes, layer)[..., keep] for layer, keep in enumerate(kept)]

    quantised_different = None
    if isinstance(checkpoint, Checkpoint) and tuned:
        begin("fine-tuned model")
        pairs = zip(compared(tuned_spikes(checkpoint, adjacency, events)), chip, strict=True)
        quantised_different = sum(int(np.count_nonzero(a != b)) for a, b in pairs)

    begin("specification")
    checked = min(spec_samples, len(flat))
    equal, different = _held_to_specification(netlist, prepared, further, checked, flat, lengths, trace.spikes)

    def rung(stage: str, spikes: list[BoolArray]) -> Rung:
        differ = {name: int(np.count_nonzero(a != b)) for name, a, b in zip(names, reference, spikes, strict=True)}
        return Rung(stage=stage, different=differ)

    ladder = [rung("float64", wide)]
    for stage, spikes in rungs(network, integer, channels_last(events, netlist.clocks), begin):
        ladder.append(rung(stage, chip if spikes is None else compared(spikes)))
    ladder.append(rung("saturation", chip))

    begin("first divergence")
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
    neurons = [np.arange(layer.neurons)[keep] for layer, keep in zip(netlist.layers, kept, strict=True)]
    begin("certificate")
    certificate = certify(model, adjacency, integer, events, chip, vote(chip_counts), kept=kept, lengths=lengths)
    verdict = Verdict(
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
                different=ladder[-1].different[name],
                ill_posed=ladder[0].different[name],
            )
            for i, name in enumerate(names)
        },
        spec_samples=checked,
        spec_equals_engine=equal,
        weights=weights,
        first_divergence=divergence,
        ladder=tuple(ladder),
        same_checkpoint=_compiled_from(netlist, checkpoint, sha256),
        quantised_different=quantised_different,
        breakdowns=breakdowns(names, reference, chip, neurons, (float_counts, chip_counts), flat, files, lengths),
        not_compared={layer.name: len(layer.unheard) for layer in netlist.layers if layer.unheard},
        certificate=certificate,
        engine=engine_name,
        engine_different=different,
    )
    return judged(verdict, {} if required is None else required)
