"""Results as JSON values for machines and as plain tables for people."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from spikeloom.compiler import Compilation
from spikeloom.compiler.fixedpoint import ACCUMULATOR_MAX, CURRENT_MAX, FloatArray, IntArray
from spikeloom.compiler.formats.checkpoint import Checkpoint
from spikeloom.compiler.systems import GRAPH_SYSTEMS, TACTILESGNET
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.loihi1.layout.chips import chip_count
from spikeloom.compiler.targets.loihi1.layout.choose import Layout
from spikeloom.compiler.targets.loihi1.legalize import LimitUse
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.runtime.machines.loihi1.trace import BoolArray
from spikeloom.runtime.report.encode import encode
from spikeloom.runtime.report.tables import si, table

Json = dict[str, Any]

ZEROED = 0.25
"""Share of a layer's weights from which on it is said that they round to zero."""


# -- netlists and checkpoints ------------------------------------------------------------------------------------------


def netlist_json(netlist: Netlist, uses: Sequence[LimitUse], sha256: str) -> Json:
    """What a netlist is: sizes, layers, use of every limit."""
    core = netlist.core_of_compartment()
    layers = []
    for index, layer in enumerate(netlist.layers):
        ids = netlist.compartments_of(index)
        exponents = netlist.format_exponent[netlist.axon_format[netlist.axon_of_synapse()]]
        into = netlist.layer[netlist.synapse_compartment()] == index
        layers.append(
            {
                "name": layer.name,
                "neurons": layer.neurons,
                "compartments": len(ids),
                "synapses": layer.synapses,
                "max_fan_in": layer.max_fan_in,
                "weight_bits": layer.weight_bits,
                "scale": _one_or_many(netlist.scale[ids]),
                "exponents": sorted({int(e) for e in exponents[into]}),
                "threshold": _one_or_many(netlist.threshold[ids]),
                "theta": layer.theta,
                "theta_realised": _one_or_many(netlist.threshold[ids] / netlist.scale[ids]),
                "beta": layer.beta,
                "beta_realised": _one_or_many((4096 - netlist.decay_v[ids]) / 4096),
                **_lasting(netlist, index),
                "depth": layer.depth,
                "synapses_stored": int(np.count_nonzero(into)),
                **_from_itself(netlist, index, into),
                "cores": sorted({int(c) for c in core[ids]}),
            }
        )
    return {
        "target": netlist.target,
        "taxels": netlist.taxels,
        **({"clocks": asdict(netlist.clocks)} if netlist.clocks.channels else {}),
        **({"bins": netlist.bins} if netlist.bins > 1 else {}),
        "classes": netlist.classes,
        "neurons": sum(layer.neurons for layer in netlist.layers),
        "compartments": netlist.n_compartments,
        "synapses": sum(layer.synapses for layer in netlist.layers),
        "synapses_stored": netlist.n_synapses,
        "synapses_nonzero": int(np.count_nonzero(netlist.synapse_weight)),
        "cores": netlist.n_cores,
        "chips": chip_count(netlist.core_tile, load_target(netlist.target)),
        "tiles": netlist.core_tile.tolist(),
        "layers": layers,
        "limits": [asdict(use) for use in uses],
        "provenance": dict(netlist.provenance),
        "sha256": sha256,
    }


def _lasting(netlist: Netlist, layer: int) -> Json:
    """Current decay of a layer, where its current outlasts a step."""
    realised = (4095 - netlist.decay_u[netlist.compartments_of(layer)]) / 4096
    if not realised.any():
        return {}
    return {"alpha": netlist.layers[layer].alpha, "alpha_realised": _one_or_many(realised)}


def _from_itself(netlist: Netlist, layer: int, into: BoolArray) -> Json:
    """Stored synapses by which a layer hears itself, of those `into` it, where there are any."""
    source = netlist.axon_source[netlist.axon_of_synapse()[into]] - netlist.n_inputs
    own = int(np.count_nonzero(netlist.layer[source[source >= 0]] == layer))
    return {"synapses_from_itself": own} if own else {}


def _one_or_many(values: IntArray | FloatArray) -> Any:
    distinct = np.unique(values).tolist()
    return distinct[0] if len(distinct) == 1 else distinct


