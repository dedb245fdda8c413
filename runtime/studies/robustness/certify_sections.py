"""Certificates, laid out for terminals, and the picture of a sensor and of what hangs on its taxels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product

import numpy as np

from spikeloom.compiler.types import FloatArray, IntArray
from spikeloom.runtime.report.drawing import GREY, Drawing, sheet, styled
from spikeloom.runtime.report.numbers import percent
from spikeloom.runtime.report.sections import Section, Table, Text
from spikeloom.runtime.studies.robustness.perturbations import EXHAUSTIVE
from spikeloom.runtime.studies.robustness.results import PHASES, Certificate, Certificates

SHOWN = 20
"""Recordings and taxels that a terminal shows."""

PANELS = {"dead": "dies", "stuck": "is stuck", "event": "sends one event more or less"}

KEY = (
    "at least: no change of so many events alters the decision, proven; at most: smallest change known to "
    "alter it; taxels: on which a decision hangs"
)


def sections(result: Certificates) -> Iterator[Section]:
    """How many decisions stand, kind by kind; how many events they bear; what alters the others."""
    certificates = result.certificates
    count = len(certificates)
    lines = [
        f"right: {percent(sum(each.right for each in certificates), count)}",
        f"no single event alters the decision: {percent(result.certified(1), count)}",
    ]
    compared = [each for each in certificates if each.model is not None]
    if compared:
        alike = [each.alike for each in compared if each.alike is not None]
        lines += [
            f"float model and chip decide alike: {percent(len(alike), len(compared))}",
            f"alike whichever single event changes, proven: {percent(sum(map(bool, alike)), len(compared))}",
        ]
    rows = [
        [
            kind.what,
            f"{result.unaltered(name)} of {count}",
            f"{sum(each.kinds[name].tried for each in certificates):,}",
            f"{sum(each.kinds[name].alter for each in certificates):,}",
            _size([each.kinds[name].least for each in certificates]) if kind.sized else "",
        ]
        for name, kind in EXHAUSTIVE.items()
    ]
    head = ["change", "decisions that stand", "tried", "alter", "smallest that alters, median"]
    yield Section("Verdicts", [Text("\n".join(lines)), Table(head, rows)])
    yield Section("Events", [_radii(result), Text(KEY)])
    hanging = hanging_on(result)
    most = np.argsort(-sum(hanging.values()), kind="stable")
    taxels = [[str(taxel), *(str(each[taxel]) for each in hanging.values())] for taxel in most.tolist()]
    head = ["taxel", *PANELS.values()]
    yield Section("Decisions that depend on a taxel", [Table(head, taxels, most=SHOWN)])
    phases = np.sum([each.phases for each in certificates], axis=0)
    if phases.any():
        cells = [f"{100 * each / phases.sum():.0f} %" for each in phases]
        head = ["tenth of the recording", *(str(phase + 1) for phase in range(PHASES))]
        yield Section("When single events alter", [Table(head, [["of them", *cells]])])
    fragile = sorted(certificates, key=lambda each: (each.at_least, each.ahead))
    head = ["recording", "label", "decided", "ahead", "at least", "at most", "alters"]
    rows = [_row(each, result.class_names) for each in fragile]
    yield Section("The least stable", [Table(head, rows, words=True, most=SHOWN)])


def _size(least: list[int | None]) -> str:
    """Median over all recordings; those in which none alters are beyond every number."""
    middle = sorted(least, key=lambda size: np.inf if size is None else size)[len(least) // 2]
    return "none" if middle is None else f"{middle} bins"


def _radii(result: Certificates) -> Table:
    """Recordings by how many events they bear."""
    count = len(result.certificates)
    compared = any(each.model is not None for each in result.certificates)
    rows = []
    for events in (1, 2, 3, 4, 6, 8, 12, 16):
        if events <= result.most:
            broken = sum(each.at_most is not None and each.at_most <= events for each in result.certificates)
            sure = result.certified(events)
            alike = sum((each.alike or 0) >= events for each in result.certificates)
            row = [str(events), f"{sure} of {count}", f"{broken}", f"{count - sure - broken}"]
            rows.append([*row, f"{alike} of {count}"] if compared else row)
    head = ["changed events", "proven to stand", "shown to fall", "open"]
    return Table([*head, "float model alike"] if compared else head, rows)


def _row(one: Certificate, names: Sequence[str] | None) -> list[str]:
    called = [each if names is None else names[each] for each in (one.label, one.decision)]
    kinds = [name for name, kind in one.kinds.items() if kind.alter]
    most = "–" if one.at_most is None else str(one.at_most)
    words = [one.file, *called, one.ahead, one.at_least, most]
    return [*map(str, words), ", ".join(kinds) or "–"]


def hanging_on(result: Certificates) -> dict[str, IntArray]:
    """Decisions that depend on each taxel: on its failure, and on any of its events."""
    kinds = {"dead": ("dead",), "stuck": ("stuck",), "event": ("removed", "added")}
    hanging = {name: np.zeros(result.taxels, np.int64) for name in kinds}
    for (name, of), one in product(kinds.items(), result.certificates):
        hanging[name][list({taxel for kind in of for taxel in one.taxels[kind]})] += 1
    return hanging


def _places(result: Certificates) -> FloatArray:
    """Where taxels lie: on the sensor that is known, else on a circle."""
    if result.places is not None:
        return result.places[:, :2]
    taxels = result.taxels
    turn = 2 * np.pi * np.arange(taxels) / taxels
    return np.stack([np.cos(turn), np.sin(turn)], axis=1)


@styled()
def taxel_map(result: Certificates) -> Drawing:
    """Taxels where they lie, coloured by how many decisions depend on each."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    count = len(result.certificates)
    name = "" if result.provenance is None else f"{result.provenance.netlist} on {result.provenance.data}: "
    title = f"{name}decisions, of {count}, that change if one taxel …"
    drawing = sheet(title, 4.2)
    drawing.figure.suptitle(title, fontsize=10)
    points = _places(result)
    panels = drawing.figure.subplots(1, len(PANELS))
    for axes, (kind, values) in zip(panels, hanging_on(result).items(), strict=True):
        colours = ScalarMappable(Normalize(0, max(int(values.max()), 1)), "YlOrRd")
        axes.scatter(*points.T, s=190, c=colours.to_rgba(values), edgecolors=GREY, linewidths=0.6)
        for taxel, ((x, y), value) in enumerate(zip(points.tolist(), values.tolist(), strict=True)):
            dark = value > 0.6 * max(int(values.max()), 1)
            colour = "white" if dark else "black"
            axes.text(x, y, str(value), ha="center", va="center", fontsize=6, color=colour)
            tip = f"taxel {taxel} {PANELS[kind]}: {value} of {count} decisions change"
            drawing.tips.append((axes, x, y, tip))
        axes.set(title=f"… {PANELS[kind]}", aspect="equal")
        axes.margins(0.12)
        axes.axis("off")
        drawing.figure.colorbar(colours, ax=axes, orientation="horizontal", shrink=0.8, label="decisions")
    return drawing
