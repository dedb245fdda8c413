"""What a netlist file decides and costs, from its arrays in plain numpy: nothing of the product takes part.

A synaptic event is a stored synapse that a spike reaches: of each source its spikes times its fan-out. Energies are
these and the other events that ``chip.toml`` prices, times the prices that stand there.
"""

import json
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

CHIPS = Path(__file__).resolve().parents[1] / "compiler" / "targets"


@dataclass
class Counted:
    """Of each recording; rows are recordings."""

    votes: np.ndarray  # (recordings, classes)
    spikes: np.ndarray  # (recordings, layers)
    operations: np.ndarray  # (recordings,)
    energy: dict[str, np.ndarray]  # Joules by table

    @property
    def decisions(self) -> list[int]:
        return self.votes.argmax(axis=1).tolist()


@dataclass
class NetlistFile:
    """The manifest and the arrays of a file; whole numbers are of 64 bits."""

    said: dict
    arrays: dict[str, np.ndarray]

    def __getattr__(self, name: str) -> np.ndarray:
        return self.arrays[name]


def opened(path: Path) -> NetlistFile:
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    said = json.loads(str(arrays.pop("manifest")))
    return NetlistFile(
        said, {name: a.astype(np.int64) for name, a in arrays.items() if a.dtype.kind in "iu"}
    )


@cache
def energy_tables(chip: str) -> dict[str, dict[str, float]]:
    """Picojoules an event, or milliwatts, by table."""
    tables = tomllib.loads((CHIPS / chip / "chip.toml").read_text("utf-8"))["energy"]
    return {
        name: {event: entry["value"] for event, entry in table.items() if isinstance(entry, dict)}
        for name, table in tables.items()
    }