def compilation_json(compilation: Compilation, sha256: str) -> Json:
    """A netlist with the reasons for its scales, the proofs and the placement."""
    return netlist_json(compilation.netlist, compilation.uses, sha256) | {
        "calibration": [asdict(choice) for choice in compilation.choices],
        "proofs": [
            {key: value if value != math.inf else None for key, value in asdict(proof).items()} | {"holds": proof.holds}
            for proof in compilation.proofs
        ],
        "removals": [encode(layer) for layer in compilation.removals],
        "exactness": [asdict(layer) for layer in compilation.exactness],
        "core_bound": compilation.core_bound,
        "placement": asdict(compilation.placement),
        "layout": {
            "optimize": compilation.options.optimize,
            "expected": _expected(compilation.layout),
            "usual": _expected(compilation.usual),
        },
    }


def _expected(layout: Layout) -> Json:
    expected = layout.expected
    return {"cores": len(layout.parts.cores)} | (asdict(expected) if expected else {})


def netlist_text(report: Json) -> str:
    """Layers, cores and the fullest core of every limit."""
    lasts = any("alpha" in layer for layer in report["layers"])
    loops = any("synapses_from_itself" in layer for layer in report["layers"])
    layers = [
        [
            layer["name"],
            f"{layer['neurons']:,}",
            f"{layer['compartments']:,}",
            f"{layer['synapses']:,}",
            f"{layer['synapses_stored']:,}",
            *([f"{layer.get('synapses_from_itself', 0):,}"] if loops else []),
            str(layer["max_fan_in"]),
            _width(layer),
            _text(layer["scale"]),
            _text(layer["threshold"]),
            _text(layer["theta_realised"]),
            _text(layer["beta_realised"]),
            *([_text(layer.get("alpha_realised", 0))] if lasts else []),
            _text(layer["cores"], brief=False),
        ]
        for layer in report["layers"]
    ]
    head = [
        "layer",
        "neurons",
        "on chip",
        "synapses",
        "stored",
        *(["from itself"] if loops else []),
        "fan-in",
        "bits",
        "scale",
        "threshold",
        "θ",
        "β",
        *(["α"] if lasts else []),
        "cores",
    ]
    fullest: dict[str, Json] = {}
    for use in report["limits"]:
        if use["name"] not in fullest or use["used"] > fullest[use["name"]]["used"]:
            fullest[use["name"]] = use
    limits = [
        [
            use["name"],
            f"{use['used']:,}",
            f"{use['allowed']:,}",
            f"{100 * use['used'] / use['allowed']:.0f} %",
            "chip" if use["core"] is None else str(use["core"]),
        ]
        for use in fullest.values()
    ]
    where = f"{report['chips']} chips" if report["chips"] > 1 else f"tiles {', '.join(map(str, report['tiles']))}"
    left = "" if report["compartments"] == report["neurons"] else f" ({report['compartments']:,} on the chip)"
    return "\n".join(
        [
            f"{report['target']}: {report['neurons']:,} neurons{left}, {report['synapses']:,} synapses "
            f"({report['synapses_stored']:,} stored, {report['synapses_nonzero']:,} non-zero), {report['cores']} cores "
            f"on {where}",
            *_clock_lines(report),
            *_bin_lines(report),
            table(head, layers),
            "",
            table(["limit", "used", "allowed", "fill", "fullest core"], limits),
        ]
    )


def _unproven(proofs: list[Json]) -> list[str]:
    """Layers with a register that some input may bring out of its range, and what happens then."""
    loose = [proof for proof in proofs if not proof["holds"]]

    def may(proof: Json, register: str, most: int) -> bool:
        return proof[register] is None or proof[register] > most

    stops = [p["layer"] for p in loose if may(p, "accumulator", ACCUMULATOR_MAX) or may(p, "current", CURRENT_MAX)]
    clips = [proof["layer"] for proof in loose if proof["layer"] not in stops]
    lines = [f"no proof of range for {', '.join(stops)}: the simulator stops at the first overflow"] if stops else []
    if clips:
        lines.append(f"no register of {', '.join(clips)} overflows for any input, but some may saturate a membrane")
    return lines


def _clock_lines(report: Json) -> list[str]:
    """What the clocks of a network are; none for most."""
    if "clocks" not in report:
        return []
    channels, steps = report["clocks"]["channels"], report["clocks"]["steps"]
    return [f"  {channels} clocks of {steps} steps each, {channels * steps} in all, beside the sensor"]


def _bin_lines(report: Json) -> list[str]:
    """How long the steps of a network are; nothing of those that hear the bins of the recordings."""
    return [f"  a step joins {report['bins']} bins of the recordings"] if "bins" in report else []


