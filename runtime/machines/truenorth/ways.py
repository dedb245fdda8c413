"""Ways out of what crossbar cores do not have: what each costs in cores and ticks, and in decisions.

Ways that need no training are tried on the float network, each alone, in the layer that needs it; ways that lead spikes
elsewhere change none and cost cores. Ways that need training have the figures of a shipped network that was trained so,
and where there is none the command alone: what it would reach is not known before.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from spikeloom.compiler.errors import CapacityError, ModelError
from spikeloom.compiler.formats.checkpoint import Checkpoint
from spikeloom.compiler.ir import INPUT, Network, Sparse
from spikeloom.compiler.passes.expand import expand_first_layer, expand_graph_convolution
from spikeloom.compiler.systems import GRAPH_SYSTEMS, TACTILESGNET
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.truenorth.codebook import (
    BIN_TICKS,
    COPIES,
    MOST,
    MOST_COPIES,
    Levels,
    codebook,
    in_levels,
)
from spikeloom.compiler.targets.truenorth.core_counts import Split, packed, relays, split
from spikeloom.compiler.targets.truenorth.in_time import lower_in_time
from spikeloom.compiler.targets.truenorth.needs import CURRENT, FAN_IN, LEAK, TARGETS, WEIGHTS, Need, targets_of
from spikeloom.models.graphs import NEUTOUCH, build_graph, normalised_adjacency
from spikeloom.runtime.inputs.network import LoadedNetwork
from spikeloom.runtime.machines.truenorth.retrained import Shipped, accuracy_on
from spikeloom.runtime.machines.truenorth.trials import Change, Trial

TERNARY = 2
"""Axons of an input that weights of -1, 0 and 1 steps take."""

SPARSEST = "mst:0"
"""Graph of the built-in sensor with the fewest edges, a tree."""

FEWER_HOPS = 2
"""Hops of a graph convolution that are left, as trained."""


RETRAINED = "after retraining"


@dataclass(frozen=True, slots=True, kw_only=True)
class Way:
    """A way out.

    Parameters
    ----------
    name : str
    accuracy : float or None
        Share of the calibration recordings that are decided rightly; None where nothing was measured.
    exact : bool
        Whether no spike changes.
    cores : int or None
        Of the layer, with what leads to it; None where it does not fit.
    bin_ticks : int
        Ticks of a data step.
    more_ticks : int
        Ticks that every decision takes more.
    command : str or None
        What trains it.
    shipped : str or None
        Network that was trained so, whose figures these are: on test recordings, cores of the whole network unless
        the way is of a layer.
    note : str
        What else was found.
    """

    name: str
    accuracy: float | None = None
    exact: bool = False
    cores: int | None = None
    bin_ticks: int = 1
    more_ticks: int = 0
    command: str | None = None
    shipped: str | None = None
    note: str = ""


class Planner:
    """Finds and prices the ways out of the needs of a network.

    What needs training has the figures of shipped networks; where nothing of the kind is shipped, none.

    Parameters
    ----------
    asked : LoadedNetwork
        The network, and the checkpoint that it is from.
    chip : Target
    trial : Trial or None
        On calibration recordings, where there are some.
    path : str
        Of the checkpoint as it was typed.
    retrained : sequence of Shipped
        Networks for the same sensor and classes, the smallest first.
    """

    def __init__(
        self, asked: LoadedNetwork, chip: Target, trial: Trial | None, path: str, retrained: Sequence[Shipped] = ()
    ) -> None:
        self.network: Network = asked.network
        self.asked = asked
        self.chip = chip
        self.trial = trial
        self.path = path
        self.retrained = retrained
        self.books: dict[tuple[int, int], Levels] = {}
        self.in_time: dict[tuple[int, int], tuple[float | None, str]] = {}

    def ways(self, need: Need) -> list[Way]:
        """Ways out of a need, at least two."""
        finders = {
            LEAK: self._leak,
            CURRENT: self._current,
            FAN_IN: self._fan_in,
            WEIGHTS: self._weights,
            TARGETS: self._targets,
        }
        return list(finders[need.kind](need.layer))

    # -- sizes ---------------------------------------------------------------------------------------------------------

    def weight(self, layer: int) -> Sparse:
        """Weights of the first projection onto a layer."""
        return next(p.weight for p in self.network.projections if p.post == layer)

    def layer_cores(self, layer: int, copies: int, weight: Sparse | None = None) -> tuple[int | None, Split | None]:
        """Cores of a layer with so many axons an input: packed where it fits, else split in time."""
        weight = self.weight(layer) if weight is None else weight
        fit = packed(weight, copies, self.chip)
        if fit is not None:
            return fit, None
        parts = split(weight.shape[1], weight.shape[0], copies, self.chip)
        return (None if parts is None else parts.cores), parts

    def _hears_inputs(self, layer: int) -> bool:
        return all(p.pre == INPUT for p in self.network.projections if p.post == layer)

    # -- ways ----------------------------------------------------------------------------------------------------------

    def _measured(self, layer: int, change: Change) -> float | None:
        return None if self.trial is None else self.trial.accuracy({layer: change})

    def _book(self, layer: int, copies: int) -> Levels:
        if (layer, copies) not in self.books:
            self.books[layer, copies] = codebook(self.weight(layer).toarray(), copies)
        return self.books[layer, copies]

    def _leak(self, layer: int) -> Iterator[Way]:
        cores, parts = self.layer_cores(layer, TERNARY)
        ticks = 1 if parts is None else BIN_TICKS
        yield Way(
            name="history-free as it is: the membrane forgets within a step",
            accuracy=self._measured(layer, Change(beta=0.0)),
            cores=cores,
            bin_ticks=ticks,
        )
        chosen = None if self.trial is None else self.trial.leak_for(layer)
        theta = self.network.populations[layer].theta
        yield Way(
            name="a constant leak toward zero",
            accuracy=None if chosen is None else self._measured(layer, Change(leak=chosen)),
            cores=cores,
            bin_ticks=ticks,
            note="" if chosen is None else f"leak {chosen / theta:.1f} θ a step",
        )
        echoed, echo_parts = self.layer_cores(layer, 3 * TERNARY)
        yield Way(
            name="history-free, each input again after one and two steps",
            accuracy=self._measured(layer, Change(echoes=True)),
            cores=echoed,
            bin_ticks=1 if echo_parts is None else BIN_TICKS,
        )
        yield from self._shipped("trained with a leak that is added")
        yield self._retrained("trained history-free", self._no_decay("--membrane-decay"), cores, ticks)

    def _current(self, layer: int) -> Iterator[Way]:
        cores, parts = self.layer_cores(layer, TERNARY)
        ticks = 1 if parts is None else BIN_TICKS
        accuracy = self._measured(layer, Change(alpha=0.0))
        yield Way(name="without the current, as it is", accuracy=accuracy, cores=cores, bin_ticks=ticks)
        yield from self._shipped("trained without currents, with a leak that is added")
        yield self._retrained("trained without lasting currents", self._train(), cores, ticks)

    def _fan_in(self, layer: int) -> Iterator[Way]:
        inputs, neurons = self.weight(layer).shape[1], self.network.populations[layer].size
        for copies in range(TERNARY, MOST_COPIES + 1):
            parts = split(inputs, neurons, copies, self.chip)
            if parts is not None:
                yield self._in_time(layer, copies, parts)
        yield from self._shipped("trained in groups of {inputs} inputs")
        before = {p.pre for p in self.network.projections if p.post == layer}
        checkpoint = self.asked.checkpoint
        if before == {0} and checkpoint is not None:
            most = self.chip.limit("core.axons") // TERNARY // checkpoint.places
            if most:
                options = f"--features {most}"
                heard = checkpoint.places * most
                cores = packed(_full(heard, neurons), TERNARY, self.chip)
                yield self._retrained(f"trained with {most} features, {heard} inputs", self._train(options), cores, 1)

    def _in_time(self, layer: int, copies: int, parts: Split) -> Way:
        if (layer, copies) not in self.in_time:
            change = Change(levels=self._book(layer, copies), inputs=parts.inputs, most=MOST)
            accuracy = self._measured(layer, change)
            note = "" if self.trial is None else f"{100 * self.trial.saturated:.2g} % of the partial sums saturate"
            self.in_time[layer, copies] = accuracy, note
        accuracy, note = self.in_time[layer, copies]
        return Way(
            name=f"split in time: {parts.groups} groups of {parts.inputs}, {copies} axons an input",
            accuracy=accuracy,
            cores=parts.cores,
            bin_ticks=BIN_TICKS,
            more_ticks=BIN_TICKS,
            note=note,
        )

    def _weights(self, layer: int) -> Iterator[Way]:
        for copies in COPIES:
            cores, parts = self.layer_cores(layer, copies)
            if parts is not None and copies <= MOST_COPIES:
                yield self._in_time(layer, copies, parts)
            elif parts is None and cores is not None:
                named = "-1, 0, 1" if copies == TERNARY else f"{2**copies} levels"
                yield Way(
                    name=f"{copies} axons an input, {named} times a step for each neuron",
                    accuracy=self._measured(layer, Change(levels=self._book(layer, copies))),
                    cores=cores,
                )
        yield from self._shipped("trained in {levels} levels")
        checkpoint = self.asked.checkpoint
        if layer == 0 and checkpoint is not None and checkpoint.system == TACTILESGNET:
            yield from self._fewer_hops(checkpoint)
            yield from self._fewer_neighbours(checkpoint)
        cores, parts = self.layer_cores(layer, TERNARY)
        graph = f" --graph {self.asked.graph}" if checkpoint is not None and checkpoint.edges is None else ""
        command = f"spikeloom finetune {self.path}{graph} --data DATA --weight-bits 2 -o OUT.pt"
        ticks = 1 if parts is None else BIN_TICKS
        if checkpoint is not None:
            yield self._retrained("fine-tuned to -1, 0, 1 times a step", command, cores, ticks)

    def _fewer_hops(self, checkpoint: Checkpoint) -> Iterator[Way]:
        if len(checkpoint.hops) <= FEWER_HOPS or self.asked.adjacency is None:
            return
        short = replace(checkpoint, hops=checkpoint.hops[:FEWER_HOPS])
        weight, _ = expand_first_layer(short, self.asked.adjacency)
        if weight.shape != self.weight(0).shape:  # clocks are relayed by neurons of the layer
            return
        copies = max((m for m in COPIES if packed(weight, m, self.chip) is not None), default=TERNARY)
        cores, _ = self.layer_cores(0, copies, weight)
        book = codebook(weight.toarray(), copies)
        yield Way(
            name=f"the first {FEWER_HOPS} of {len(checkpoint.hops)} hops as they are, {copies} axons an input",
            accuracy=self._measured(0, Change(levels=book)),
            cores=cores,
        )

    def _fewer_neighbours(self, checkpoint: Checkpoint) -> Iterator[Way]:
        if checkpoint.taxels != len(NEUTOUCH) or self.asked.graph in (None, SPARSEST):
            return
        edges = build_graph(SPARSEST).edges
        weight = expand_graph_convolution(
            normalised_adjacency(edges, checkpoint.taxels), checkpoint.hops.astype(np.float64)
        )
        copies = max((m for m in COPIES if packed(weight, m, self.chip) is not None), default=TERNARY)
        cores, _ = self.layer_cores(0, copies, weight)
        name = f"trained on the sparsest graph, {copies} axons an input"
        known = accuracy_on(SPARSEST, self.retrained[0]) if self.retrained else None
        if known is None:
            yield self._retrained(name, self._train(graph=SPARSEST), cores, 1)
        else:
            shipped, accuracy, command = known
            yield Way(name=name, accuracy=accuracy, cores=cores, command=command, shipped=shipped, note=RETRAINED)

    def _targets(self, layer: int) -> Iterator[Way]:
        targets, size = targets_of(self.network, layer, self.chip), self.network.populations[layer].size
        accuracy = None if self.trial is None else self.trial.accuracy({})
        yield Way(
            name=f"{targets} relays for each neuron",
            accuracy=accuracy,
            exact=True,
            cores=relays(size, targets, self.chip),
            more_ticks=1,
        )
        cores, parts = self.layer_cores(layer, TERNARY)
        ticks = 1 if parts is None else BIN_TICKS
        note = "" if self._hears_inputs(layer) else "and as many more targets for the layer before"
        copied = None if cores is None else cores * targets
        yield Way(
            name=f"{targets} copies of each neuron",
            accuracy=accuracy,
            exact=True,
            cores=copied,
            bin_ticks=ticks,
            note=note,
        )

    # -- all of it -----------------------------------------------------------------------------------------------------

    def together(self, copies: int) -> Way:
        """All of it without training, as ``compile --in-time`` does it: history-free, weights in levels."""
        forgetful = tuple(replace(population, beta=0.0, alpha=0.0) for population in self.network.populations)
        name = f"history-free, {copies} axons an input, sums in time"
        try:
            levels = in_levels(replace(self.network, populations=forgetful), copies, self.chip)
            netlist = lower_in_time(levels, self.chip)
        except (CapacityError, ModelError):
            return Way(name=f"{name}: does not fit")
        return Way(
            name=name,
            accuracy=None if self.trial is None else self.trial.accuracy_of(levels),
            cores=netlist.n_cores,
            bin_ticks=netlist.bin_ticks,
            more_ticks=netlist.drain - len(forgetful) + 1,
        )

    # -- commands ------------------------------------------------------------------------------------------------------

    def _retrained(self, name: str, command: str | None, cores: int | None, bin_ticks: int) -> Way:
        return Way(name=name, cores=cores, bin_ticks=bin_ticks, command=command, note=RETRAINED)

    def _shipped(self, name: str) -> Iterator[Way]:
        """The smallest shipped network that was trained for the chip, if there is one for this sensor."""
        for like in self.retrained[:1]:
            yield self.retrained_way(name.format(inputs=like.inputs, levels=like.levels), like)

    def retrained_way(self, name: str, like: Shipped) -> Way:
        """A shipped network as a way out, by a name."""
        return Way(
            name=name,
            accuracy=like.accuracy,
            cores=like.cores,
            more_ticks=like.depth - len(self.network.populations) + 1,
            command=like.commands[0],
            shipped=like.name,
            note=RETRAINED,
        )

    def _no_decay(self, option: str) -> str:
        return self._train(f"{option} {','.join(f'{p.name}=0' for p in self.network.populations)}")

    def _train(self, options: str = "", *, graph: str | None = None) -> str:
        """Command that trains a network of this kind anew."""
        checkpoint, words = self.asked.checkpoint, ["spikeloom train --data DATA"]
        if checkpoint is not None and checkpoint.system != TACTILESGNET:
            words.append(f"--system {checkpoint.system}")
        if self.asked.graph and (checkpoint is None or checkpoint.system in GRAPH_SYSTEMS):
            words.append(f"--graph {graph or self.asked.graph}")
        words += [f"--join {self.network.input.bins}"] if self.network.input.bins > 1 else []
        return " ".join([*words, *([options] if options else []), "-o OUT.pt"])


def _full(inputs: int, neurons: int) -> Sparse:
    from scipy import sparse

    return sparse.csr_array(np.ones((neurons, inputs)))
