"""How closely the chip's spikes follow the float model, and which deviation costs what.

The reference is the float model in the released operator order, in float32. A float64 run stands beside it: spikes
in which the two differ are ill-posed, decided by the rounding of a sum and not by the chip.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from spikeloom.compiler import Netlist
from spikeloom.compiler.errors import DataError
from spikeloom.compiler.fixedpoint import MEMBRANE_SHIFT
from spikeloom.compiler.interpret import channels_last, cut, vote
from spikeloom.compiler.ir import Network
from spikeloom.compiler.passes.expand import Factored
from spikeloom.compiler.types import BoolArray, EventArray, IntArray
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.equivalence.breakdowns import breakdowns
from spikeloom.runtime.equivalence.certificates import Certifier
from spikeloom.runtime.equivalence.reference import (
    LADDER,
    float_network,
    membranes_of,
    reference_of,
    require_match,
    rungs,
    taxel_and_feature,
)
from spikeloom.runtime.equivalence.rounding import Rounding, check_rounding
from spikeloom.runtime.equivalence.verdict import Divergence, LayerSpikes, Rung, Verdict
from spikeloom.runtime.machines.backends import machine_of
from spikeloom.runtime.machines.base import ENGINES
from spikeloom.runtime.machines.integer import IntegerMachine, integer_machine
from spikeloom.runtime.machines.votes import readout_counts

Layers = Sequence[BoolArray]
"""Spikes of each layer, (samples, steps, compared neurons)."""


def verify(
    netlist: Netlist,
    source: Factored | Network,
    data: Recordings,
    *,
    original: Factored | Network | None = None,
    spec_samples: int = 3,
    engine_name: str = ENGINES[0],
    required: Mapping[str, float] | None = None,
    rounding: Rounding | None = None,
    progress: Callable[[str, int], None] | None = None,
) -> Verdict:
    """Compare float model, chip and specification.

    The `source` is what the netlist was compiled from, a checkpoint on its graph or a network, or another of the same
    architecture; the float model to compare with is the `original`, by default the same. The specification runs beside
    the engine on so many samples, one of ``ENGINES`` on all. `required` shares of levels have to be reached, see
    :mod:`equivalence.verdict`, EN always; `rounding` is what is known of that. `progress` is called with the name of
    each part as it starts, and the number of recordings that are done.

    Raises ModelError, DataError, NumericRangeError or OptionError if the parts do not belong together, a register of
    the chip overflows, or the further engine is not installed or cannot hold the netlist.
    """
    if not 1 <= spec_samples:
        raise DataError(f"--spec-samples {spec_samples}: at least 1 recording is needed; give a positive number")
    begin, events, lengths = progress or (lambda _part, _done: None), data.events, data.lengths
    model = source if original is None else original
    require_match(netlist, source)
    require_match(netlist, model)
    machine = integer_machine(machine_of(netlist))
    network, integer, names = float_network(model), machine.integer, machine.layers
    machine.require_sensor(events)
    beside = machine.beside(engine_name)
    origin = network if original is None else float_network(source)
    tuned = origin.forms is not None
    kept, checked = machine.compared(), min(spec_samples, len(events))
    begin("specification", 0)
    equal = machine.check(events[:checked], lengths=lengths) == 0
    engine_different = None if beside is None else beside(events, lengths)
    reference_spikes, ladder = reference_of(model), rungs(network, integer, windows=not machine.free_running)
    fine_tuned_spikes = _fine_tuned(source) if tuned else None
    certifier = Certifier(model, integer, kept)
    neurons = [np.arange(each.size)[keep] for each, keep in zip(integer.populations, kept, strict=True)]
    fired = [np.zeros((2, len(each)), np.int64) for each in neurons]  # spikes of float model and chip
    different = {stage: np.zeros(len(names), np.int64) for stage in LADDER}
    float_votes, chip_votes = np.zeros((2, len(events), network.classes), np.int64)
    quantised_different, divergence = 0 if tuned else None, None
    for rows in machine.parts(len(events), events.shape[3]):
        first = rows.start
        part, ends = events[rows], None if lengths is None else lengths[rows]
        channels = channels_last(part, netlist.clocks)

        def compared(layers: Sequence[BoolArray], ends: IntArray | None = ends) -> list[BoolArray]:
            return [cut(spikes, ends)[..., keep] for spikes, keep in zip(layers, kept, strict=True)]

        begin("float32 reference", first)
        reference = compared(reference_spikes(part))
        begin("chip", first)
        ran = machine.run(part, lengths=ends, spikes=True)
        chip = [ran.spikes[name][..., keep] for name, keep in zip(names, kept, strict=True)]
        if fine_tuned_spikes is not None and quantised_different is not None:
            begin("fine-tuned model", first)
            quantised_different += int(_differences(compared(fine_tuned_spikes(part)), chip).sum())

        different[LADDER[-1]] += _differences(reference, chip)
        for total, *sides in zip(fired, reference, chip, strict=True):
            total += [side.sum(axis=(0, 1)) for side in sides]
        for stage, ready in ladder.items():
            begin(f"ladder: {'proven' if ready is None else stage}", first)
            lower = chip if ready is None else compared(ready.run(channels).spikes)
            different[stage] += _differences(reference, lower)
            if stage == LADDER[0] and divergence is None:
                begin("first divergence", first)
                divergence = _first_divergence(machine, model, reference, chip, lower, part, data.files[rows])
        float_votes[rows] = readout_counts(network.readout, network.classes, reference[network.readout.population])
        chip_votes[rows] = ran.votes
        begin("certificate", first)
        certifier.add(part, chip, ran.decisions, ends)

    return Verdict(
        files=data.files,
        labels=data.labels,
        float_predictions=vote(float_votes),
        chip_predictions=vote(chip_votes),
        float_counts=float_votes,
        chip_counts=chip_votes,
        spikes={
            name: LayerSpikes(float=int(ours.sum()), chip=int(theirs.sum()), different=int(moved), ill_posed=int(posed))
            for name, (ours, theirs), moved, posed in zip(
                names, fired, different[LADDER[-1]], different[LADDER[0]], strict=True
            )
        },
        spec_samples=checked,
        spec_equals_engine=equal and not engine_different,
        row_different=int(np.sum(vote(machine.in_a_row(events, lengths)) != vote(chip_votes)))
        if machine.free_running
        else None,
        weights=rounding or check_rounding(machine, origin, fine_tuned=tuned),
        first_divergence=divergence,
        ladder=tuple(
            Rung(
                stage="free_running" if machine.free_running and stage == LADDER[-1] else stage,
                different=dict(zip(names, counts.tolist(), strict=True)),
            )
            for stage, counts in different.items()
        ),
        quantised_different=quantised_different,
        breakdowns=breakdowns(
            names,
            [ours for ours, _ in fired],
            [theirs for _, theirs in fired],
            neurons,
            (float_votes, chip_votes),
            data.files,
        ),
        not_compared={name: int(out.sum()) for name, out in zip(names, machine.unread, strict=True) if out.any()},
        certificate=certifier.certificate(),
        engine=engine_name,
        engine_different=engine_different,
        required={} if required is None else required,
    )


def _fine_tuned(source: Factored | Network) -> Callable[[EventArray], list[BoolArray]]:
    """What gives the spikes of each layer of a fine-tuned network's torch model."""
    from spikeloom.models.networks.quantised import quantised_spikes  # torch, so only here

    return lambda events: list(quantised_spikes(source, events).values())


