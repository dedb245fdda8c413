"""What ``lean`` returns and prints: what is used, what may go, and what that changes and saves."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from spikeloom.runtime.report.encode import INLINE, OPTIONAL
from spikeloom.runtime.report.numbers import percent, si
from spikeloom.runtime.report.sections import Section, Table, Text
from spikeloom.runtime.report.shown import Shown
from spikeloom.runtime.studies.search.results import NetlistCosts


@dataclass(frozen=True, slots=True, kw_only=True)
class Removed:
    """What is taken away: hops and taxels by number, neurons of each layer."""

    hops: tuple[int, ...] | None = field(default=None, metadata=OPTIONAL)
    taxels: tuple[int, ...] | None = field(default=None, metadata=OPTIONAL)
    neurons: Mapping[str, int] | None = field(default=None, metadata=OPTIONAL)


@dataclass(frozen=True, slots=True, kw_only=True)
class Changed:
    """Decisions that differ from those of the whole network, right ones, and those that become right or wrong."""

    differ: int
    right: int
    gained: int
    lost: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """The network without something."""

    name: str
    removed: Removed
    training: Changed
    test: Changed
    costs: NetlistCosts = field(metadata=INLINE)


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerUse:
    """Neurons of a layer: of the model, on the chip, and of these the ones that never fired in training."""

    name: str
    neurons: int
    on_chip: int
    never_fired: int


@dataclass(frozen=True, slots=True, kw_only=True)
class TaxelUse:
    """Training events of a taxel, and training decisions that change without it."""

    events: int
    training_differ: int


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Lean(Shown):
    """What a network can do without; the first row is the whole one.

    `samples` counts recordings of ``training`` and ``test``. `taken` is the row of least energy in training
    among those that change few enough decisions.
    """

    taken: int
    samples: Mapping[str, int]
    layers: tuple[LayerUse, ...]
    taxels: tuple[TaxelUse, ...]
    rows: tuple[Row, ...]
    source: str
    split: str
    differ: float
    output: str | None


def sections(result: Lean) -> list[Section]:
    """Use of layers and taxels, every row, and what is taken."""
    trained = result.samples["training"]
    tested = result.samples["test"]
    whole = result.rows[0]
    taken = result.rows[result.taken]
    layers = [[e.name, *(f"{n:,}" for n in (e.neurons, e.on_chip, e.never_fired))] for e in result.layers]
    right = f"{percent(whole.test.right, tested)} on {result.split}, {whole.training.right} of {trained} in training"
    last = [f"least energy in training: {taken.name}", *_removed(taken.removed)]
    last += [] if result.output is None else [f"written without them: {result.output}"]
    return [
        Section("Accuracy", [Text(f"chip accuracy: {right}")]),
        Section(
            "Use",
            [
                Table(["layer", "neurons", "on chip", "never fired in training"], layers),
                Text(_taxels(result.taxels)),
            ],
        ),
        Section("Without", [_rows(result)]),
        Section("Taken", [Text("\n".join(last))]),
    ]


def _taxels(taxels: Sequence[TaxelUse]) -> str:
    """Taxels without which nothing changes, and the one that matters most."""
    silent = [str(i) for i, taxel in enumerate(taxels) if not taxel.events]
    free = [str(i) for i, taxel in enumerate(taxels) if taxel.events and not taxel.training_differ]
    most = max(range(len(taxels)), key=lambda i: taxels[i].training_differ)
    return (
        f"{len(silent)} of {len(taxels)} taxels without an event in training{_listed(silent)}\n"
        f"{len(free)} more without which, one at a time, no training decision changes{_listed(free)}\n"
        f"taxel {most} matters most: {taxels[most].training_differ} training decisions change without it"
    )


def _listed(names: Sequence[str]) -> str:
    return f" ({', '.join(names)})" if names else ""


def _rows(result: Lean) -> Table:
    trained = result.samples["training"]
    tested = result.samples["test"]
    whole = result.rows[0].costs
    head = ["without", "differ in training", "differ", "right", "operations", "saved"]
    head += [word for name in whole.energy_j for word in (name, "saved")]
    head += [*(f"time, {name}" for name in whole.time_s), "neurons", "cores"]
    body = []
    for row in result.rows:
        costs = row.costs
        cells = [row.name, f"{row.training.differ} of {trained}", f"{row.test.differ} of {tested}"]
        cells += [
            str(row.test.right),
            f"{costs.operations:,.0f}",
            _saved(costs.operations, whole.operations),
        ]
        for name, joules in costs.energy_j.items():
            cells += [si(joules, "J"), _saved(joules, whole.energy_j[name])]
        cells += [si(each, "s") for each in costs.time_s.values()]
        body.append([*cells, f"{costs.neurons:,}", str(costs.cores)])
    return Table(head, body)


def _saved(left: float, whole: float) -> str:
    return f"{100 * (1 - left / whole):.1f} %" if whole else ""


def _removed(gone: Removed) -> list[str]:
    """What went, of each kind."""
    neurons = [f"{name} {count:,}" for name, count in (gone.neurons or {}).items()]
    parts = {"hops": gone.hops, "taxels": gone.taxels, "neurons": neurons}
    return [f"{what} that went: {', '.join(map(str, names))}" for what, names in parts.items() if names]
