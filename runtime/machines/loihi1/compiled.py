"""What a compilation chose, proved and removed, and how ``compile`` shows it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from spikeloom.compiler.storage import Cheapest
from spikeloom.compiler.targets.loihi1.bounds import RangeProof, open_ranges
from spikeloom.compiler.targets.loihi1.layout.partition import core_bound
from spikeloom.compiler.targets.loihi1.layout.place import Placement
from spikeloom.compiler.targets.loihi1.passes import Compilation
from spikeloom.compiler.targets.loihi1.registers import ACCUMULATOR_MAX
from spikeloom.compiler.targets.loihi1.remove import Removal
from spikeloom.compiler.targets.loihi1.storage.choose_storage import Choice
from spikeloom.compiler.targets.loihi1.storage.ladder import Trial
from spikeloom.compiler.targets.loihi1.storage.spike_exact import Exactness
from spikeloom.models.recordings.counts import number
from spikeloom.runtime.machines.loihi1 import description
from spikeloom.runtime.machines.loihi1.description import NetlistFacts
from spikeloom.runtime.report.encode import INLINE, OPTIONAL
from spikeloom.runtime.report.sections import Block, Outcome, Section, Table, Text
from spikeloom.runtime.report.shown import Shown

ZEROED = 0.25
"""Share of a layer's weights from which on it is said that they round to zero."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class CompilationFacts(Shown):
    """A netlist with the reasons for its scales, the proofs and the placement.

    `facts` is what was read from a file of another format; `finetune` the command that helps where no
    storage keeps the share `keep` of the decisions.
    """

    netlist: NetlistFacts = field(metadata=INLINE)
    calibration: Sequence[Choice]
    proofs: Sequence[RangeProof]
    removals: Sequence[Removal]
    exactness: Sequence[Exactness]
    trials: Sequence[Trial]
    keep: float | None
    core_bound: int
    placement: Placement
    facts: Sequence[str] | None = field(default=None, metadata=OPTIONAL)
    finetune: str | None = field(default=None, metadata=OPTIONAL)


def outcome(
    done: Compilation, sha256: str, facts: Sequence[str] = (), finetune: str | None = None
) -> Outcome:
    """Facts of a compilation, whose netlist was written to a file with a hash, with their layout."""
    storage = done.options.storage
    keep = storage.keep if done.trials and isinstance(storage, Cheapest) else None
    result = CompilationFacts(
        netlist=description.describe(done.netlist, done.uses, sha256),
        calibration=done.choices,
        proofs=done.proofs,
        removals=done.removals,
        exactness=done.exactness,
        trials=done.trials,
        keep=keep,
        core_bound=core_bound(done.held, done.target),
        placement=done.placement,
        facts=facts or None,
        finetune=None if keep is None or _holds(done.trials, keep) else finetune,
    )
    return Outcome(result, sections)


def _holds(trials: Sequence[Trial], keep: float | None) -> bool:
    """Whether a storage that was tried keeps enough decisions."""
    return any(trial.equal >= (keep or 0) * trial.decisions for trial in trials if not trial.refused)


def sections(facts: CompilationFacts) -> Iterator[Section]:
    """Layers, limits, calibration, proof, placement."""
    if facts.facts:
        yield Section("", [*map(Text, facts.facts)])
    yield from description.sections(facts.netlist)
    yield Section("", [*_storage(facts), *map(Text, [*_removed(facts), *_proven(facts), *_placed(facts)])])


def _storage(facts: CompilationFacts) -> Iterator[Block]:
    """How weights were rounded."""
    if facts.calibration[0].flips is None:
        yield Text(
            "scales taken from the weights and the proven bounds; --calibrate chooses them on training data"
        )
    else:
        rows = [
            [
                choice.layer,
                str(choice.candidates),
                f"{choice.clipped:,}",
                "cancel" if choice.compensated else "nearest",
                f"{choice.flips:,}",
                f"{choice.spikes:,}",
            ]
            for choice in facts.calibration
        ]
        receives = (
            "the float model's own input" if facts.exactness else "what the rounded ones before it send"
        )
        yield Text(f"storage chosen on training recordings (each layer on {receives}):")
        yield Table(["layer", "tried", "weights clipped", "errors", "spikes moved", "of"], rows)
        yield from _exactness(facts.exactness)
        yield from _tried(facts)
    for choice in facts.calibration:
        if choice.zeroed > ZEROED * choice.weights:
            yield Text(
                f"{choice.layer}: {100 * choice.zeroed / choice.weights:.0f} % of its weights round to zero; "
                "more --planes, --scale-groups or --weight-bits keep them"
            )
    for choice in facts.calibration:
        if choice.ties:
            remedy = "fewer --planes" if choice.planes > 1 else "more --weight-bits"
            yield Text(
                f"{choice.layer}: {number(choice.ties, 'neuron')} can get sums of exactly the threshold and, rounded, "
                f"may decide these otherwise than the float model; {remedy} can keep them"
            )


