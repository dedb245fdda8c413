"""Bits and storage schemes against accuracy, agreement, spikes, operations and cores, over several trained networks.

    python benchmarks/schemes.py RECORDINGS CHECKPOINT... --results FILE.json [--graph manual]

Each checkpoint is compiled by every scheme (all choices on the training split), run on the test split and compared
with its own float32 model. A fine-tuned network is looked for beside its original: ``NAME-4bit.pt`` and
``NAME-2bit.pt`` for ``NAME.pt``. Every cell is stored as soon as it is there, so that an interrupted run goes on where
it stopped. Prints one Markdown row per scheme: means over the checkpoints, the Wilson interval of all decisions
pooled, and the exact McNemar comparison of chip and float, pooled too.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler import Options, Packing, compile_network
from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.files import write_atomically
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.interpret import vote
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.base import load_target
from spikeloom.models.graphs import build_graph, normalised_adjacency
from spikeloom.models.networks.reference import float_spikes
from spikeloom.models.recordings.events import load_data
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.equivalence.verdict import mcnemar
from spikeloom.runtime.machines.integer import integer_machine_of
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.costs import cost
from spikeloom.runtime.machines.loihi1.trace import aligned
from spikeloom.runtime.machines.votes import predictions
from spikeloom.runtime.report.numbers import wilson

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
    kept = integer_machine_of(netlist).compared()
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


def rows(results: Options, labels: Any) -> list[str]:
    """Markdown table of the means over networks."""
    head = ["storage", "networks", "accuracy", "loss", "p", "decisions equal", "spikes that differ", "of one plane"]
    lines = [[*head, "operations", "cores"]]
    plain = _sum_of(results, "8 bits, from the weights")
    for scheme in SCHEMES:
        cells = [(net["float"], net["schemes"][scheme]) for net in results.values() if scheme in net["schemes"]]
        if not cells:
            continue
        truth = np.tile(labels, len(cells))
        ours = np.concatenate([cell["predictions"] for _, cell in cells])
        floats = np.concatenate([reference for reference, _ in cells])
        right, total = int((ours == truth).sum()), len(truth)
        low, high = wilson(right, total)
        *_, p = mcnemar(truth, floats, ours)
        different = sum(sum(cell["different"].values()) for _, cell in cells)
        cores = sorted({cell["cores"] for _, cell in cells})
        lines.append(
            [
                scheme,
                str(len(cells)),
                f"{100 * right / total:.2f} % ({100 * low:.1f} … {100 * high:.1f})",
                f"{100 * ((floats == truth).sum() - right) / total:+.2f}",
                f"{p:.2g}",
                f"{100 * np.mean(ours == floats):.1f} %",
                f"{different / len(cells):,.0f}",
                f"1/{plain / different:.1f}" if plain and len(cells) == len(results) else "",
                f"{np.mean([cell['operations'] for _, cell in cells]) / 1e6:.2f} M",
                " … ".join(map(str, dict.fromkeys((cores[0], cores[-1])))),
            ]
        )
    lines.insert(1, ["---", *["---:"] * (len(lines[0]) - 1)])
    return ["| " + " | ".join(line) + " |" for line in lines]


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
    right = int((floats == np.tile(test.labels, len(results))).sum())
    low, high = wilson(right, len(floats))
    print(f"float model: {100 * right / len(floats):.2f} % ({100 * low:.1f} … {100 * high:.1f})\n")
    print("\n".join(rows(results, test.labels)))


if __name__ == "__main__":
    main()
