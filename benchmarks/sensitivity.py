"""Whether the conclusions hang on a price, or on the width of a register.

    python benchmarks/sensitivity.py Ev-Objects.zip objects_manual.t7 OUT.json --picture OUT.png

Two networks of Objects, the released TactileSGNet and the shipped counters, on chips that are not built: with fewer
bits in a weight (counters are trained for them, as their weights are whole numbers), in the accumulator (the compiler
then scales weights down until no sum overflows), and in the decays of the neurons. And what conclusions come to if a
price is ``FACTOR`` times as large or as small: counters take less energy than the TactileSGNet (dynamic, by both
tables), and a microcontroller less than the chip (all, at the sensor's pace; every other price at the end that favours
the chip). Prices of the latter are those of ``processor-objects.json``.
"""

import argparse
import json
import tempfile
from collections.abc import Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

Json = dict[str, Any]

RESULTS = Path(__file__).parent / "results"
FACTOR = 5.0
BITS = {
    "weight": (8, 6, 5, 4, 3, 2),
    "accumulator": (21, 19, 17, 15, 13),
    "decay": (12, 8, 6, 4, 2, 1),
}
"""Of a register, of the accumulator beside its sign; the chip's come first."""

NETWORKS: dict[str, Json] = {"TactileSGNet": {"graph": "manual", "weight_bits": 8}, "counters": {}}
"""Options of ``compile`` where the registers are the chip's."""


def of_test(data: str, machine: Any) -> Any:
    """The test split as a network takes it: as long as its read-out needs."""
    from spikeloom.runtime.inputs.recordings import load_recordings
    from spikeloom.runtime.requests.main_job import RunRequest

    return load_recordings(data, RunRequest(netlist="", data=data), machine.netlist)


def compiled(source: str, data: str, options: Json) -> Any:
    """The machine of a network, of counters trained for so many ``bits``; None where the compiler refuses it."""
    import spikeloom
    from spikeloom.compiler.errors import SpikeloomError
    from spikeloom.runtime.machines.backends import machine_for

    with tempfile.TemporaryDirectory() as folder:
        if "bits" in options:
            source = str(Path(folder, "net.pt"))
            spikeloom.train(data, source, system="counters", weight_bits=options["bits"])
        rest = {name: value for name, value in options.items() if name != "bits"}
        try:
            net = spikeloom.compile(source, calibrate=spikeloom.recordings(data).train, **rest)
        except SpikeloomError:
            return None
    return machine_for(net.path)


def decided(source: str, data: str, options: Json, accumulator: int) -> dict[int, list[int]]:
    """Decisions on the test split by bits of a decay, first the chip's; none where the compiler refuses.

    In a process of its own: the compiler takes the accumulator's width from its registers, which are changed before
    any of it is loaded.
    """
    from spikeloom.compiler.targets.loihi1 import registers

    registers.ACCUMULATOR_MAX = 2**accumulator - 1
    registers.ONE_STEP_SUM_MAX = registers.ACCUMULATOR_MAX >> registers.MEMBRANE_SHIFT
    from spikeloom.runtime.machines.backends import machine_of

    machine = compiled(source, data, options)
    if machine is None:
        return {}
    test = of_test(data, machine)
    usual = accumulator == BITS["accumulator"][0] and options in NETWORKS.values()
    found = {}
    for bits in BITS["decay"] if usual else BITS["decay"][:1]:
        step = 2 ** (BITS["decay"][0] - bits)
        kept = step * np.rint(machine.netlist.keep_v / step).astype(np.int64)
        changed = machine_of(replace(machine.netlist, decay_v=registers.DECAY_ONE - kept))
        ran = changed.run(test.events, lengths=test.lengths)
        found[bits] = [int(each) for each in ran.decisions]
    return found


def widths(sources: Mapping[str, str], data: str) -> Iterator[Json]:
    """Decisions that are right, and those that are the chip's, by network, register and bits."""
    import spikeloom

    labels = spikeloom.recordings(data).test.labels.tolist()
    widest, decay = BITS["accumulator"][0], BITS["decay"][0]
    with ProcessPoolExecutor(1, get_context("spawn"), max_tasks_per_child=1) as pool:
        for name, options in NETWORKS.items():
            wanted = {("decay", bits): (options, widest) for bits in BITS["decay"]}
            # counters have whole weights, trained for their width
            fewer = "weight_bits" if options else "bits"
            for bits in BITS["weight"]:
                wanted["weight", bits] = options | {fewer: bits}, widest
            wanted["weight", BITS["weight"][0]] = options, widest
            wanted |= {("accumulator", bits): (options, bits) for bits in BITS["accumulator"]}
            runs: dict[str, dict[int, list[int]]] = {}
            for (register, bits), asked in wanted.items():
                if repr(asked) not in runs:
                    runs[repr(asked)] = pool.submit(decided, sources[name], data, *asked).result()
                usual = runs[repr((options, widest))][decay]
                found = runs[repr(asked)].get(bits if register == "decay" else decay)
                row = {"network": name, "register": register, "bits": bits}
                for key, true in {"right": labels, "same": usual}.items():
                    row[key] = None if found is None else sum(map(int.__eq__, found, true))
                print(row, flush=True)
                yield row


