"""How closely a chip follows the network that it was compiled from: one ladder for every chip.

EN, E0 and E1 hold the netlist against what its network is lowered to, E2 and E3 against a float model where
there is one. The float model runs in the released operator order, in float32. A float64 run stands beside
it: spikes in which the two differ are ill-posed, decided by the rounding of a sum and not by the chip.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from spikeloom.compiler.errors import DataError
from spikeloom.compiler.interpret import vote
from spikeloom.compiler.ir import Network
from spikeloom.compiler.targets.netlist_file import Netlist
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.equivalence.breakdowns import undecided
from spikeloom.runtime.equivalence.reference import require_match
from spikeloom.runtime.equivalence.tallies import Begin, FloatTally, ModelTally, Part
from spikeloom.runtime.equivalence.verdict import Verdict
from spikeloom.runtime.machines.backends import machine_of
from spikeloom.runtime.machines.base import Machine
from spikeloom.runtime.machines.capabilities import Comparable
from spikeloom.runtime.machines.netlist_check import NetlistCheck
from spikeloom.runtime.requests.main_job import ENGINES


def verify(
    netlist: Netlist,
    source: Any,
    data: Recordings,
    *,
    original: Network | None = None,
    spec_samples: int = 3,
    engine_name: str = ENGINES[0],
    required: Mapping[str, float] | None = None,
    check: NetlistCheck | None = None,
    progress: Begin | None = None,
) -> Verdict:
    """Compare network, chip and specification.

    Parameters
    ----------
    netlist, data : Netlist, Recordings
        For any chip; recordings in steps of the network.
    source : Network, NativeNetwork or Counters
        What the netlist was compiled from, or another network of the same architecture.
    original : Network, optional
        The float model of E2 and E3; by default `source`, where that is one.
    spec_samples : int
        Recordings on which the specification runs beside the engine.
    engine_name : str
        One of ``ENGINES``, which runs beside our engine on all recordings.
    required : mapping, optional
        Shares that levels have to reach, see :mod:`equivalence.verdict`; EN always.
    check, progress : NetlistCheck, callable, optional
        What is known of EN; see :data:`tallies.Begin`.

    Raises
    ------
    ModelError, DataError, NumericRangeError or OptionError
        If the parts do not belong together, a register of the chip overflows, or the further engine is not
        installed or cannot hold the netlist.
    """
    machine = machine_of(netlist)
    floats = source if original is None and isinstance(source, Network) else original
    begin = progress or (lambda _part, _done: None)
    _require_fit(machine, source, floats, spec_samples)
    lowered, reference = _tallies(machine, source, floats, len(data), begin)
    engines = _compare_engines(machine, data, min(spec_samples, len(data)), engine_name, begin)
    votes, saturated = _run(
        machine, data, [tally for tally in (lowered, reference) if tally is not None], begin
    )
    return Verdict(
        target=netlist.target,
        files=data.files,
        labels=data.labels,
        chip_predictions=vote(votes),
        chip_counts=votes,
        netlist=check or machine.check_lowering(source),
        model=None if lowered is None else lowered.layers,
        membranes_saturated=saturated,
        row_different=_different_in_a_row(machine, data, votes),
        required={} if required is None else required,
        **engines,
        **({} if reference is None else _of_floats(reference, votes, data.files)),
    )


def _tallies(
    machine: Machine, source: Any, floats: Network | None, recordings: int, begin: Begin
) -> tuple[ModelTally | None, FloatTally | None]:
    """What counts spikes of E1 and of E2, where the network has them."""
    model = machine.model(source)
    return (
        None if model is None else ModelTally(machine, model, begin),
        None if floats is None else FloatTally(machine, floats, recordings, begin),
    )


def _require_fit(machine: Machine, source: Any, floats: Network | None, spec_samples: int) -> None:
    """Refuse networks of another size, and a specification that would run on nothing."""
    if spec_samples < 1:
        raise DataError(
            f"--spec-samples {spec_samples}: at least 1 recording is needed; give a positive number"
        )
    if isinstance(machine, Comparable):
        require_match(machine.netlist, source)
        require_match(machine.netlist, source if floats is None else floats)


def _compare_engines(
    machine: Machine, data: Recordings, samples: int, name: str, begin: Begin
) -> dict[str, Any]:
    """Fields of E0: the specification on the first recordings, a further engine on all."""
    beside = machine.beside(name)
    begin("specification", 0)
    first = data.part(slice(samples))
    return {
        "spec_samples": samples,
        "spec_different": machine.check(first.events, lengths=first.lengths),
        "engine": name,
        "engine_different": None
        if beside is None
        else sum(beside(part.events, part.lengths) for part in data.parts()),
    }


def _run(
    machine: Machine, data: Recordings, tallies: list[ModelTally | FloatTally], begin: Begin
) -> tuple[Any, int | None]:
    """Run the chip on recordings; its votes (samples, classes), and membranes that left their registers."""
    votes = np.zeros((len(data), machine.netlist.classes), np.int64)
    saturated: int | None = None
    for rows in machine.parts(len(data), data.steps):
        begin("chip", rows.start)
        some = data.part(rows)
        run = machine.run(some.events, lengths=some.lengths, spikes=True)
        votes[rows] = run.votes
        if run.saturated is not None:
            saturated = (saturated or 0) + int(run.saturated.sum())
        for tally in tallies:
            tally.add(Part(rows=rows, data=some, run=run))
    return votes, saturated


def _different_in_a_row(machine: Machine, data: Recordings, votes: Any) -> int | None:
    """Decisions that differ where recordings follow each other; None unless the chip runs freely."""
    in_a_row = machine.in_a_row(data.held, data.lengths)
    return None if in_a_row is None else int(np.sum(vote(in_a_row) != vote(votes)))


def _of_floats(tally: FloatTally, votes: Any, files: tuple[str, ...]) -> dict[str, Any]:
    """Fields of a verdict that compare with a float model."""
    sides = {"float_predictions": vote(tally.votes), "float_counts": tally.votes}
    if tally.spikes is None:
        return sides | {"breakdowns": tuple(undecided(tally.votes, votes, files))}
    return sides | {
        "spikes": tally.spikes.layers,
        "ladder": tally.spikes.ladder,
        "first_divergence": tally.spikes.first_divergence,
        "breakdowns": tally.spikes.breakdowns((tally.votes, votes), files),
        "not_compared": tally.spikes.not_compared,
    }