def _differences(ours: Layers, theirs: Layers) -> IntArray:
    """Entries of each layer that differ."""
    return np.array([np.count_nonzero(a != b) for a, b in zip(ours, theirs, strict=True)], np.int64)


def _first_divergence(
    machine: IntegerMachine,
    model: Factored | Network,
    reference: list[BoolArray],
    chip: list[BoolArray],
    wide: list[BoolArray],
    events: EventArray,
    files: tuple[str, ...],
) -> Divergence | None:
    """First entry in which spikes of the float32 model and the chip differ."""
    differs = [(a != b) for a, b in zip(reference, chip, strict=True)]
    broken = np.any([d.any(axis=(1, 2)) for d in differs], axis=0)
    if not broken.any():
        return None
    sample = int(np.argmax(broken))
    step, index, neuron = min(
        (int(step), layer, int(neuron))
        for layer, d in enumerate(differs)
        for step, neuron in np.argwhere(d[sample])[:1]
    )
    layer = machine.integer.populations[index]
    ill_posed = bool(wide[index][sample, step, neuron] != reference[index][sample, step, neuron])
    neuron = int(np.arange(layer.size)[machine.compared()[index]][neuron])
    recording = events[sample : sample + 1, ..., : step + 1]
    register = int(machine.run(recording, membranes=True).membranes[layer.name][0, step, neuron])
    held = not machine.absent[index][neuron]  # a neuron that the chip leaves out stays at zero
    scale = float(layer.scale[neuron])
    taxel, feature = taxel_and_feature(model, index, neuron)
    return Divergence(
        file=files[sample],
        step=step,
        layer=layer.name,
        neuron=neuron,
        taxel=taxel,
        feature=feature,
        float_membrane=float(membranes_of(model, recording)[index][0, step, neuron]),
        chip_membrane=register / (scale * (1 << MEMBRANE_SHIFT)),
        chip_register=register,
        theta=layer.theta,
        chip_theta=int(layer.threshold[neuron]) / scale if held else layer.theta,
        ill_posed=ill_posed,
    )
