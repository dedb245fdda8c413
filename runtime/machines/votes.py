"""Read-out of a simulated netlist: spike counts to classes."""

import numpy as np

from spikeloom.compiler.interpret import vote
from spikeloom.compiler.ir import Readout
from spikeloom.compiler.targets.netlist_file import Netlist
from spikeloom.compiler.types import BoolArray, IntArray


def class_counts(netlist: Netlist, spikes: IntArray) -> IntArray:
    """Votes per class from spike counts per compartment (samples, compartments); shape (samples, classes)."""
    voters = netlist.voters
    counts = np.zeros((len(spikes), netlist.classes), np.int64)
    np.add.at(counts.T, netlist.readout_class[voters], spikes[:, voters].T)
    return counts


def readout_counts(readout: Readout, classes: int, spikes: BoolArray) -> IntArray:
    """Votes per class from the spikes of the population that votes (samples, steps, neurons); (samples, classes)."""
    counts = np.zeros((len(spikes), classes), np.int64)
    np.add.at(counts.T, readout.label, spikes.sum(axis=1, dtype=np.int64).T)
    return counts


def predictions(netlist: Netlist, spikes: IntArray) -> IntArray:
    """Class of each recording from spike counts per compartment; ties go to the lowest class."""
    return vote(class_counts(netlist, spikes))


def votes_by_step(readout: Readout, classes: int, spikes: BoolArray) -> IntArray:
    """Votes so far after each step, from the spikes of the population that votes (samples, steps, neurons)."""
    votes = np.zeros((*spikes.shape[:2], classes), np.int64)
    np.add.at(np.moveaxis(votes, 2, 0), readout.label, np.moveaxis(spikes, 2, 0))
    return np.cumsum(votes, axis=1)


def wins(decisions: IntArray, least: IntArray, most: IntArray) -> BoolArray:
    """Whether a class wins the vote whatever the counts between their bounds; ties go to the lowest class.

    `decisions` is the class in question, (samples,); `least` and `most` bound the votes, (samples, classes).

    >>> least, most = np.array([[3, 3], [3, 3], [2, 1]]), np.array([[3, 3], [3, 4], [4, 2]])
    >>> wins(np.array([0, 0, 0]), least, most).tolist()
    [True, False, True]
    """
    rows = np.arange(len(decisions))
    classes = np.arange(least.shape[1])
    ahead = least[rows, decisions][:, None] - most
    ahead[rows, decisions] = 0  # no class has to beat itself
    return np.asarray(np.all(ahead >= (classes < decisions[:, None]), axis=1))
