"""What ``verify`` prints: a verdict as JSON values for machines and as text for people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from spikeloom.runtime.equivalence.certificates import certificate_json, certificate_text
from spikeloom.runtime.equivalence.levels import Level
from spikeloom.runtime.equivalence.verify import Verdict
from spikeloom.runtime.report.tables import percent, table

Json = dict[str, Any]


def verify_json(verdict: Verdict, levels: Sequence[Level], missed: Sequence[str]) -> Json:
    """A verdict under the keys that scripts rely on, its levels, and the required ones that were missed."""
    return {
        "samples": len(verdict.files),
        "accuracy": {"float": verdict.float_accuracy, "chip": verdict.chip_accuracy},
        "decision_agreement": verdict.decision_agreement,
        "spikes": {name: asdict(layer) for name, layer in verdict.spikes.items()},
        "spec_equals_engine": verdict.spec_equals_engine,
        "spec_samples": verdict.spec_samples,
        "engine": verdict.engine,
        "engine_different": verdict.engine_different,
        "first_divergence": None if verdict.first_divergence is None else asdict(verdict.first_divergence),
        "ladder": [{"stage": stage, "different": dict(different)} for stage, different in verdict.ladder],
        "same_checkpoint": verdict.same_checkpoint,
        "quantised_different": verdict.quantised_different,
        "certificate": certificate_json(verdict.certificate),
        "breakdowns": [asdict(breakdown) for breakdown in verdict.breakdowns],
        "not_compared": dict(verdict.not_compared),
        "levels": [asdict(level) for level in levels],
        "missed": list(missed),
    }


def verify_text(report: Json) -> str:
    """A verdict for people."""
    samples = report["samples"]
    right = {side: round(share * samples) for side, share in report["accuracy"].items()}
    lines = [
        f"float accuracy:  {percent(right['float'], samples)}",
        f"chip accuracy:   {percent(right['chip'], samples)}",
        *(f"{level['name']}  {level['text']}" for level in report["levels"]),
        *(f"missed: {line}" for line in report["missed"]),
        *(f"breakdown: {breakdown['text']}" for breakdown in report["breakdowns"]),
    ]
    if not report["same_checkpoint"]:
        lines.append(
            "note: the netlist was compiled from another checkpoint file than this one, or from other weights of it"
        )
    if report["not_compared"]:
        left = ", ".join(f"{name} {count:,}" for name, count in report["not_compared"].items())
        lines.append(f"not compared, left out because nobody hears them: {left}")
    names = list(report["spikes"])
    rows = [
        [name, *(f"{layer[key]:,}" for key in ("float", "chip", "different", "ill_posed"))]
        for name, layer in report["spikes"].items()
    ]
    lines += ["", table(["spikes", "float", "chip", "different", "ill-posed"], rows), ""]
    ladder = [[rung["stage"], *(f"{rung['different'][name]:,}" for name in names)] for rung in report["ladder"]]
    lines += [table(["different, adding", *names], ladder), "", certificate_text(report["certificate"]), ""]
    first = report["first_divergence"]
    lines.append("no spike differs" if first is None else f"first divergence: {divergence_text(first)}")
    return "\n".join(lines)


def divergence_text(first: Json) -> str:
    """Where the first spike differs, and how near both membranes were to their thresholds."""
    where = f"neuron {first['neuron']}"
    if first["taxel"] is not None:
        where = f"taxel {first['taxel']}, feature {first['feature']}"
    return (
        f"{first['file']}, step {first['step']}, {first['layer']} {where}: membrane "
        f"{first['float_membrane']:.6f} float, {first['chip_membrane']:.6f} chip "
        f"({first['chip_register']}/64 units); threshold {first['theta']:g} and {first['chip_theta']:.6f}"
        + (" (ill-posed: float64 sides with the chip)" if first["ill_posed"] else "")
    )
