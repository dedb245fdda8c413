"""Accuracies by condition of the recordings, for people."""

from collections.abc import Mapping

from spikeloom.runtime.report.numbers import wilson
from spikeloom.runtime.report.sections import Table

UNSEEN = "conditions not seen in training were not tested"


def worst_and_best(accuracies: Mapping[str, float]) -> str:
    """Both ends of what is reached, with the names of their conditions.

    >>> worst_and_best({"speed=1": 0.5, "speed=2": 0.75, "force=1": 0.25})
    'worst 25.0 % (force=1), best 75.0 % (speed=2)'
    """
    worst = min(accuracies, key=accuracies.__getitem__)
    best = max(accuracies, key=accuracies.__getitem__)
    return f"worst {100 * accuracies[worst]:.1f} % ({worst}), best {100 * accuracies[best]:.1f} % ({best})"


def right_table(head: str, right: Mapping[str, tuple[int, int]]) -> Table:
    """Right decisions of so many recordings by name, each with its interval."""
    rows = []
    for name, (correct, samples) in right.items():
        low, high = wilson(correct, samples)
        accuracy = f"{100 * correct / samples:.2f} %"
        rows.append([name, f"{correct} of {samples}", accuracy, f"{100 * low:.1f} … {100 * high:.1f}"])
    return Table([head, "correct", "accuracy", "95 % interval"], rows)
