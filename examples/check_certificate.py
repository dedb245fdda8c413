"""Check what ``spikeloom certify --certificate`` wrote; of spikeloom nothing is needed, only numpy.

    python check_certificate.py NETLIST.loom CERTIFICATE

A certificate holds recordings and says of each: the chip decides *so*; no k events alter that; these events do. An
event is a bin of a channel that is set, and a change sets one or clears one. Nothing of it is believed: all is derived
again from the netlist, whose hash is compared, and the chip's integers, by these rules.

*An alteration* is run. *One event*: all runs with one change are run side by side. Two in the same state (registers,
and spikes on their way) go on alike, so one of them stands for both, with the most votes of either for each class
beyond those of the decision.

*k events*: see ``check_groups.py`` (Loihi), and for counters ``check_counts.py``.
"""

import hashlib
import json
import sys
from pathlib import Path
from runpy import run_path

import numpy as np

VERSION = 2  # of certificates
LIMIT = 2**23 - 1  # of currents and membranes
FAR = 2**40


def require(holds, what):
    """Refuse what does not hold."""
    if not holds:
        raise SystemExit(f"refused: {plain(what)}")


def plain(text):
    """What a file says, as a terminal may show it."""
    return "".join(each if each.isprintable() else "?" for each in str(text)[:200])


def load(path):
    """Manifest and whole numbers of a file; nothing in it is executed."""
    with Path(path).open("rb") as file, np.load(file, allow_pickle=False) as content:
        arrays = {name: content[name] for name in content.files}
    about = json.loads(str(arrays.pop("manifest")))
    return about, {name: each.astype(np.int64) for name, each in arrays.items() if each.dtype.kind == "i"}


def parts(bounds):
    """Part of each entry of range bounds."""
    return np.repeat(np.arange(len(bounds) - 1), np.diff(bounds))


def decayed(value, keep):
    """``value * keep / 4096`` toward zero."""
    return np.sign(value) * (np.abs(value) * keep >> 12)


class Chip:
    """Synapses by source (input channels and compartments, or axons), and who votes for what."""

    def connect(self, source, target, weight, sources, label, classes):
        """Keep them."""
        order = np.argsort(source, kind="stable")
        self.target, self.weight = target[order], weight[order]
        self.first = np.searchsorted(source[order], np.arange(sources + 1))
        self.label, self.classes, self.neurons = label, classes, len(label)

    def sums(self, sure, may):
        """Least and largest sums (rows, neurons), by sources (rows, sources) that spike surely, and that may."""
        differ = (sure != sure[0]) | (may != may[0])  # few do: rows are summed up from the first on
        differ[0] = may[0]
        row, source = np.nonzero(differ)
        length = self.first[source + 1] - self.first[source]
        entry = np.repeat(np.arange(len(source)), length)
        at = np.arange(len(entry)) + (self.first[source] - np.cumsum(length) + length)[entry]
        row, source, weight = row[entry], source[entry], self.weight[at]
        place = row * self.neurons + self.target[at]
        ends = []
        for end in (np.minimum, np.maximum):
            each, first = (
                weight * on + end(weight, 0) * (maybe & ~on)
                for on, maybe in ((sure[row, source], may[row, source]), (sure[0, source], may[0, source]))
            )
            added = np.bincount(place, each - (row > 0) * first, len(sure) * self.neurons)
            ends.append(added.astype(np.int64).reshape(len(sure), -1))
            ends[-1][1:] += ends[-1][0]
        return ends

    def votes(self, fired):
        """Votes by class of spikes (rows, neurons), or (rows, last neurons)."""
        label = self.label[self.neurons - fired.shape[1] :]
        voters = np.flatnonzero(label >= 0)
        ballots = label[voters, None] == np.arange(self.classes)
        return (fired[:, voters] @ ballots.astype(np.float64)).astype(np.int64)