def _width(layer: Json) -> str:
    """Storage width of a synapse: bits, times planes where there are several."""
    planes = len(layer["exponents"])
    return f"{planes}×{layer['weight_bits']}" if planes > 1 else str(layer["weight_bits"])


def _text(value: Any, *, brief: bool = True) -> str:
    if isinstance(value, list):
        ends = f"{min(value):.6g}", f"{max(value):.6g}"
        return ("…".join(ends) if ends[0] != ends[1] else ends[0]) if brief and value else " ".join(map(str, value))
    return f"{value:.6g}"


def compilation_text(report: Json) -> str:
    """A compilation for people: layers, limits, calibration, proof, placement."""
    lines = [netlist_text(report), ""]
    calibrated = report["calibration"][0]["flips"] is not None
    if calibrated:
        rows = [
            [
                choice["layer"],
                str(choice["candidates"]),
                f"{choice['clipped']:,}",
                "cancel" if choice["compensated"] else "nearest",
                f"{choice['flips']:,}",
                f"{choice['spikes']:,}",
            ]
            for choice in report["calibration"]
        ]
        lines.append("storage chosen on training recordings (each layer on the float model's own input):")
        lines.append(table(["layer", "tried", "weights clipped", "errors", "spikes moved", "of"], rows))
        lines += _exactness_lines(report["exactness"])
    else:
        lines.append("scales taken from the weights and the proven bounds; --calibrate chooses them on training data")
    lines += [
        f"{choice['layer']}: {100 * choice['zeroed'] / choice['weights']:.0f} % of its weights round to zero; "
        "more --planes, --scale-groups or --weight-bits keep them"
        for choice in report["calibration"]
        if choice["zeroed"] > ZEROED * choice["weights"]
    ]
    lines += _removal_lines(report["removals"])
    worst = max(report["proofs"], key=lambda proof: proof["accumulator"])
    if all(proof["holds"] for proof in report["proofs"]):
        lines.append(
            f"proof: no register overflows for any input (fullest accumulator: {worst['layer']}, "
            f"{100 * worst['accumulator'] / (2**21 - 1):.1f} % of 21 bits)"
        )
    else:
        lines += _unproven(report["proofs"])
    placement = report["placement"]
    optimal = "optimal" if placement["spike_hops"] <= placement["bound"] else f"bound {placement['bound']:.1f}"
    lines.append(
        f"cores: {report['cores']} used, {report['core_bound']} at least; "
        f"spike-hops a step{'' if calibrated else ' if every neuron spiked'}: {placement['spike_hops']:.1f} ({optimal})"
    )
    if placement["between_chips"]:
        lines.append(
            f"packets a step that leave their chip{'' if calibrated else ' if every neuron spiked'}: "
            f"{placement['between_chips']:.1f}; links between chips are not modelled"
        )
    lines += _layout_lines(report["layout"], report["layers"])
    return "\n".join(lines)


def _layout_lines(layout: Json, layers: list[Json]) -> list[str]:
    """What a step is expected to take, and what another layout would."""
    chosen, usual = layout["expected"], layout["usual"]
    if "step_ns" not in chosen:
        return []
    core = chosen["critical_core"]
    held = ", ".join(layer["name"] for layer in layers if core in layer["cores"])
    lines = [
        f"expected step on the training recordings ({chosen['time_table']} table): {chosen['step_ns']:,.0f} ns, "
        f"{si(chosen['step_j'], 'J')}; slowest most often: core {core} ({held}), "
        f"{'receiving' if chosen['receiving'] else 'sweeping its neurons and sending'}"
    ]
    if chosen != usual:
        time, energy = (chosen[key] / usual[key] for key in ("step_ns", "step_j"))
        lines.append(
            f"layout of fewest cores: {usual['cores']} instead of {chosen['cores']}, {usual['step_ns']:,.0f} ns, "
            f"{si(usual['step_j'], 'J')}; this one takes {time:.2f} times the time and {energy:.2f} times the energy"
        )
    elif layout["optimize"] != "cores":
        lines.append(f"--optimize {layout['optimize']}: found nothing better than the layout of fewest cores")
    return lines


