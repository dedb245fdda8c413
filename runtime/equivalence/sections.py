"""A verdict laid out for people."""

from __future__ import annotations

from spikeloom.runtime.equivalence.certificates import Certificate
from spikeloom.runtime.equivalence.verdict import Divergence, Verdict
from spikeloom.runtime.report.numbers import percent
from spikeloom.runtime.report.sections import Block, Section, Table, Text


def sections(verdict: Verdict) -> list[Section]:
    """Accuracies, levels and warnings; spikes; the ladder; the certificate; the first divergence."""
    spikes = [
        [name, *(f"{count:,}" for count in (layer.float, layer.chip, layer.different, layer.ill_posed))]
        for name, layer in verdict.spikes.items()
    ]
    ladder = [[rung.stage, *(f"{rung.different[name]:,}" for name in verdict.spikes)] for rung in verdict.ladder]
    first = verdict.first_divergence
    return [
        Section("Levels", [Text("\n".join(_lines(verdict)))]),
        Section("Spikes", [Table(["spikes", "float", "chip", "different", "ill-posed"], spikes)]),
        Section("Ladder", [Table(["different, adding", *verdict.spikes], ladder)]),
        Section("Certificate", certified(verdict.certificate)),
        Section("First divergence", [Text("no spike differs" if first is None else _divergence(first))]),
    ]


def _lines(verdict: Verdict) -> list[str]:
    right = {side: round(share * verdict.samples) for side, share in verdict.accuracy.items()}
    lines = [
        f"float accuracy:  {percent(right['float'], verdict.samples)}",
        f"chip accuracy:   {percent(right['chip'], verdict.samples)}",
        f"weights: {verdict.weights.text}",
        *(f"{level.name}  {level.text}" for level in verdict.levels),
        *(f"missed: {line}" for line in verdict.missed),
        *(f"breakdown: {breakdown.text}" for breakdown in verdict.breakdowns),
    ]
    if not verdict.same_checkpoint:
        lines.append(
            "note: the netlist was compiled from another checkpoint file than this one, or from other weights of it"
        )
    if verdict.not_compared:
        absent = ", ".join(f"{name} {count:,}" for name, count in verdict.not_compared.items())
        lines.append(f"not compared, left out because their spikes reach no neuron: {absent}")
    return lines


def certified(certificate: Certificate) -> list[Block]:
    """Entries that no order of summation changes, certified decisions, and whether registers stay in range."""
    rows = [
        [
            name,
            f"{layer.entries:,}",
            f"{100 * layer.equal / max(layer.entries, 1):.4f} %",
            f"{layer.different:,}",
            f"{layer.undecided:,}",
        ]
        for name, layer in certificate.layers.items()
    ]
    proof = "no register overflows for any input"
    if certificate.unproven:
        proof = f"some input may overflow a register of {', '.join(certificate.unproven)}: no proof of range"
    return [
        Table(["certified in any order of sums", "entries", "equal", "different", "undecided"], rows),
        Text(f"{certificate.decisions} of {certificate.samples} decisions certified equal; {proof}"),
    ]


def _divergence(first: Divergence) -> str:
    """Where the first spike differs, and how near both membranes were to their thresholds."""
    where = f"neuron {first.neuron}"
    if first.taxel is not None:
        where = f"taxel {first.taxel}, feature {first.feature}"
    return (
        f"first divergence: {first.file}, step {first.step}, {first.layer} {where}: membrane "
        f"{first.float_membrane:.6f} float, {first.chip_membrane:.6f} chip ({first.chip_register}/64 units); "
        f"threshold {first.theta:g} and {first.chip_theta:.6f}"
        + (" (ill-posed: float64 sides with the chip)" if first.ill_posed else "")
    )
