"""The study: neurons, taxels and hops are taken from a network, alone and together, and it is measured again."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from spikeloom.compiler import Compilation, Netlist, Options, compile_network
from spikeloom.compiler.systems import TACTILESGNET
from spikeloom.compiler.types import IntArray
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.inputs.network import LoadedNetwork
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.studies.pruning.results import (
    Changed,
    LayerUse,
    Lean,
    Removed,
    Row,
    TaxelUse,
)
from spikeloom.runtime.studies.pruning.trials import (
    Trial,
    changed_alone,
    decisions,
    priced,
    spikes_of,
    without_hops,
    without_taxels,
)


def study(
    loaded: LoadedNetwork, training: Recordings, test: Recordings, differ: float, output: str | None
) -> tuple[Lean, Netlist]:
    """Take from a network what the training split does not need: the share `differ` of its decisions may change.

    Hands back the network without what is taken, too, which will be written to `output`.
    """
    progress("compiling")
    forms = None if loaded.checkpoint is None else loaded.checkpoint.forms
    compilation = compile_network(loaded.network, Options(forms=forms, training_events=training.events))
    whole = _Whole(loaded, compilation, training, test, int(differ * len(training) + 1e-9))
    left = list(whole.everything())
    kept = [each for each in left if each.offered and each.row.training.differ <= whole.loose.allowed]
    taken = min(kept, key=lambda each: priced(each.netlist, training)[1].least)
    return Lean(
        taken=left.index(taken),
        samples={"training": len(training), "test": len(test)},
        layers=whole.layers(),
        taxels=whole.taxels(),
        rows=tuple(each.row for each in left),
        overflowing=tuple(whole.overflowing),
        source=test.source,
        split=test.split,
        differ=differ,
        output=output,
    ), taken.netlist


@dataclass(frozen=True, slots=True, eq=False)
class _Left:
    """What is left of a network; it may be written if it is offered."""

    row: Row
    netlist: Netlist
    offered: bool


class _Whole:
    """A compiled network on both splits, from which parts are taken."""

    def __init__(
        self, loaded: LoadedNetwork, compilation: Compilation, training: Recordings, test: Recordings, allowed: int
    ) -> None:
        self.loaded, self.compilation, self.netlist = loaded, compilation, compilation.netlist
        self.training, self.test = training, test
        self.spikes = spikes_of(self.netlist, training)
        self.wanted, self.wanted_test = decisions(self.netlist, training), decisions(self.netlist, test)
        self.strict = Trial(
            compilation=compilation, integer=compilation.integer, training=training, wanted=self.wanted, allowed=0
        )
        self.loose = replace(self.strict, allowed=allowed)
        self.trials = (self.strict, self.loose) if allowed else (self.strict,)
        self.overflowing: list[str] = []
        self.changed = changed_alone(self.netlist, training, self.wanted)
        self.changed_test = changed_alone(self.netlist, test, self.wanted_test)

    def everything(self) -> Iterator[_Left]:
        """All that is tried."""
        yield self._left("everything", Removed(), self.netlist)
        progress("neurons")
        yield from self._neurons()
        progress("taxels")
        for trial in self.trials:
            spared = trial.spare_taxels(self.netlist, self.changed)
            deaf = replace(trial, integer=without_taxels(trial.integer, self.netlist, spared)).built()
            yield self._left(f"taxels, {_allowed(trial)}", Removed(taxels=_numbers(spared)), deaf, offered=True)
        cheapest: tuple[float, tuple[int, ...]] = np.inf, ()
        for hops, left in self._hops():
            yield left
            if left.row.training.differ <= self.loose.allowed:
                cheapest = min(cheapest, (left.row.costs.operations, hops))
        progress("all of it together")
        yield self._together(cheapest[1])

    def _left(self, name: str, removed: Removed, netlist: Netlist, *, offered: bool = False) -> _Left:
        """Measure what is left."""
        tested, costs = priced(netlist, self.test)
        row = Row(
            name=name,
            removed=removed,
            training=_changed(self.wanted, decisions(netlist, self.training), self.training.labels),
            test=_changed(self.wanted_test, tested, self.test.labels),
            costs=costs,
        )
        return _Left(row, netlist, offered)

    def _neurons(self) -> Iterator[_Left]:
        netlist = self.netlist
        never = np.flatnonzero((self.spikes == 0) & (netlist.readout_class < 0))
        removed = Removed(neurons=_by_layer(netlist, never))
        yield self._left("neurons that never fired in training", removed, self.strict.built(never, netlist))
        for trial in self.trials:
            spared = trial.spare_neurons(netlist, self.spikes)
            removed = Removed(neurons=_by_layer(netlist, spared))
            yield self._left(f"neurons, {_allowed(trial)}", removed, trial.built(spared, netlist), offered=True)

    def _hops(self) -> Iterator[tuple[tuple[int, ...], _Left]]:
        """Every hop alone and all from one on."""
        checkpoint, adjacency = self.loaded.checkpoint, self.loaded.adjacency
        if checkpoint is None or adjacency is None or checkpoint.system != TACTILESGNET or len(checkpoint.hops) < 2:
            return
        count = len(checkpoint.hops)
        for hops in [(hop,) for hop in range(count)] + [tuple(range(hop, count)) for hop in range(1, count - 1)]:
            progress(f"without hops {', '.join(map(str, hops))}")
            integer = without_hops(self.compilation, checkpoint, adjacency, hops)
            name = f"hop {hops[0]}" if len(hops) == 1 else f"hops {hops[0]} to {hops[-1]}"
            if integer is None:
                self.overflowing.append(name)
            else:
                built = replace(self.strict, integer=integer).built()
                yield hops, self._left(name, Removed(hops=hops), built, offered=True)

    def _together(self, hops: tuple[int, ...]) -> _Left:
        """Hops, then taxels, then neurons, as long as no more training decisions change than may."""
        trial, checkpoint, adjacency = self.loose, self.loaded.checkpoint, self.loaded.adjacency
        if hops and checkpoint is not None and adjacency is not None:
            fewer = without_hops(self.compilation, checkpoint, adjacency, hops)
            assert fewer is not None, "it was tried before"
            trial = replace(trial, integer=fewer)
        built = trial.built()
        taxels = trial.spare_taxels(built, self.changed)
        trial = replace(trial, integer=without_taxels(trial.integer, built, taxels))
        built = trial.built()
        spared = trial.spare_neurons(built, spikes_of(built, self.training))
        removed = Removed(hops=hops or None, taxels=_numbers(taxels), neurons=_by_layer(built, spared))
        return self._left(f"together, {_allowed(trial)}", removed, trial.built(spared, built), offered=True)

    def layers(self) -> tuple[LayerUse, ...]:
        """Neurons of each layer by what they do."""
        held = [self.netlist.compartments_of(index) for index in range(len(self.netlist.layers))]
        return tuple(
            LayerUse(
                name=layer.name,
                neurons=layer.neurons,
                on_chip=len(ids),
                never_fired=int(np.count_nonzero(self.spikes[ids] == 0)),
            )
            for layer, ids in zip(self.netlist.layers, held, strict=True)
        )

    def taxels(self) -> tuple[TaxelUse, ...]:
        """Events of each taxel and what its absence changes."""
        events = self.training.events.sum(axis=(0, 2, 3), dtype=np.int64)
        return tuple(
            TaxelUse(events=count, training_differ=here, test_differ=there)
            for count, here, there in zip(
                events.tolist(), self.changed.tolist(), self.changed_test.tolist(), strict=True
            )
        )


def _changed(whole: IntArray, less: IntArray, labels: IntArray) -> Changed:
    before, after = whole == labels, less == labels
    return Changed(
        differ=int(np.count_nonzero(less != whole)),
        right=int(np.count_nonzero(after)),
        gained=int(np.count_nonzero(~before & after)),
        lost=int(np.count_nonzero(before & ~after)),
    )


def _allowed(trial: Trial) -> str:
    return "no training decision changed" if not trial.allowed else f"{trial.allowed} training decisions may change"


def _numbers(ids: IntArray) -> tuple[int, ...]:
    return tuple(sorted(ids.tolist()))


def _by_layer(netlist: Netlist, gone: IntArray) -> dict[str, int]:
    """How many neurons of each layer."""
    counts = np.bincount(netlist.layer[gone], minlength=len(netlist.layers)).tolist()
    return {layer.name: count for layer, count in zip(netlist.layers, counts, strict=True) if count}
