"""Whether the float model decides as the chip does, whichever events change: both are proven to keep one decision."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from spikeloom.compiler.ir import Network
from spikeloom.compiler.targets.netlist_file import Netlist
from spikeloom.compiler.types import EventArray, IntArray
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.machines.changes import Groups, Past, by_running, single
from spikeloom.runtime.studies.robustness.proofs.bounds import PASTS, REACH, lower_bound, needed
from spikeloom.runtime.studies.robustness.proofs.entries import Cells, cells_of, channels_of
from spikeloom.runtime.studies.robustness.results import Certificates, FloatModel
from spikeloom.runtime.studies.robustness.threads import in_threads

if TYPE_CHECKING:
    from spikeloom.runtime.machines.bounds.floats import FloatNetwork


def prepared(network: Network, netlist: Netlist, data: Recordings) -> FloatNetwork:
    """The float network that a netlist was made of, ready for these recordings.

    Raises OptionError for a network that has no bounds: see :func:`floats.laid_out`.
    """
    from spikeloom.runtime.machines.bounds.floats import laid_out

    return laid_out(network, max(int(data.step_counts.max()), netlist.clocks.length or 0))


def beside(
    certificates: Certificates,
    network: FloatNetwork,
    netlist: Netlist,
    data: Recordings,
    *,
    jobs: int | None,
) -> Certificates:
    """Certificates of these recordings with what is proven of the float network."""
    lengths = data.step_counts.tolist()
    recordings = [events[..., :length] for events, length in zip(data.events, lengths, strict=True)]
    prove = partial(verdict, network, netlist, certificates.most)
    models = in_threads(prove, recordings, "proving the float model", jobs)
    both = zip(certificates.certificates, models, strict=True)
    return replace(certificates, certificates=tuple(replace(one, model=model) for one, model in both))


def verdict(network: FloatNetwork, netlist: Netlist, most: int, events: EventArray) -> FloatModel:
    """What is proven of one recording (taxels, polarities, bins), for up to `most` changed events."""
    channels = channels_of(events[None], netlist)[0]
    cells = cells_of(events, netlist)
    shape = netlist.taxels * netlist.polarities, int(cells.cells[-1, 1]) + 1, netlist.classes
    votes, groups = network.groups(channels, shape, REACH)
    at_least = lower_bound(votes, groups, PASTS if most > 1 else PASTS[:1], most).events
    if not at_least:
        at_least = int(_bears_one(network, channels, cells, votes, groups))
    return FloatModel(decision=int(votes.argmax()), at_least=at_least)


def _bears_one(
    network: FloatNetwork, channels: EventArray, cells: Cells, votes: IntArray, groups: Groups
) -> bool:
    """Whether no single event alters a decision: where bounds beside the known run leave it open, each is run."""
    decision, gaps = needed(votes)
    others = np.arange(len(votes)) != decision
    for step in np.unique(cells.cells[:, 1]).tolist():
        lost = groups.after(Past(step + 1), step)[0, -1]
        if np.any(lost[others] >= gaps[others]):
            those = cells.cells[(cells.cells[:, 1] == step) & (cells.cost == 1)]
            changed = by_running(partial(network.votes, classes=len(votes)), channels, single(those)).votes
            if np.any((changed + votes).argmax(axis=1) != decision):
                return False
    return True
