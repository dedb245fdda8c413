"""An explanation laid out for people."""

from __future__ import annotations

from textwrap import wrap

from spikeloom.runtime.equivalence.explanation.replay import TIE
from spikeloom.runtime.equivalence.explanation.results import Explained, RootCause
from spikeloom.runtime.report.sections import Section, Table, Text

WIDTH = 116
"""Columns of a line of text."""


def sections(found: Explained) -> list[Section]:
    """Where they differ, why, and the roots that drag most along."""
    where = f"{found.sample} ({found.split} split, recording {found.recording} counted from 0)"
    faults = [Text("\n".join(wrap(f"FAULT of the netlist: {fault}", WIDTH))) for fault in found.faults]
    why = found.explanation
    if not why.different:
        what = where if found.searched == 1 else f"the first {found.searched} recordings of the {found.split} split"
        equal = Text(f"{what}: every spike of the chip is the float64 model's; nothing to explain")
        return [Section("", [equal, *faults])]
    columns = ("float_spikes", "chip_spikes", "different", "roots", "propagated")
    layers = Table(
        ["layer", *(column.replace("_", " ") for column in columns)],
        [[layer.name, *(f"{getattr(layer, column):,}" for column in columns)] for layer in why.layers],
    )
    names = [layer.name for layer in why.layers]
    causes = Table(
        ["cause of roots", *names, "all"],
        [[each.cause, *(f"{each.layers[name]:,}" for name in names), f"{each.roots:,}"] for each in why.causes],
    )
    clipped = sum(cause.from_clipped_weights for cause in why.causes)
    line = f"  {clipped:,} of these roots would go if no large weight were cut off by its range"
    shown = f" ({len(found.top):,} of {why.roots:,} shown, --top shows more)" if why.roots > len(found.top) else ""
    entries = (
        f"{why.different:,} entries (neuron and step) differ from the float64 model: {why.roots:,} are roots, "
        f"{why.different - why.roots:,} follow from them"
    )
    return [
        Section("", [Text(where), Text(entries)]),
        Section("Layers", [layers]),
        Section("Causes", [causes, *([Text(line)] if clipped else []), *faults]),
        Section("Diagnosis", [Text(f"diagnosis: {why.diagnosis}")]),
        Section("Roots", [Text(f"roots, those first that drag most along{shown}:")]),
        *(Section("", [Text("\n".join(_root(number, root)))]) for number, root in enumerate(found.top, 1)),
    ]


def _root(number: int, root: RootCause) -> list[str]:
    graph = "" if root.taxel is None else f" (taxel {root.taxel}, feature {root.feature})"
    fires = "the float model fires, the chip does not" if root.float_fires else "the chip fires, the float model not"
    chip = "does not hold this neuron"
    if root.chip_membrane is not None and root.chip_distance is not None and root.chip_theta is not None:
        chip = _membrane(root.chip_membrane, root.chip_distance, root.chip_theta)
        chip += f"; registers {root.chip_register} and {root.chip_threshold_register}"
    moved = root.moved.get(root.cause)
    by = "" if moved is None else f", which moved the membrane by {moved:.3g}"
    only = "" if not root.held or root.cause in (TIE, *root.sufficient) else "; no single change is enough here"
    follow = f"{root.dragged:,} later differences, {root.dragged_alone:,} of them from this root alone"
    return [
        f"{number:3}. {root.layer} neuron {root.neuron}{graph}, step {root.step}: {fires}",
        f"     float    {_membrane(root.float_membrane, root.float_distance, root.theta)}",
        f"     chip     {chip}",
        f"     cause    {root.cause}{by}{only}",
        f"     change   {root.change}",
        f"     drags    {follow}",
    ]


def _membrane(value: float, distance: float, theta: float) -> str:
    side = "above" if distance > 0 else "below"
    place = f"{abs(distance):.3g} {side}" if distance else "exactly at"
    return f"membrane {value:9.6f}, {place} the threshold {theta:.6g}"