class Loihi(Chip):
    """State: least and largest current, the same of the membrane, and who spiked surely, and may have.

    Neurons are in the order of their layers. Registers are whole numbers in float64, which holds them exactly, as it
    does their products with what is kept: these are below 2 ** 36.
    """

    bin_ticks = 1

    def __init__(self, about, a):
        require(not about.get("blank"), "a free-running netlist")
        axon = parts(a["axon_synapses"])
        exponent, mantissa = a["format_exponent"][a["axon_format"][axon]], a["synapse_weight"]
        weight = np.where(exponent < 0, mantissa >> 1, mantissa << np.maximum(exponent, 0))
        target = a["core_compartments"][parts(a["core_axons"])][axon] + a["synapse_target"]
        self.channels = about["taxels"] * about["polarities"] + about["clocks"]["channels"]
        source, n = a["axon_source"][axon], len(a["layer"])
        depth = np.array([layer["depth"] for layer in about["layers"]])[a["layer"]]
        order = np.argsort(depth, kind="stable")
        place = np.argsort(order)
        source = np.append(np.arange(self.channels), self.channels + place)[source]
        target = place[target]
        self.connect(source, target, weight, self.channels + n, a["readout_class"][order], about["classes"])
        self.keep_u, self.keep_v = 4095 - a["decay_u"][order], 4096 - a["decay_v"][order]
        self.threshold = a["threshold"][order] << 6
        self.bias = (a["bias_mantissa"] << a["bias_exponent"])[order]
        self.depth = depth[order]
        self.drain = int(self.depth.max())
        up, down = (64 * np.bincount(target, (s * weight).clip(0), n).astype(np.int64) for s in (1, -1))
        # least and most currents, whatever the input
        self.most = [each * 4096 // (4096 - self.keep_u) for each in (-down, up)]
        overflows = (np.maximum(up, down) >= 2**21) | (np.abs(self.most).max(axis=0) > LIMIT)
        require(not overflows.any(), "a register may overflow")

    def start(self, steps):
        """At rest, for a recording of so many steps."""
        self.steps = steps
        return [*np.zeros((4, 1, self.neurons)), *np.zeros((2, 1, self.neurons), np.bool_)]

    def tick(self, state, seen, t):
        """Bounds of all rows a step on, and the least and most votes; `seen` are the events, sure and possible."""
        sums = self.sums(*(np.concatenate(each, axis=1) for each in zip(seen, state[4:], strict=True)))
        state = self.after(state, sums, t)
        return state, (self.votes(state[4]), self.votes(state[5]))

    def after(self, state, sums, t):
        """Bounds a step on of all neurons, or of the last ones, by the least and largest sums of their synapses.

        `state` is overwritten: new memory for each number would take longer than to find the number.
        """
        those = slice(self.neurons - state[0].shape[1], None)
        threshold, depth = self.threshold[those], self.depth[those]
        outside = (t < depth) | (depth + self.steps <= t)
        for end in (0, 1):
            u, v = state[end], state[2 + end]
            u *= self.keep_u[those] / 4096
            np.trunc(u, out=u)
            u += 64 * sums[end]
            u[:, outside] = 0
            v *= self.keep_v[those] / 4096
            np.trunc(v, out=v)
            v += u
            v += self.bias[those]
            np.clip(v, -LIMIT, LIMIT, out=v)
            v[:, outside] = 0
        low, high = state[2:4]
        sure, may = low > threshold, high > threshold
        np.minimum(low, 0, out=low, where=may)
        np.copyto(low, 0, where=sure)
        np.copyto(high, threshold, where=may)
        np.copyto(high, 0, where=sure)
        return [*state[:4], sure, may]

    def lowest(self, steps):
        """Membranes below which none is within so many steps, whatever the input."""
        least = np.zeros(self.neurons, np.int64)
        for _ in range(steps):
            sunk = decayed(least, self.keep_v) + self.most[0] + np.minimum(self.bias, 0)
            least = np.maximum(sunk, -LIMIT)
        return least

    def unknown(self, begin, least):
        """Whatever any input can have brought about before a step."""
        inside = ((self.depth < begin) & (begin <= self.depth + self.steps))[None]
        u = [each * (self.keep_u > 0) for each in self.most]
        box = [each * inside.astype(np.float64) for each in (*u, least, self.threshold)]
        return [*box, inside & False, inside]


class TrueNorth(Chip):
    """State: membrane, and the axons that spikes reach in this tick and the next ones."""

    def __init__(self, about, a):
        axon, core = parts(a["axon_synapses"]), parts(a["core_axons"])
        neuron = a["core_neurons"][core[axon]] + a["synapse_neuron"]
        weight = a["weight"][neuron, a["axon_type"][axon]]
        self.connect(axon, neuron, weight, len(core), a["readout_class"], about["classes"])
        self.a, self.bin_ticks = a, about["bin_ticks"]
        self.channels = about["taxels"] * about["polarities"] + about["clocks"]["channels"]
        line = {pair: n for n, pair in enumerate(zip(core.tolist(), a["axon_line"].tolist(), strict=True))}
        place = {xy: n for n, xy in enumerate(zip(a["core_x"].tolist(), a["core_y"].tolist(), strict=True))}
        wires = zip(a["wire_x"].tolist(), a["wire_y"].tolist(), strict=True)
        a["wire_core"] = np.array([place[xy] for xy in wires], np.int64)
        self.feed, self.clock, self.wire = (
            np.array(
                [line[at] for at in zip(*(a[f"{k}_{n}"].tolist() for n in ("core", "line")), strict=True)],
                int,
            )
            for k in ("feed", "clock", "wire")
        )
        self.drain = int(a["readout_first"][self.label >= 0].max(initial=0))
        self.ahead = 1 + int(max(a["feed_tick"].max(initial=0), a["wire_delay"].max(initial=1)))

    def start(self, steps):
        """Initial membranes."""
        self.steps = steps
        return [self.a["initial"][None], np.zeros((1, self.ahead, len(self.first) - 1), np.bool_)]

    def tick(self, state, seen, t):
        """All rows a tick on, and their votes twice."""
        a, v, due = self.a, state[0], state[1].copy()
        row, feed = np.nonzero(seen[0][:, a["feed_channel"]])
        due[row, a["feed_tick"][feed], self.feed[feed]] = True
        late = t - a["clock_phase"]
        due[:, 0, self.clock[(late >= 0) & (late % a["clock_period"] == 0)]] = True
        low, high = -(2**19), 2**19 - 1
        v = np.clip(v + self.sums(due[:, 0], due[:, 0])[0], low, high)
        towards = np.where(a["leak_reversal"], np.sign(v), 1)
        leaked = v + towards * a["leak"]
        v = np.clip(np.where(a["leak_reversal"] & (leaked * towards < 0), 0, leaked), low, high)
        fired, floor = v >= a["threshold"], a["negative_threshold"]
        to, by = a["reset_mode"] == 0, a["reset_mode"] == 1
        up = np.where(to, a["reset"], np.where(by, v - a["threshold"], v))
        down = np.where(
            a["negative_saturates"], -floor, np.where(to, -a["reset"], np.where(by, v + floor, v))
        )
        v = np.clip(np.where(fired, up, np.where(v < -floor, down, v)), low, high)
        due = np.concatenate([due[:, 1:], np.zeros_like(due[:, :1])], axis=1)
        row, wire = np.nonzero(fired[:, a["wire_neuron"]])
        due[row, a["wire_delay"][wire] - 1, self.wire[wire]] = True
        counts = (a["readout_first"] <= t) & (t < a["readout_first"] + self.steps * self.bin_ticks)
        return [v, due], (self.votes(fired & counts),) * 2


def run(chip, events, flips, decision):
    """States before each tick and votes in it of a recording (channels, steps), and whether a flip alone alters it.

    `flips` (channels, steps) are the entries that are changed, each alone.
    """
    state, counts = chip.start(events.shape[1]), []
    states = [state]
    ahead = np.zeros((1, chip.classes), np.int64)  # votes beyond those of the decision
    over = np.zeros(chip.classes, np.int64)  # the same of runs that have become the known one
    for t in range(events.shape[1] * chip.bin_ticks + chip.drain):
        step, later = divmod(t, chip.bin_ticks)
        seen = np.zeros((len(ahead), len(events)), np.bool_)
        if not later and step < events.shape[1]:
            more = np.flatnonzero(flips[:, step])
            rows = np.append(np.arange(len(ahead)), np.zeros(len(more), int))
            state, ahead = [each[rows] for each in state], ahead[rows]
            seen = np.repeat(events[None, :, step], len(rows), axis=0)
            seen[len(rows) - len(more) + np.arange(len(more)), more] ^= True
        state, (votes, _) = chip.tick(state, (seen, seen), t)
        ahead = ahead + votes - votes[:, [decision]]
        alike = {}
        of = [alike.setdefault(b"".join(each[k].tobytes() for each in state), k) for k in range(len(ahead))]
        kept, of = np.unique(of, return_inverse=True)
        over = np.maximum(over, (ahead[of == 0] - ahead[0]).max(axis=0))
        worst = np.full((len(kept), chip.classes), -FAR)
        np.maximum.at(worst, of, ahead)
        worst[0] = ahead[0]
        state, ahead = [each[kept] for each in state], worst
        states.append([each[:1].copy() for each in state])
        counts.append(votes[0])
    wins = np.maximum(ahead.max(axis=0), ahead[0] + over) >= 1 * (np.arange(chip.classes) > decision)
    return states, np.array(counts), bool(np.delete(wins, decision).any())


def beside(name):
    """What a file beside this one defines."""
    path = Path(__file__).with_name(name)
    if not path.is_file():
        raise SystemExit(f"not checked: {name} is missing beside this program; copy it there")
    return run_path(str(path))


def check(chip, events, bins, claim):
    """Hold the claims about one recording against the chip; `bins` (channels, steps) are those set in each step."""
    decision, k, rule, changes, apart = claim
    flips = np.zeros(events.shape, np.bool_)
    none, single = flips.copy(), flips.copy()
    flips[: len(bins), : bins.shape[1]] = True
    single[: len(bins), : bins.shape[1]] = bins <= 1
    states, counts, alters = run(chip, events, single if rule == 1 else none, decision)
    require(counts.sum(axis=0).argmax() == decision, "the decision")
    most = {0: 0, 1: 1, 2: k, 3: k, 4: k}.get(rule, -1)
    require(k <= most, f"{k} events, which rule {rule} cannot prove")
    require(not alters, "that no single event alters the decision")
    on_loihi = isinstance(chip, Loihi)
    require(rule not in (2, 3) or on_loihi, f"rule {rule}, which is for Loihi")
    if rule == 4:
        counts = beside("check_counts.py")["Counts" if on_loihi else "Crossbars"](chip, require)
        require(counts.none_of(k, events, bins, decision), f"that no {k} events alter the decision")
    elif rule > 1:
        far, single, step = apart.T
        valid = (far > 0) & np.isin(single, (0, 1)) & (step >= far * single) & (step < bins.shape[1])
        require(valid.all(), "what is told apart of the past")
        flips = flips[:, : bins.shape[1]]
        groups = beside("check_groups.py")["Groups"](chip, events, flips, decision, states, counts)
        none_alter = groups.none_of(k, apart if rule == 3 else apart[:0])
        require(none_alter, f"that no {k} events alter the decision")
    if len(changes):
        channel, step = changes.T
        within = np.all((changes >= 0) & (changes < bins.shape))
        require(within, "changes of entries that the recording does not have")
        changed = events.copy()
        changed[channel, step] ^= True
        votes = run(chip, changed, none, decision)[1].sum(axis=0)
        require(votes.argmax() != decision, "that the changes named alter the decision")
    return int(np.maximum(bins[tuple(changes.T)], 1).sum())


def main(netlist, certificate):
    """Check all claims; the first that does not hold ends it, as does a file that is damaged."""
    try:
        check_all(netlist, certificate)
    except Exception as error:  # numpy, json and zipfile raise whatever they meet
        require(False, f"a damaged file ({type(error).__name__}: {error})")


def check_all(netlist, certificate):
    """Check all claims; the first that does not hold ends it."""
    for file, given in claims(netlist, certificate):
        cost = check(*given)
        decision, unaltered = given[3][:2]
        altered = f"; {cost} alter it" if cost else ""
        print(f"{plain(file)}: decides {decision}; no {unaltered} events alter that{altered}", flush=True)


def claims(netlist, certificate):
    """Each recording's file, and what ``check`` takes: the chip, events, bins and what is claimed."""
    about, arrays = load(certificate)
    require(about.get("format") == "spikeloom-certificate", "the format")
    version = about.get("version")
    require(version == VERSION, f"version {version}; this program checks {VERSION}, so certify again")
    found = hashlib.sha256(Path(netlist).read_bytes()).hexdigest()
    require(found == about["netlist_sha256"], f"a certificate of another netlist, {about['netlist_sha256']}")
    network, cores = load(netlist)
    chip = {"loihi1": Loihi, "truenorth": TrueNorth}[network["target"]](network, cores)
    clocks, bounds, ends = network["clocks"], arrays["step_bounds"], arrays["change_bounds"]
    pasts = arrays["past_bounds"]
    print(f"{netlist}: as certified; {len(about['files'])} recordings")
    for n, file in enumerate(about["files"]):
        bins = arrays["bins"][:, bounds[n] : bounds[n + 1]]
        steps = clocks.get("length") or bins.shape[1]
        bins = bins[:, :steps]
        events = np.zeros((len(bins) + clocks["channels"], steps), np.bool_)
        events[: len(bins), : bins.shape[1]] = bins > 0
        ticking = np.arange(steps) // clocks["steps"] == np.arange(clocks["channels"])[:, None]
        events[len(bins) :] = ticking
        claim = [int(arrays[name][n]) for name in ("decision", "unaltered", "rule")]
        changes = arrays["changes"][ends[n] : ends[n + 1]]
        yield file, (chip, events, bins, (*claim, changes, arrays["pasts"][pasts[n] : pasts[n + 1]]))


if __name__ == "__main__":
    main(*sys.argv[1:])
