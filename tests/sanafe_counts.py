"""What SANA-FE counts in a run of its file, to hold our costs against it."""

import numpy as np
from scipy.sparse import csr_array

from spikeloom.compiler.formats.sanafe import dense_neurons


def dense_synapses(netlist):
    """Which synapses the file has priced as dense; shape (synapses,)."""
    return dense_neurons(netlist)[netlist.synapse_compartment()]


def updates(netlist, events, spikes, membranes):
    """Neuron updates (samples, chip steps, compartments) of a run without windows.

    A current that the step before left is no work to it. Only a neuron at rest, without bias, that nothing reaches
    can have no other work; the other updates are those of :class:`trace.Trace`.
    """
    samples, steps, size = spikes.shape
    works = np.zeros(spikes.shape, np.bool_)
    works[:, 1:] = (membranes[:, :-1] != 0) & ~spikes[:, :-1]
    works[:, :, netlist.bias_mantissa != 0] = True
    sources = np.zeros((samples, steps, netlist.n_inputs + size), np.int32)
    given = events[:, :, :steps] != 0
    sources[:, : given.shape[2], : netlist.n_inputs] = given.transpose(0, 2, 1)
    sources[:, 1:, netlist.n_inputs :] = spikes[:, :-1]
    resting = np.flatnonzero(netlist.bias_mantissa == 0)
    source, target = netlist.axon_source[netlist.axon_of_synapse()], netlist.synapse_compartment()
    own = np.isin(target, resting)
    shape = (netlist.n_inputs + size, size)
    reach = csr_array((np.ones(int(own.sum()), np.int32), (source[own], target[own])), shape)[:, resting]
    for i in range(samples):
        works[i][:, resting] |= (sources[i] @ reach) > 0
    return works