def energies(machine: Any, data: str) -> dict[str, dict[str, float]]:
    """Joules of a mean inference by energy table and event."""
    from spikeloom.runtime.machines.base import with_clocks
    from spikeloom.runtime.machines.loihi1.costs.estimate import estimate

    test = of_test(data, machine)
    channels = with_clocks(test.events, machine.netlist.clocks)
    costs = estimate(machine.netlist, machine.target, channels, lengths=test.lengths)[1].costs
    counts = {event: float(each.sum(axis=1).mean()) for event, each in costs.events.items()}
    found = {}
    for table in machine.target.energy:
        prices = {event: event if event in table.prices else event.rpartition("_")[0] for event in counts}
        found[table.name] = {
            event: counts[event] * table.joule(price)
            for event, price in prices.items()
            if price in table.prices
        }
        whole = costs.energy[table.name].sum(axis=1).mean()
        assert np.isclose(sum(found[table.name].values()), whole), f"{table.name}: {whole}"
    return found


def ratio(more: Mapping[str, float], less: Mapping[str, float], event: str, factor: float) -> float:
    """How many times as much `more` takes as `less`, where the price of an event is so many times as large."""

    def total(parts: Mapping[str, float]) -> float:
        return sum(joules * (factor if name.startswith(event) else 1.0) for name, joules in parts.items())

    return total(more) / total(less)


def prices(sources: Mapping[str, str], data: str) -> Json:
    """Each conclusion as a ratio, and its range over each price."""
    found: Json = {}
    machines = {name: compiled(sources[name], data, options) for name, options in NETWORKS.items()}
    joules = {name: energies(machine, data) for name, machine in machines.items()}
    for table in joules["counters"]:
        more, less = (joules[name][table] for name in ("TactileSGNet", "counters"))
        found[f"TactileSGNet / counters, {table}"] = {
            "usual": ratio(more, less, "", 1.0),
            "prices": {
                event: [ratio(more, less, event, factor) for factor in (1 / FACTOR, FACTOR)]
                for event in ("synaptic_operation", "neuron_idle", "neuron_active", "spike", "packet", "hop")
                if any(name.startswith(event) for name in more)
            },
        }
    found["chip / microcontroller"] = against_microcontroller()
    return found


def against_microcontroller() -> Json:
    """What counters take on the chip at least, over what a microcontroller takes at most, at the sensor's pace."""
    stored = json.loads((RESULTS / "processor-objects.json").read_text())["figures"]["counters"]
    seconds, chip, small = stored["seconds"], stored["chip"], stored["processor"]
    more = {"static power": seconds * chip["static_w"][0], "events of the chip": chip["dynamic_j"][0]}
    less = {"idle microcontroller": seconds * small["static_w"][1], "cycles": small["dynamic_j"][1]}
    return {
        "usual": ratio(more, less, "", 1.0),
        "prices": {name: [ratio(more, less, name, f) for f in (1 / FACTOR, FACTOR)] for name in more | less},
    }


def draw(found: Json, path: Path) -> None:
    """Widths above, prices below."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure = plt.figure(figsize=(7.6, 6.2), layout="constrained")
    above, below = figure.subfigures(2, height_ratios=[1, 1.5])
    panels = above.subplots(1, len(BITS), sharey=True)
    for axes, register in zip(panels, BITS, strict=True):
        for name, colour in {"TactileSGNet": "#1b6ca8", "counters": "#c1440e"}.items():
            rows = [row for row in found["widths"] if row["register"] == register and row["network"] == name]
            rows = [row for row in rows if row["right"] is not None]
            bits, right = ([row[key] for row in rows] for key in ("bits", "right"))
            axes.plot(bits, right, "o-", ms=4, color=colour, label=name)
        axes.set(xlabel=f"bits of {register}", xticks=BITS[register])
        axes.grid(alpha=0.25)
    panels[0].set_ylabel(f"right of {found['samples']}")
    panels[-1].legend(fontsize=8)
    bars = below.subplots()
    rows = [
        (f"{name}: {price.replace('_', ' ')}", ends, one["usual"])
        for name, one in found["prices"].items()
        for price, ends in one["prices"].items()
    ]
    for at, (_, ends, usual) in enumerate(rows):
        bars.plot(ends, [at, at], lw=5, color="#7a9e7e", solid_capstyle="butt")
        bars.plot(usual, at, "k|", ms=9)
    bars.axvline(1, color="#c1440e", lw=1)
    bars.set(xscale="log", yticks=range(len(rows)), xlabel="times as much (1: the conclusion turns)")
    bars.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    bars.set_yticklabels([label for label, *_ in rows], fontsize=7)
    bars.set_title(f"a price {FACTOR:g} times as small … as large", fontsize=9)
    bars.invert_yaxis()
    bars.grid(alpha=0.25, axis="x")
    figure.savefig(path, dpi=110, metadata={"Software": None})


def main() -> None:
    """Store widths and prices, and draw them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data")
    parser.add_argument("checkpoint")
    parser.add_argument("output", type=Path)
    parser.add_argument("--picture", type=Path)
    arguments = parser.parse_args()
    from made import made

    import spikeloom

    data = spikeloom.recordings(arguments.data)
    sources = {"TactileSGNet": arguments.checkpoint, "counters": "pretrained:objects-counters"}
    found = made(data.train, data.test) | {
        "samples": len(data.test),
        "factor": FACTOR,
        "prices": prices(sources, arguments.data),
        "widths": list(widths(sources, arguments.data)),
    }
    arguments.output.write_text(json.dumps(found, indent=1) + "\n", "utf-8")
    if arguments.picture:
        draw(found, arguments.picture)


if __name__ == "__main__":
    main()
