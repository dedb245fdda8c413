"""What ``anytime --picture`` draws: accuracy against the window, when recordings stop, savings and what they change."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

Json = dict[str, Any]

SIDES = {"float": ("float model", "C1", "--", "s"), "chip": ("chip", "C0", "-", "o")}
"""Label, colour, line and marker."""

DPI = 110


def picture(report: Json) -> bytes:
    """Draw a report of ``anytime``; PNG."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, (windows, stops, savings) = plt.subplots(1, 3, figsize=(15.5, 4.6), layout="constrained")
    _windows(windows, report)
    _stops(stops, report)
    _savings(savings, report)
    figure.suptitle(f"{report['source']}, {report['samples']} recordings of split {report['split']}")
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=DPI)
    plt.close(figure)
    return content.getvalue()


def _windows(axes: Any, report: Json) -> None:
    """Accuracy of float model and chip with Wilson intervals, and the rules at their mean share of bins."""
    axes.set(title="accuracy against the window", xlabel="observed (% of the recording)", ylabel="right (%)")
    axes.grid(alpha=0.3)
    if not report["windows"]:
        axes.text(0.5, 0.5, "no labels", transform=axes.transAxes, ha="center", color="0.5")
        return
    shares = [window["percent"] for window in report["windows"]]
    for side, (label, colour, line, marker) in SIDES.items():
        if side in report["windows"][0]:
            right = [100 * window[side]["correct"] / report["labelled"] for window in report["windows"]]
            low, high = 100 * np.array([window[side]["interval"] for window in report["windows"]]).T
            axes.fill_between(shares, low, high, color=colour, alpha=0.13, linewidth=0)
            axes.plot(shares, right, line, color=colour, marker=marker, markersize=4, label=f"{label}, 95 % interval")
    axes.set_xlim(0, 102)
    axes.set_ylim(0, 100)
    _legend(axes)


def _drawn(report: Json) -> list[tuple[Json, str, str, str]]:
    """The proof, the chosen rule and the loosest one: each with label, colour and line."""
    rules = report["rules"]
    found = [(rules[0], "proven", "C0", "-")]
    if len(rules) > 1:
        shown = dict.fromkeys((report["chosen"], len(rules) - 1))
        for index, colour, line in zip(shown, ("C2", "C3"), ("--", ":"), strict=False):
            found.append((rules[index], f"sure, {100 * rules[index]['allowed']:g} %", colour, line))
    return found


def _stops(axes: Any, report: Json) -> None:
    """Share of recordings that have stopped, by chip step."""
    whole = max(report["chip_steps"])
    for rule, label, colour, line in _drawn(report):
        ends = np.sort(rule["samples"]["chip_steps"])
        stopped = 100 * np.arange(1, len(ends) + 1) / len(ends)
        axes.step([0, *ends, whole], [0, *stopped, 100], line, where="post", color=colour, linewidth=1.8, label=label)
        axes.axvline(ends.mean(), color=colour, linestyle=line, linewidth=0.8, alpha=0.6)
    axes.set(title="when recordings stop (thin: mean)", xlabel="chip steps", ylabel="stopped (%)")
    axes.set_xlim(0, whole)
    axes.set_ylim(0, 101)
    axes.grid(alpha=0.3)
    _legend(axes)


def _savings(axes: Any, report: Json) -> None:
    """Energy saved by each rule, and how many decisions it changes."""
    rules = report["rules"]
    names = ["proven", *(f"sure, {100 * rule['allowed']:g} %" for rule in rules[1:])]
    tables = list(rules[0]["saved"]["energy_j"])
    kinds: dict[str, list[float]] = {"operations": [100 * rule["saved"]["operations"] for rule in rules]}
    kinds |= {f"energy, {name}": [100 * rule["saved"]["energy_j"][name] for rule in rules] for name in tables}
    height = 0.8 / len(kinds)
    places = np.arange(len(rules))
    for index, (label, widths) in enumerate(kinds.items()):
        axes.barh(
            places + (index - (len(kinds) - 1) / 2) * height, widths, height * 0.92, label=label, color=f"C{index}"
        )
    longest = max(max(widths) for widths in kinds.values())
    for place, rule in zip(places, rules, strict=True):
        told = f"{rule['differ']} differ"
        if rule["correct"] is not None:
            told += f", {rule['correct'] - report['full']['correct']:+d} right"
        axes.text(longest * 1.03 + 0.5, place, told, va="center", fontsize=8)
    axes.set_yticks(places, names)
    axes.invert_yaxis()
    axes.set_xlim(0, max(1.0, longest) * 1.4)
    axes.set(title="saved, and what it changes", xlabel="saved (%)")
    axes.grid(axis="x", alpha=0.3)
    _legend(axes)


def _legend(axes: Any) -> None:
    """Below the panel, where nothing is."""
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=3, fontsize=8, frameon=False)