def _removal_lines(layers: list[Json]) -> list[str]:
    """What the chip does not hold, and why."""
    words = {
        "silent": "that no input can make fire",
        "unheard": "that nobody hears",
        "unused": "that did not fire in training (by evidence, not by proof)",
    }
    lines = []
    for key, why in words.items():
        counts = [f"{layer['layer']} {layer[key]:,}" for layer in layers if layer[key]]
        if counts:
            lines.append(f"left out, neurons {why}: {', '.join(counts)}")
    return lines


def _exactness_lines(layers: list[Json]) -> list[str]:
    """What was tried for equal spikes, and what is in the way."""
    if not layers:
        return []
    if not any(layer["flips"] for layer in layers):
        return ["spike-exact: every spike of every layer on all training recordings is the float64 model's"]
    rows = [
        [
            layer["layer"],
            "  ".join(f"{planes}×{groups}: {moved:,}" for planes, groups, moved in layer["tried"]),
            f"{layer['flips']:,} of {layer['spikes']:,}",
            ", ".join(f"{name} {count:,}" for name, count in layer["limits"]),
            f"{layer['decay']:,}",
        ]
        for layer in layers
    ]
    head = ["layer", "planes×groups: moved on 32", "moved on all", "limited by", "12-bit decay alone"]
    return ["spike-exact: not reached; spikes that still move on the training recordings", table(head, rows)]


def checkpoint_json(checkpoint: Checkpoint, given: tuple[str, ...]) -> Json:
    """What a checkpoint holds, and what of it the user gave or was assumed."""
    return {
        "layout": checkpoint.layout,
        "system": checkpoint.system,
        "taxels": checkpoint.taxels,
        "classes": checkpoint.classes,
        **({"hops": int(checkpoint.hops.shape[0] - 1)} if checkpoint.system == TACTILESGNET else {}),
        **({"towers": checkpoint.towers} if checkpoint.towers > 1 else {}),
        **({"bins": checkpoint.bins} if checkpoint.bins > 1 else {}),
        "layers": [{"name": name, "neurons": neurons} for name, neurons in checkpoint.neurons.items()],
        "beta": checkpoint.beta,
        "theta": checkpoint.theta,
        **({} if checkpoint.dynamics.is_plain else {"dynamics": checkpoint.dynamics.to_json()}),
        "given": list(given),
        "assumed": list(checkpoint.assumed),
        "graph": checkpoint.graph,
        "training": None if checkpoint.training is None else dict(checkpoint.training),
        "sha256": checkpoint.sha256,
    }


def tower_line(tower: Json) -> str:
    """Where a tower of a joined network is from, in one line."""
    facts = (f"{key} {tower[key]}" for key in ("weights", "seed", "sha256") if key in tower)
    return f"{tower.get('file')}, {', '.join(facts)}"


def checkpoint_text(report: Json) -> str:
    """A checkpoint for people."""
    layers = ", ".join(f"{layer['name']} {layer['neurons']:,}" for layer in report["layers"])
    system = f"K = {report['hops']}" if "hops" in report else report["system"]
    graph = report["graph"] or "not in the file; name it with --graph"
    lines = [
        f"checkpoint, {report['layout']} layout: {report['taxels']} taxels, {system}, {layers}, "
        f"{report['classes']} classes",
        f"  graph: {graph if report['system'] in GRAPH_SYSTEMS else 'none, as the system has none'}",
    ]
    for name in ("beta", "theta"):
        source = "given" if name in report["given"] else "read from the file"
        if name in report["assumed"]:
            source = f"assumed; override with --{name}"
        lines.append(f"  {name}: {report[name]:g} ({source})")
    if "dynamics" in report:
        for key, word in (("betas", "membrane"), ("alphas", "current")):
            if report["dynamics"][key]:
                shown = ", ".join(
                    f"{layer['name']} {d:g}" for layer, d in zip(report["layers"], report["dynamics"][key], strict=True)
                )
                lines.append(f"  {word} decay by layer: {shown}")
        lines += _clock_lines(report["dynamics"] if report["dynamics"]["clocks"]["channels"] else {})
    lines += _bin_lines(report)
    training = dict(report["training"] or {})
    if "towers" in report:
        lines.append(f"  {report['towers']} towers vote together, each with a neuron for every class")
        for index, tower in enumerate(training.pop("towers", ())):
            lines.append(f"    {index}: {tower_line(tower)}")
    for key, value in training.items():
        text = str(value)
        lines.append(f"  {key}: {text if len(text) <= 100 else text[:97] + '…'}")
    lines.append(f"  sha256: {report['sha256']}")
    return "\n".join(lines)
