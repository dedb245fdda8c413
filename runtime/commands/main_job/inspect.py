"""The command ``inspect``: what is in a netlist or a checkpoint."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Self

import numpy as np

from spikeloom.compiler.archive import is_netlist
from spikeloom.compiler.counters import Counters
from spikeloom.compiler.dynamics import Dynamics
from spikeloom.compiler.formats.counters import read_counters
from spikeloom.compiler.systems import GRAPH_SYSTEMS, TACTILESGNET
from spikeloom.runtime.inputs.checkpoint import load_checkpoint
from spikeloom.runtime.inputs.files import require_inspectable, shipped
from spikeloom.runtime.inputs.network import COUNTING
from spikeloom.runtime.inputs.repeat import NETWORK, refuse
from spikeloom.runtime.machines.backends import describe, trained_for
from spikeloom.runtime.report.checkpoints import LayerSize, tower_line
from spikeloom.runtime.report.encode import OPTIONAL
from spikeloom.runtime.report.sections import Outcome, Section, Text
from spikeloom.runtime.report.shown import Shown
from spikeloom.runtime.requests.main_job import InspectRequest

CLOCKING = ("parts", "bins", "steps", "ramp")
"""What a counting network says of time."""

LONG = 100
"""Letters of a training note that are shown."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class CheckpointFacts(Shown):
    """A checkpoint; `given` and `assumed` name the constants that the user gave, or neither user nor file."""

    layout: str
    system: str
    taxels: int
    classes: int
    hops: int | None = field(metadata=OPTIONAL)
    towers: int | None = field(metadata=OPTIONAL)
    bins: int | None = field(metadata=OPTIONAL)
    layers: Sequence[LayerSize]
    beta: float
    theta: float
    dynamics: Dynamics | None = field(metadata=OPTIONAL)
    given: Sequence[str]
    assumed: Sequence[str]
    graph: str | None
    training: Mapping[str, Any] | None
    sha256: str


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class CountingFacts(Shown):
    """A counting network."""

    taxels: int
    classes: int
    bins: int
    steps: int
    parts: int
    ramp: int
    counters: int
    thresholds: Sequence[int]
    training: Mapping[str, Any]
    sha256: str

    @classmethod
    def of(cls, found: Counters, sha256: str) -> Self:
        """Those of a file."""
        same = {name: getattr(found, name) for name in ("taxels", "classes", *CLOCKING, "training")}
        thresholds = np.unique(found.counter[:, 2]).tolist()
        return cls(**same, counters=len(found.counter), thresholds=thresholds, sha256=sha256)


def counting_sections(facts: CountingFacts) -> Iterator[Section]:
    """The same for people."""
    lines = [f"counting network: {facts.taxels} taxels, {facts.counters} counters, {facts.classes} classes"]
    known = asdict(facts) | dict(facts.training)
    shown = ("thresholds", *CLOCKING, *facts.training, "sha256")
    yield Section("", [*map(Text, [*lines, *_values({name: known[name] for name in shown})])])


REQUEST = InspectRequest


def run(request: InspectRequest) -> Outcome:
    """Run the command."""
    require_inspectable(request.path)
    backend = trained_for(request.path)
    if backend is not None:
        return backend.inspect(request)
    if is_netlist(request.path):
        refuse(request, NETWORK, f"is for checkpoints, {request.path} is a netlist")
        return describe(request.path)
    if COUNTING.takes(request.path):
        refuse(request, NETWORK, f"is for checkpoints, {request.path} is a counting network")
        counters, sha256 = read_counters(shipped(request.path))
        return Outcome(CountingFacts.of(counters, sha256), counting_sections)
    given = tuple(name for name in ("beta", "theta") if getattr(request, name) is not None)
    checkpoint = load_checkpoint(request.path, request)
    same = (
        "layout",
        "system",
        "taxels",
        "classes",
        "beta",
        "theta",
        "assumed",
        "graph",
        "training",
        "sha256",
    )
    facts = CheckpointFacts(
        **{name: getattr(checkpoint, name) for name in same},
        hops=len(checkpoint.hops) - 1 if checkpoint.system == TACTILESGNET else None,
        towers=checkpoint.towers if checkpoint.towers > 1 else None,
        bins=checkpoint.bins if checkpoint.bins > 1 else None,
        layers=[LayerSize(name=name, neurons=neurons) for name, neurons in checkpoint.neurons.items()],
        dynamics=None if checkpoint.dynamics.is_plain else checkpoint.dynamics,
        given=given,
    )
    return Outcome(facts, sections)


def sections(facts: CheckpointFacts) -> Iterator[Section]:
    """A checkpoint for people."""
    yield Section("", [*map(Text, _lines(facts))])


def _lines(facts: CheckpointFacts) -> Iterator[str]:
    layers = ", ".join(f"{layer.name} {layer.neurons:,}" for layer in facts.layers)
    system = facts.system if facts.hops is None else f"K = {facts.hops}"
    yield f"checkpoint, {facts.layout} layout: {facts.taxels} taxels, {system}, {layers}, {facts.classes} classes"
    graph = facts.graph or "not in the file; compile takes --graph"
    yield f"  graph: {graph if facts.system in GRAPH_SYSTEMS else 'none, as the system has none'}"
    for name, value in (("beta", facts.beta), ("theta", facts.theta)):
        source = "given" if name in facts.given else "read from the file"
        yield f"  {name}: {value:g} ({f'assumed; override with --{name}' if name in facts.assumed else source})"
    if facts.dynamics is not None:
        yield from _dynamics(facts.layers, facts.dynamics)
    if facts.bins is not None:
        yield f"  a step joins {facts.bins} bins of the recordings"
    training = dict(facts.training or {})
    if facts.towers is not None:
        yield f"  {facts.towers} towers vote together, each with a neuron for every class"
        for index, tower in enumerate(training.pop("towers", ())):
            yield f"    {index}: {tower_line(tower)}"
    yield from _values(training | {"sha256": facts.sha256})


def _values(known: Mapping[str, Any]) -> Iterator[str]:
    for key, value in known.items():
        text = str(value)
        yield f"  {key}: {text if len(text) <= LONG else text[: LONG - 3] + '…'}"


def _dynamics(layers: Sequence[LayerSize], dynamics: Dynamics) -> Iterator[str]:
    for decays, word in ((dynamics.betas, "membrane"), (dynamics.alphas, "current")):
        if decays:
            shown = ", ".join(f"{layer.name} {decay:g}" for layer, decay in zip(layers, decays, strict=True))
            yield f"  {word} decay by layer: {shown}"
    clocks = dynamics.clocks
    if clocks.channels:
        total = clocks.channels * clocks.steps
        yield f"  {clocks.channels} clocks of {clocks.steps} steps each, {total} in all, beside the sensor"