def in_steps(recording: np.ndarray, said: dict, window: int) -> np.ndarray:
    """What a network takes of a recording (taxels, polarities, bins): the window of it, joined, as long as it says."""
    bins, clocks = said["bins"], said["clocks"]
    kept = recording[..., : max(1, recording.shape[-1] * window // 100)] > 0
    channels = kept.reshape(-1, kept.shape[-1])
    starts = range(0, channels.shape[1], bins)
    joined = np.stack([channels[:, start : start + bins].any(axis=1) for start in starts], axis=1)
    steps = clocks.get("length") or joined.shape[1]
    inputs = np.zeros((len(joined) + clocks["channels"], steps), np.int64)
    inputs[: len(joined), : joined.shape[1]] = joined[:, :steps]
    for clock in range(clocks["channels"]):
        inputs[len(joined) + clock, clock * clocks["steps"] : (clock + 1) * clocks["steps"]] = 1
    return inputs


def counted(path: Path, recordings: Sequence[np.ndarray], window: int = 100) -> Counted:
    """Run recordings (taxels, polarities, bins) through the netlist of a file."""
    netlist = opened(path)
    chip = netlist.said["target"]
    run = {"loihi1": _cores, "truenorth": _crossbars}[chip](netlist)
    rows = [run(in_steps(recording, netlist.said, window)) for recording in recordings]
    votes, spikes, operations, events = zip(*rows, strict=True)
    energy = {
        name: np.array([_joules(prices, each) for each in events])
        for name, prices in energy_tables(chip).items()
    }
    return Counted(np.array(votes), np.array(spikes), np.array(operations), energy)


def _joules(prices: dict[str, float], events: dict[str, int]) -> float:
    """Each event at its price; milliwatts of a floor for the seconds."""
    forms = {"synaptic_operation_dense", "synaptic_operation_sparse"}
    priced = prices.keys() - {"floor", "synaptic_operation"} | (
        forms if "synaptic_operation" in prices else set()
    )
    picojoules = sum(events[event] * prices.get(event, prices.get("synaptic_operation")) for event in priced)
    return picojoules * 1e-12 + prices.get("floor", 0.0) * 1e-3 * events.get("seconds", 0.0)


def _toward_zero(value: np.ndarray, kept: np.ndarray) -> np.ndarray:
    return np.sign(value) * (abs(value) * kept // 4096)


def _cores(net: NetlistFile):
    """Loihi: axons from each source, and a step of all compartments."""
    layers = net.said["layers"]
    blank = net.said.get("blank", 0)
    lag = max(layer["depth"] for layer in layers)
    compartments = len(net.layer)
    inputs = net.said["taxels"] * net.said["polarities"] + net.said["clocks"]["channels"]
    weight, reached = np.zeros((2, inputs + compartments, compartments), np.int64)
    causes = {
        name: np.zeros(inputs + compartments, np.int64)
        for name in (
            "synaptic_operation_dense",
            "synaptic_operation_sparse",
            "packet",
            "hop_east_west",
            "hop_north_south",
        )
    }
    core_of = np.repeat(np.arange(len(net.core_tile)), np.diff(net.core_compartments))
    core_of_axon = np.repeat(np.arange(len(net.core_tile)), np.diff(net.core_axons))
    for axon, (source, form, core) in enumerate(
        zip(net.axon_source, net.axon_format, core_of_axon, strict=True)
    ):
        stored = slice(net.axon_synapses[axon], net.axon_synapses[axon + 1])
        targets = net.core_compartments[core] + net.synapse_target[stored]
        np.add.at(
            weight[source], targets, net.synapse_weight[stored] * 2 ** (net.format_exponent[form] + 1) // 2
        )
        reached[source, targets] = 1
        kind = "sparse" if net.format_index_bits[form] else "dense"
        causes[f"synaptic_operation_{kind}"][source] += len(targets)
        if source >= inputs:
            here, there = (divmod(net.core_tile[at], 8) for at in (core_of[source - inputs], core))
            causes["packet"][source] += 1
            causes["hop_east_west"][source] += abs(here[1] - there[1])
            causes["hop_north_south"][source] += abs(here[0] - there[0])
    bias = net.bias_mantissa * 2**net.bias_exponent
    begin = np.array([layer["depth"] for layer in layers])[net.layer]

    def run(events: np.ndarray):
        steps = events.shape[1]
        last = steps + (blank or lag)
        sent = np.zeros(inputs + compartments, np.int64)
        total = np.zeros_like(sent)
        votes = np.zeros(net.said["classes"], np.int64)
        active = 0
        current, membrane, fired = np.zeros((3, compartments), np.int64)
        for t in range(-blank, last):
            sent[:inputs] = events[:, t] if 0 <= t < steps else 0
            sent[inputs:] = fired
            busy = (membrane != 0) | (current != 0) | (bias != 0) | (sent @ reached > 0)
            current = _toward_zero(current, 4095 - net.decay_u) + 64 * (sent @ weight)
            membrane = _toward_zero(membrane, 4096 - net.decay_v) + current + bias
            membrane = np.clip(membrane, 1 - 2**23, 2**23 - 1)
            window = np.full(compartments, True) if blank else (begin <= t) & (t < begin + steps)
            current, membrane = current * window, membrane * window
            fired = (window & (membrane > 64 * net.threshold)).astype(np.int64)
            membrane = membrane * (1 - fired)
            if t >= 0:
                total[:inputs] += sent[:inputs]
                total[inputs:] += fired
                active += int((window & busy).sum())
            if 0 <= t < steps + lag:
                np.add.at(votes, net.readout_class[(fired > 0) & (net.readout_class >= 0)], 1)
        found = {name: int(total @ each) for name, each in causes.items()}
        spikes = np.bincount(net.layer, total[inputs:], len(layers)).astype(np.int64)
        found |= {"spike": int(spikes.sum()), "neuron_active": active}
        found["neuron_idle"] = compartments * last - active
        operations = found["synaptic_operation_dense"] + found["synaptic_operation_sparse"]
        return votes, spikes, operations, found

    return run


def _crossbars(net: NetlistFile):
    """TrueNorth: axons of each core, and a tick of all neurons."""
    axons, neurons = len(net.axon_line), len(net.leak)
    core_of_axon = np.repeat(np.arange(len(net.core_x)), np.diff(net.core_axons))
    axon_at = {
        place: axon
        for axon, place in enumerate(zip(core_of_axon.tolist(), net.axon_line.tolist(), strict=True))
    }
    core_at = {
        place: core for core, place in enumerate(zip(net.core_x.tolist(), net.core_y.tolist(), strict=True))
    }
    weight, crossed = np.zeros((2, axons, neurons), np.int64)
    for axon, core in enumerate(core_of_axon):
        points = (
            net.core_neurons[core]
            + net.synapse_neuron[net.axon_synapses[axon] : net.axon_synapses[axon + 1]]
        )
        weight[axon, points] = net.weight[points, net.axon_type[axon]]
        crossed[axon, points] = 1
    feeds = [axon_at[place] for place in zip(net.feed_core.tolist(), net.feed_line.tolist(), strict=True)]
    clocks = [axon_at[place] for place in zip(net.clock_core.tolist(), net.clock_line.tolist(), strict=True)]
    places = zip(net.wire_x.tolist(), net.wire_y.tolist(), strict=True)
    wires = [axon_at[core_at[xy], line] for xy, line in zip(places, net.wire_line.tolist(), strict=True)]
    votes_from = net.readout_first
    drain = max(votes_from[net.readout_class >= 0].tolist(), default=0)
    bin_ticks = net.said["bin_ticks"]

    def run(events: np.ndarray):
        steps = events.shape[1]
        ticks = steps * bin_ticks + drain
        due = np.zeros((ticks + 64, axons), np.int64)
        for channel, axon, late in zip(net.feed_channel, feeds, net.feed_tick, strict=True):
            at = np.flatnonzero(events[channel]) * bin_ticks + late
            due[at[at < ticks], axon] = 1
        for axon, period, phase in zip(clocks, net.clock_period, net.clock_phase, strict=True):
            due[phase:ticks:period, axon] = 1
        membrane = net.initial.copy()
        votes = np.zeros(net.said["classes"], np.int64)
        spikes = np.zeros(len(net.said["layers"]), np.int64)
        operations = 0
        for tick in range(ticks):
            operations += int(due[tick] @ crossed.sum(axis=1))
            membrane = membrane + due[tick] @ weight
            sign = np.sign(membrane)
            reversed_leak = np.where((membrane + sign * net.leak) * sign < 0, 0, membrane + sign * net.leak)
            membrane = np.where(net.leak_reversal == 1, reversed_leak, membrane + net.leak)
            fired = membrane >= net.threshold
            after = np.select(
                [net.reset_mode == 0, net.reset_mode == 1], [net.reset, membrane - net.threshold], membrane
            )
            below = ~fired & (membrane < -net.negative_threshold)
            raised = [-net.negative_threshold, -net.reset, membrane + net.negative_threshold]
            low = np.select(
                [net.negative_saturates == 1, net.reset_mode == 0, net.reset_mode == 1], raised, membrane
            )
            membrane = np.where(fired, after, np.where(below, low, membrane))
            assert abs(membrane).max() < 2**19, "a membrane leaves its register, which this does not follow"
            for wire in np.flatnonzero(fired[net.wire_neuron]):
                due[tick + net.wire_delay[wire], wires[wire]] = 1
            voting = (
                fired
                & (net.readout_class >= 0)
                & (votes_from <= tick)
                & (tick < votes_from + steps * bin_ticks)
            )
            np.add.at(votes, net.readout_class[voting], 1)
            spikes += np.bincount(net.layer[fired], minlength=len(spikes))
        return votes, spikes, operations, {"synaptic_event": operations, "seconds": ticks * 1e-3}

    return run
