"""Bits and storage schemes against accuracy, agreement, spikes, operations and cores, over several trained networks.

    python benchmarks/schemes.py RECORDINGS CHECKPOINT... --results FILE.json [--graph manual]

Each checkpoint is compiled by every scheme (all choices on the training split), run on the test split and compared
with its own float32 model. A fine-tuned network is looked for beside its original: ``NAME-4bit.pt`` and
``NAME-2bit.pt`` for ``NAME.pt``. Every cell is stored as soon as it is there, so that an interrupted run goes on where
it stopped. Prints one Markdown row per scheme: means over the checkpoints, and what the chip loses against the float
models, with interval and p by resampling recordings, p after Holm's correction for all schemes.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import bootstrap, permutation_test

from spikeloom.compiler import Options, Packing, compile_network
from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.files import write_atomically
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.interpret import vote
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.types import BoolArray, FloatArray
from spikeloom.models.graphs import build_graph, normalised_adjacency
from spikeloom.models.networks.reference import float_spikes
from spikeloom.models.recordings.events import load_data
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.machines.base import machine_of
from spikeloom.runtime.machines.integer import integer_machine
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.costs import cost
from spikeloom.runtime.machines.loihi1.trace import aligned
from spikeloom.runtime.machines.votes import predictions

Scheme = dict[str, Any]

SCHEMES: dict[str, tuple[str, Scheme]] = {
    "8 bits, from the weights": ("", {"calibrated": False}),
    "8 bits": ("", {}),
    "2 × 8 bits": ("", {"packings": (Packing(planes=2),)}),
    "2 × 8 bits, 8 scales": ("", {"packings": (Packing(planes=2, groups=8),)}),
    "spike-exact": ("", {"spike_exact": True}),
    "6 bits": ("", {"packings": (Packing(bits=6),)}),
    "4 bits": ("", {"packings": (Packing(bits=4),)}),
    "4 bits, 8 scales": ("", {"packings": (Packing(bits=4, groups=8),)}),
    "4 bits, fine-tuned": ("-4bit", {"calibrated": False}),
    "ternary, 8 scales": ("", {"packings": (Packing(bits=2, groups=8),)}),
    "ternary, fine-tuned": ("-2bit", {"calibrated": False}),
}


def measure(
    checkpoint: Checkpoint, adjacency: Any, training: Recordings, test: Recordings, reference: Any, options: Scheme
) -> Scheme:
    """Compile and run one network by one scheme."""
    options = dict(options)
    events = training.events if options.pop("calibrated", True) else None
    netlist = compile_network(
        expand(checkpoint, adjacency), Options(forms=checkpoint.forms, training_events=events, **options)
    ).netlist
    trace = engine.simulate(netlist, test.events.reshape(len(test), -1, test.steps), spikes=True)
    assert trace.spikes is not None
    meter = cost.prepare(netlist, load_target(netlist.target))
    costs = cost.price(meter, trace.counts, test.steps + netlist.max_depth)
    kept = integer_machine(machine_of(netlist)).compared()
    different = {
        layer.name: int(np.count_nonzero((aligned(netlist, trace.spikes, i) != reference[layer.name])[..., kept[i]]))
        for i, layer in enumerate(netlist.layers)
    }
    return {
        "predictions": predictions(netlist, trace.counts.spikes).tolist(),
        "different": different,
        "operations": float(costs.synaptic_operations.sum(axis=1).mean()),
        "energy_davies2018": float(costs.energy["davies2018"].sum(axis=1).mean()),
        "cores": netlist.n_cores,
        "synapses_stored": netlist.n_synapses,
    }


def fill(arguments: argparse.Namespace) -> tuple[Options, Recordings]:
    """Measure every cell that the results lack; store each as it comes."""
    place = Path(arguments.results)
    results: Options = json.loads(place.read_text("utf-8")) if place.exists() else {}
    graph = build_graph(arguments.graph)
    adjacency = normalised_adjacency(graph.edges, graph.n_taxels)
    training, test = (load_data(arguments.recordings, split) for split in ("train", "test"))
    for path in map(Path, arguments.checkpoints):
        original = read_checkpoint(path)
        found = results.setdefault(path.stem, {"sha256": original.sha256, "schemes": {}})
        if found["sha256"] != original.sha256:
            raise SystemExit(f"{place}: was made with another {path.name}; name another file")
        reference = None
        for scheme, (suffix, options) in SCHEMES.items():
            source = path.with_name(f"{path.stem}{suffix}.pt")
            if scheme in found["schemes"] or not source.exists() or scheme not in (arguments.schemes or SCHEMES):
                continue
            if reference is None:
                reference = float_spikes(original, adjacency, test.events)
                found["float"] = vote(list(reference.values())[-1].sum(axis=1, dtype=np.int64)).tolist()
            checkpoint = read_checkpoint(source)
            found["schemes"][scheme] = measure(checkpoint, adjacency, training, test, reference, options)
            print(path.stem, scheme, found["schemes"][scheme]["different"], flush=True)
            with write_atomically(place) as file:
                file.write(json.dumps(results, indent=1).encode())
    return results, test


def by_recording(chip: BoolArray, model: BoolArray) -> tuple[float, float, float]:
    """95 % interval of the accuracy lost, and p of none, both by resampling recordings.

    What is right, (networks, recordings) each. Decisions of several networks on one recording are not independent of
    each other, so a recording is drawn, or chip and float model are exchanged, with all its networks at once.
    """
    means = model.mean(axis=0), chip.mean(axis=0)
    if np.array_equal(*means):
        return 0.0, 0.0, 1.0

    def lost(first: FloatArray, second: FloatArray, axis: int = -1) -> FloatArray:
        return np.mean(first - second, axis=axis)

    drawn = bootstrap(means, lost, paired=True, method="percentile", rng=0).confidence_interval
    exchanged = permutation_test(means, lost, permutation_type="samples", rng=0)
    return float(drawn.low), float(drawn.high), float(exchanged.pvalue)


def holm(p: Sequence[float]) -> FloatArray:
    """P-values of several comparisons, corrected.

    Examples
    --------
    >>> holm([0.01, 0.04, 0.03]).round(2).tolist()
    [0.03, 0.06, 0.06]
    """
    order = np.argsort(p)
    found = np.empty(len(p))
    found[order] = np.minimum(1, np.maximum.accumulate(np.sort(p) * np.arange(len(p), 0, -1)))
    return found


def rows(results: Options, labels: Any) -> list[str]:
    """Markdown table of the means over networks."""
    head = [
        "storage",
        "networks",
        "accuracy",
        "loss",
        "p, Holm",
        "decisions equal",
        "spikes that differ",
        "of one plane",
    ]
    lines = []
    chances = []
    plain = _sum_of(results, "8 bits, from the weights")
    for scheme in SCHEMES:
        cells = [(net["float"], net["schemes"][scheme]) for net in results.values() if scheme in net["schemes"]]
        if not cells:
            continue
        ours, floats = np.array([cell["predictions"] for _, cell in cells]), np.array([model for model, _ in cells])
        right, model = ours == labels, floats == labels
        low, high, p = by_recording(right, model)
        chances.append(p)
        different = sum(sum(cell["different"].values()) for _, cell in cells)
        cores = sorted({cell["cores"] for _, cell in cells})
        lines.append(
            [
                scheme,
                str(len(cells)),
                f"{100 * right.mean():.2f} %",
                f"{100 * (model.mean() - right.mean()):+.2f} ({100 * low:+.1f} … {100 * high:+.1f})",
                "",
                f"{100 * np.mean(ours == floats):.1f} %",
                f"{different / len(cells):,.0f}",
                f"1/{plain / different:.1f}" if plain and len(cells) == len(results) else "",
                f"{np.mean([cell['operations'] for _, cell in cells]) / 1e6:.2f} M",
                " … ".join(map(str, dict.fromkeys((cores[0], cores[-1])))),
            ]
        )
    for line, p in zip(lines, holm(chances), strict=True):
        line[4] = f"{p:.2g}"
    head += ["operations", "cores"]
    return ["| " + " | ".join(line) + " |" for line in (head, ["---", *["---:"] * (len(head) - 1)], *lines)]


def _sum_of(results: Options, scheme: str) -> int:
    return sum(sum(net["schemes"].get(scheme, {"different": {}})["different"].values()) for net in results.values())


def main() -> None:
    """Measure what is missing and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings")
    parser.add_argument("checkpoints", nargs="+")
    parser.add_argument("--results", required=True)
    parser.add_argument("--graph", default="manual")
    parser.add_argument("--schemes", nargs="+", choices=SCHEMES, help="measure these only (default: all)")
    arguments = parser.parse_args()
    results, test = fill(arguments)
    floats = np.concatenate([net["float"] for net in results.values()])
    right = np.mean(floats == np.tile(test.labels, len(results)))
    print(f"float model: {100 * right:.2f} %\n")
    print("\n".join(rows(results, test.labels)))


if __name__ == "__main__":
    main()
