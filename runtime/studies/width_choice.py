"""The storage width of each layer, from what the decisions have to keep; :func:`compiler.search_widths` searches."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from spikeloom.compiler import WidthPoint, WidthSearch, widths_front
from spikeloom.runtime.report.encode import key
from spikeloom.runtime.report.numbers import percent
from spikeloom.runtime.report.sections import Block, Section, Table, Text

FIGURES = {"accuracy": "right", "agreement": "equal"}
"""What can be wanted, and the count of a point that tells it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BuiltPoint:
    """A combination of widths as the compiler builds it; shares of the recordings that were decided."""

    weight_bits: Sequence[int]
    words: int
    cores: int | None
    accuracy: float | None
    agreement: float

    def share(self, figure: str) -> float:
        """Accuracy or agreement."""
        return (self.accuracy or 0.0) if figure == "accuracy" else self.agreement


@dataclass(frozen=True, slots=True, kw_only=True)
class WrittenNetlist:
    """File of a netlist, and its hash."""

    file: str
    sha256: str


@dataclass(frozen=True, slots=True, kw_only=True)
class WidthChoice:
    """Widths that keep what is wanted: `wanted` holds the one figure and its share."""

    layers: Sequence[str]
    widths: Sequence[int]
    scale_groups: int
    combinations: int
    recordings: int
    available: int = field(metadata=key("of"))
    wanted: Mapping[str, float]
    float_accuracy: float | None
    front: Sequence[BuiltPoint]
    recommended: BuiltPoint | None
    command: str | None = None
    netlist: WrittenNetlist | None = None


def choose(
    made: WidthSearch,
    figure: str,
    wanted: float,
    *,
    layers: Sequence[str],
    widths: Sequence[int],
    groups: int,
    available: int,
) -> WidthChoice:
    """The front of a search by one of `FIGURES`, and its point of least memory that reaches the wanted share."""

    def built(point: WidthPoint) -> BuiltPoint:
        return BuiltPoint(
            weight_bits=point.bits,
            words=point.words,
            cores=point.cores,
            accuracy=None if point.right is None else point.right / made.samples,
            agreement=point.equal / made.samples,
        )

    front = [built(point) for point in widths_front(made.built, FIGURES[figure])]
    return WidthChoice(
        layers=layers,
        widths=widths,
        scale_groups=groups,
        combinations=len(made.points),
        recordings=made.samples,
        available=available,
        wanted={figure: wanted},
        float_accuracy=None if made.float_right is None else made.float_right / made.samples,
        front=front,
        recommended=next((point for point in front if point.share(figure) >= wanted - 1e-9), None),
    )


def sections(choice: WidthChoice) -> Iterator[Section]:
    """The front, the point to take, and the command that builds it."""
    yield Section("", [*_blocks(choice)])


def _blocks(choice: WidthChoice) -> Iterator[Block]:
    samples, recommended = choice.recordings, choice.recommended
    ((figure, wanted),) = choice.wanted.items()
    yield Text(
        f"{choice.combinations:,} combinations of widths on {samples} of {choice.available} training recordings\n"
        "training figures: they say how the combinations compare, not what the chip will reach on other recordings"
    )
    if choice.float_accuracy is not None:
        yield Text(f"float64 model: {percent(round(choice.float_accuracy * samples), samples)}")
    yield Text(f"most {figure} for the memory, least memory first:")
    rows = [
        [
            ",".join(map(str, point.weight_bits)),
            f"{point.words:,}",
            str(point.cores),
            *("" if share is None else f"{100 * share:.2f} %" for share in (point.accuracy, point.agreement)),
            "<-" if point == recommended else "",
        ]
        for point in choice.front
    ]
    yield Table([",".join(choice.layers), "words", "cores", *FIGURES, ""], rows)
    if recommended is None:
        best = max((point.share(figure) for point in choice.front), default=0.0)
        yield Text(f"no combination reaches {figure} {wanted:g}; the best has {best:.4f}")
        yield Text("  more --scale-groups or --widths may reach it; else fine-tune the network")
        return
    widths = ",".join(map(str, recommended.weight_bits))
    reached = percent(round(recommended.share(figure) * samples), samples)
    yield Text(f"{figure} {wanted:g} needs {widths}: {recommended.words:,} words; training {figure} {reached}")
    yield Text(f"  {choice.command}")
    if choice.netlist is not None:
        yield Text(f"  written: {choice.netlist.file}")
