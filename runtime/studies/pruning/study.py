"""The study: neurons, taxels or hops are taken from a network, and it is measured again."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.storage import Fixed, Given
from spikeloom.compiler.systems import TACTILESGNET
from spikeloom.compiler.targets.compartments import Compilation, Netlist, Options, compile_network
from spikeloom.compiler.types import IntArray
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.inputs.network import LoadedNetwork
from spikeloom.runtime.machines.backends import machine_of
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.studies.pruning import trials
from spikeloom.runtime.studies.pruning.results import Changed, LayerUse, Lean, Removed, Row, TaxelUse
from spikeloom.runtime.studies.search.choice import choose
from spikeloom.runtime.studies.search.measure import decisions, measure_netlist
from spikeloom.runtime.studies.search.results import Costs


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trial:
    """The network without something: what that changes, its netlist, and what it costs on the training split."""

    row: Row
    netlist: Netlist
    training_costs: Costs

    @property
    def values(self) -> dict[str, float]:
        """What it is chosen by; only differences of the accuracy count."""
        return {"energy": self.training_costs.least, "accuracy": -self.row.training.differ}


def study(
    loaded: LoadedNetwork, training: Recordings, test: Recordings, differ: float, output: str | None
) -> tuple[Lean, Netlist, Mapping[str, IntArray]]:
    """Take from a network what the training split does not need: the share `differ` of its decisions may change.

    Hands back the network without what is taken, too, which will be written to `output`, and the numbers of
    the neurons that may go, by layer.
    """
    progress("compiling")
    forms = loaded.network.forms
    storage = Fixed() if forms is None else Given(forms)
    options = Options(storage=storage, training_events=training.events)
    compilation = compile_network(loaded.network, options)
    whole = compilation.netlist
    allowed = int(differ * len(training) + 1e-9)
    spikes: IntArray = machine_of(whole).run(training.events, lengths=training.lengths).counts.sum(axis=0)
    wanted = decisions(whole, training)
    wanted_test = decisions(whole, test)
    alone = trials.changed_alone(whole, training, wanted)

    def fits(netlist: Netlist) -> bool:
        return bool(np.count_nonzero(decisions(netlist, training) != wanted) <= allowed)

    neurons = trials.spared_neurons(whole, spikes, fits)
    taxels = trials.spared_taxels(whole, training, alone, fits)
    tried = []
    for name, removed, netlist in _candidates(loaded, compilation, neurons, taxels):
        progress(f"without {name}")
        trained, training_costs = measure_netlist(netlist, training)
        tested, costs = measure_netlist(netlist, test)
        changed = _changed(wanted, trained, training.labels)
        changed_test = _changed(wanted_test, tested, test.labels)
        row = Row(name=name, removed=removed, training=changed, test=changed_test, costs=costs)
        tried.append(Trial(row=row, netlist=netlist, training_costs=training_costs))
    close = choose(
        tried,
        lambda trial: trial.values,
        lambda best, other: best.values["accuracy"] - other.values["accuracy"] > allowed,
    )
    taken = min(close.allowed, key=lambda trial: trial.training_costs.least)
    lean = Lean(
        taken=tried.index(taken),
        samples={"training": len(training), "test": len(test)},
        layers=_layers(whole, spikes),
        taxels=_taxels(training, alone),
        rows=tuple(trial.row for trial in tried),
        source=test.source,
        split=test.split,
        differ=differ,
        output=output,
    )
    return lean, taken.netlist, _by_layer(whole, neurons)


def _candidates(
    loaded: LoadedNetwork, compilation: Compilation, neurons: IntArray, taxels: IntArray
) -> Iterator[tuple[str, Removed, Netlist]]:
    """The whole network, then without neurons, without taxels and without hops."""
    yield "nothing", Removed(), compilation.netlist
    counts = {name: len(numbers) for name, numbers in _by_layer(compilation.netlist, neurons).items()}
    yield "neurons", Removed(neurons=counts), trials.laid_out(compilation, neurons)
    deaf = trials.without_taxels(compilation, taxels)
    yield "taxels", Removed(taxels=tuple(sorted(taxels.tolist()))), trials.laid_out(deaf)
    for hops in _hops(loaded):
        name = f"hop {hops[0]}" if len(hops) == 1 else f"hops {hops[0]} to {hops[-1]}"
        if (fewer := trials.without_hops(compilation, loaded, hops)) is not None:
            yield name, Removed(hops=hops), trials.laid_out(fewer)


def _layers(netlist: Netlist, spikes: IntArray) -> tuple[LayerUse, ...]:
    """How many neurons of each layer fired in training."""
    uses = []
    for index, layer in enumerate(netlist.layers):
        ids = netlist.compartments_of(index)
        silent = int(np.count_nonzero(spikes[ids] == 0))
        uses.append(LayerUse(name=layer.name, neurons=layer.neurons, on_chip=len(ids), never_fired=silent))
    return tuple(uses)


def _taxels(training: Recordings, alone: IntArray) -> tuple[TaxelUse, ...]:
    """Events of each taxel, and decisions that change without it."""
    events = training.events.sum(axis=(0, 2, 3), dtype=np.int64)
    pairs = zip(events.tolist(), alone.tolist(), strict=True)
    return tuple(TaxelUse(events=sent, training_differ=changed) for sent, changed in pairs)


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
    numbers = {layer.name: gone[netlist.layer[gone] == index] for index, layer in enumerate(netlist.layers)}
    return {name: netlist.neuron[ids] for name, ids in numbers.items() if len(ids)}
