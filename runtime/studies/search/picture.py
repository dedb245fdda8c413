"""The picture of a front: accuracy of candidates over a cost."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from spikeloom.runtime.report.drawing import COLOURS, GREY, MARKERS, Drawing, scale


@dataclass(frozen=True, slots=True, kw_only=True)
class Mark:
    """A candidate in a picture; accuracies with the ends of its interval are shares."""

    cost: float
    accuracy: float
    low: float
    high: float
    series: str  # Has a colour and a shape
    large: bool  # With its interval
    front: bool
    tip: str  # What the pointer reads

    @property
    def place(self) -> tuple[float, float]:
        """Where it stands."""
        return self.cost, 100 * self.accuracy


def draw_front(
    drawing: Drawing, panel: Any, marks: Sequence[Mark], chosen: Mark, unit: str, label: str
) -> None:
    """Draw marks over a cost, the front as a line and a ring around the choice; `unit` and `label` are the cost's."""
    from matplotlib.ticker import LogLocator, NullFormatter

    marks = [mark for mark in marks if mark.cost > 0]  # the axis is logarithmic
    for index, series in enumerate(dict.fromkeys(mark.series for mark in marks)):
        colour = COLOURS[index % len(COLOURS)]
        hollow = index // len(COLOURS) % 2 == 1
        for large in (False, True):
            places = [mark.place for mark in marks if mark.series == series and mark.large is large]
            look: dict[str, Any] = {"s": 12, "linewidths": 0.5, "alpha": 0.4}
            look = {"s": 42, "linewidths": 0.9, "zorder": 4, "label": series} if large else look
            look |= {"facecolors": "none" if hollow else colour, "edgecolors": "black" if large else colour}
            panel.scatter(*np.reshape(places, (-1, 2)).T, marker=MARKERS[index % len(MARKERS)], **look)
    if front := sorted(mark.place for mark in marks if mark.front):
        panel.step(*zip(*front, strict=True), where="post", color="black", lw=1.2, label="front")
    panel.plot(*chosen.place, "o", ms=12, mfc="none", mec="black", ls="none", label="choice", zorder=5)
    panel.set_xscale("log")
    panel.autoscale(False)  # intervals may reach far beyond the marks
    for mark in marks:
        if mark.large or mark is chosen:
            panel.plot(
                [mark.cost] * 2, [100 * mark.low, 100 * mark.high], color=GREY, lw=1.0, alpha=0.6, zorder=1
            )
    drawing.tips += [(panel, *mark.place, mark.tip) for mark in sorted(marks, key=lambda mark: mark.cost)]
    panel.set_xlabel(label)
    panel.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    panel.xaxis.set_minor_formatter(NullFormatter())
    scale(panel.xaxis, unit)
    panel.grid(True)