def _tried(facts: CompilationFacts) -> Iterator[Block]:
    """What cheaper storages lost, and what each costs."""
    if facts.keep is None:
        return
    rows = []
    for trial in facts.trials:
        name = f"{trial.planes} × 8 bits".removeprefix("1 × ") + (
            f", {trial.groups} scales" if trial.groups > 1 else ""
        )
        costs = [f"{trial.operations:,.0f}", f"{trial.synapse_words:,}", str(trial.cores)]
        kept = [f"{trial.equal} of {trial.decisions}", *costs]
        rows.append([name, *(["does not fit", "", "", ""] if trial.refused else kept)])
    chosen = rows[max(range(len(rows)), key=lambda row: facts.trials[row].equal)][0]
    if not any(trial.decisions for trial in facts.trials):
        yield Text(
            f"storage: {chosen}, untested: the float model decides no thinned, held-out training recording"
        )
        return
    why = "the cheapest that keeps" if _holds(facts.trials, facts.keep) else "which keeps most; none keeps"
    yield Text(
        f"storage: {chosen}, {why} {100 * facts.keep:g} % of the decisions of quarters of thinned, held-out training "
        "recordings:"
    )
    yield Table(["storage", "decisions kept", "operations a recording", "synapse words", "cores"], rows)
    if facts.finetune is not None:
        yield Text(
            f"--spike-exact names the registers in the way; to train on the chip's integers: {facts.finetune}"
        )


def _exactness(layers: Sequence[Exactness]) -> Iterator[Block]:
    """What was tried for equal spikes, and what is in the way."""
    if layers and not any(layer.flips for layer in layers):
        yield Text(
            "spike-exact: every spike of every layer on all training recordings is the float64 model's"
        )
    elif layers:
        rows = [
            [
                layer.layer,
                "  ".join(f"{planes}×{groups}: {moved:,}" for planes, groups, moved in layer.tried),
                f"{layer.flips:,} of {layer.spikes:,}",
                ", ".join(f"{name} {count:,}" for name, count in layer.limits),
                f"{layer.decay:,}",
            ]
            for layer in layers
        ]
        yield Text("spike-exact: not reached; spikes that still move on the training recordings")
        head = ["layer", "planes×groups: moved on 32", "moved on all", "limited by", "12-bit decay alone"]
        yield Table(head, rows)


def _removed(facts: CompilationFacts) -> Iterator[str]:
    """What the chip does not hold, and why."""
    reasons = {
        "that no input can make fire": [layer.silent for layer in facts.removals],
        "whose spikes reach no neuron": [layer.unread for layer in facts.removals],
        "that did not fire in training (by evidence, not by proof)": [
            layer.never_fired for layer in facts.removals
        ],
    }
    for why, neurons in reasons.items():
        counts = [f"{layer.layer} {n:,}" for layer, n in zip(facts.removals, neurons, strict=True) if n]
        if counts:
            yield f"left out, neurons {why}: {', '.join(counts)}"


def _proven(facts: CompilationFacts) -> Iterator[str]:
    """Whether registers stay in range, and what happens if some input brings one out of it."""
    worst = max(facts.proofs, key=lambda proof: proof.accumulator)
    loose = [proof for proof in facts.proofs if not proof.holds]
    if not loose:
        yield (
            f"proof: no register overflows for any input (fullest accumulator: {worst.layer}, "
            f"{100 * worst.accumulator / ACCUMULATOR_MAX:.1f} % of 21 bits)"
        )
    yield from open_ranges([each.layer for each in loose], [each.layer for each in loose if not each.stops])


def _placed(facts: CompilationFacts) -> Iterator[str]:
    placement = facts.placement
    spiking = " if every neuron spiked" if facts.calibration[0].flips is None else ""
    yield (
        f"cores: {facts.netlist.cores} used, {facts.core_bound} at least; "
        f"spike-hops a step{spiking}: {placement.spike_hops:.1f}"
    )
    if placement.between_chips:
        yield (
            f"packets a step that leave their chip{spiking}: {placement.between_chips:.1f}; "
            "links between chips are not modelled"
        )
