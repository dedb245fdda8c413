"""The study: neurons, taxels or hops are taken from a network, and it is measured again."""

from collections.abc import Iterator, Mapping

import numpy as np

from spikeloom.compiler.storage import Fixed, Given
from spikeloom.compiler.systems import TACTILESGNET
from spikeloom.compiler.targets.compartments import Netlist, Options, compile_network
from spikeloom.compiler.types import IntArray
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.inputs.network import LoadedNetwork
from spikeloom.runtime.machines.backends import machine_of
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.studies.pruning import trials
from spikeloom.runtime.studies.pruning.results import Changed, LayerUse, Lean, Removed, Row, TaxelUse


def study(
    loaded: LoadedNetwork, training: Recordings, test: Recordings, differ: float, output: str | None
) -> tuple[Lean, Netlist, Mapping[str, IntArray]]:
    """Take from a network what the training split does not need: the share `differ` of its decisions may change.

    Hands back the network without what is taken, too, which will be written to `output`, and the numbers of the neurons
    that may go, by layer.
    """
    progress("compiling")
    forms = loaded.network.forms
    storage = Fixed() if forms is None else Given(forms)
    options = Options(storage=storage, training_events=training.events)
    compilation = compile_network(loaded.network, options)
    whole = compilation.netlist
    allowed = int(differ * len(training) + 1e-9)
    spikes: IntArray = machine_of(whole).run(training.events, lengths=training.lengths).counts.sum(axis=0)
    wanted = trials.decisions(whole, training)
    wanted_test = trials.decisions(whole, test)
    alone = trials.changed_alone(whole, training, wanted)

    def fits(netlist: Netlist) -> bool:
        return bool(np.count_nonzero(trials.decisions(netlist, training) != wanted) <= allowed)

    def tried() -> Iterator[tuple[str, Removed, Netlist]]:
        yield "nothing", Removed(), whole
        neurons = trials.spared_neurons(whole, spikes, fits)
        spared.update(_by_layer(whole, neurons))
        counts = {name: len(numbers) for name, numbers in spared.items()}
        yield "neurons", Removed(neurons=counts), trials.laid_out(compilation, neurons)
        taxels = trials.spared_taxels(whole, training, alone, fits)
        deaf = trials.without_taxels(compilation, taxels)
        yield "taxels", Removed(taxels=tuple(sorted(taxels.tolist()))), trials.laid_out(deaf)
        for hops in _hops(loaded):
            name = f"hop {hops[0]}" if len(hops) == 1 else f"hops {hops[0]} to {hops[-1]}"
            if (fewer := trials.without_hops(compilation, loaded, hops)) is not None:
                yield name, Removed(hops=hops), trials.laid_out(fewer)

    rows = []
    spent = []
    netlists = []
    spared = dict[str, IntArray]()
    for name, removed, netlist in tried():
        progress(f"without {name}")
        trained, training_costs = trials.priced(netlist, training)
        tested, costs = trials.priced(netlist, test)
        changed = _changed(wanted, trained, training.labels)
        changed_test = _changed(wanted_test, tested, test.labels)
        rows.append(Row(name=name, removed=removed, training=changed, test=changed_test, costs=costs))
        spent.append(training_costs.least if changed.differ <= allowed else np.inf)
        netlists.append(netlist)
    taken = int(np.argmin(spent))
    events = training.events.sum(axis=(0, 2, 3), dtype=np.int64)
    return (
        Lean(
            taken=taken,
            samples={"training": len(training), "test": len(test)},
            layers=tuple(
                LayerUse(
                    name=layer.name,
                    neurons=layer.neurons,
                    on_chip=len(ids),
                    never_fired=int(np.count_nonzero(spikes[ids] == 0)),
                )
                for layer, ids in zip(whole.layers, map(whole.compartments_of, range(len(whole.layers))), strict=True)
            ),
            taxels=tuple(
                TaxelUse(events=sent, training_differ=differing)
                for sent, differing in zip(events.tolist(), alone.tolist(), strict=True)
            ),
            rows=tuple(rows),
            source=test.source,
            split=test.split,
            differ=differ,
            output=output,
        ),
        netlists[taken],
        spared,
    )


def _hops(loaded: LoadedNetwork) -> list[tuple[int, ...]]:
    """Every hop alone and all from one on, of a network that has several."""
    checkpoint = loaded.checkpoint
    if checkpoint is None or checkpoint.system != TACTILESGNET or len(checkpoint.hops) < 2:
        return []
    every = tuple(range(len(checkpoint.hops)))
    return [*((hop,) for hop in every), *(every[first:] for first in every[1:-1])]


def _changed(whole: IntArray, less: IntArray, labels: IntArray) -> Changed:
    before = whole == labels
    after = less == labels
    return Changed(
        differ=int(np.count_nonzero(less != whole)),
        right=int(np.count_nonzero(after)),
        gained=int(np.count_nonzero(~before & after)),
        lost=int(np.count_nonzero(before & ~after)),
    )


def _by_layer(netlist: Netlist, gone: IntArray) -> dict[str, IntArray]:
    """Numbers of these neurons in each layer that has any."""
    held = {layer.name: gone[netlist.layer[gone] == index] for index, layer in enumerate(netlist.layers)}
    return {name: netlist.neuron[ids] for name, ids in held.items() if len(ids)}
