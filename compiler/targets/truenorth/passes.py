"""The passes of this chip in their order: a trained network at the top, a netlist that obeys every rule at the end.

Networks that were trained for the chip and counting networks are whole numbers already and start at `place`. A float
network without memory (``--in-time``) is written out, and its weights become levels.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from spikeloom.compiler.counters import Counters
from spikeloom.compiler.errors import CapacityError, ModelError, OptionError
from spikeloom.compiler.ir import Network
from spikeloom.compiler.passes import expand
from spikeloom.compiler.pipeline import LATER, Pass, run, step
from spikeloom.compiler.targets.base import Target, load_target
from spikeloom.compiler.targets.truenorth.codebook import COPIES, LevelNetwork, in_levels
from spikeloom.compiler.targets.truenorth.counting import lower_counters
from spikeloom.compiler.targets.truenorth.in_time import lower_in_time
from spikeloom.compiler.targets.truenorth.legalize import needs, require_legal
from spikeloom.compiler.targets.truenorth.native import SYSTEM, NativeNetwork, lower
from spikeloom.compiler.targets.truenorth.netlist import FILE, CrossbarNetlist

WAYS = (
    f"three ways lead to the chip: --in-time N, N of {', '.join(map(str, COPIES))}, for networks that forget within a "
    f"step; training for it, spikeloom train --system {SYSTEM}; or counting, --system counters --weight-bits 5"
)
FORGET = "give --beta 0 where the file does not say, or train it with --membrane-decay LAYER=0 for every layer"

Source = NativeNetwork | Counters | expand.Factored | Network
"""What can be compiled; the first two are whole numbers already."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """Axons of an input of a float network, whose sums travel in time; and JSON values to store with the netlist."""

    in_time: int | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Compilation:
    """What one compilation was given and has made so far; each field is filled in by the pass of its name."""

    source: Source
    options: Options
    target: Target
    network: Network = LATER
    levels: LevelNetwork = LATER
    netlist: CrossbarNetlist = LATER

    @property
    def newest(self) -> Network | LevelNetwork | CrossbarNetlist:
        """What the last pass made that changed anything."""
        return self.netlist or self.levels or self.network

    def verify(self) -> None:
        """Check every rule of the newest artefact; VerifyError if a pass broke one."""
        FILE.verify(self.newest)


@step(
    "writes the graph convolution out as synapses, in float64; refuses what no layout could hold",
    keeps="every spike, up to the rounding of a differently ordered sum",
)
def _expand(done: Compilation) -> Compilation:
    source = done.source
    assert not isinstance(source, NativeNetwork | Counters), "whole numbers start behind the passes of float networks"
    network = source if isinstance(source, Network) else expand.expand(source.checkpoint, source.propagation)
    if done.options.in_time is None:
        error = CapacityError(needs(network, done.target))
        if error.violations:
            error.add_note(WAYS)
            raise error
        raise ModelError(f"a float network; {WAYS}")
    return replace(done, network=network)


@step(
    "rounds the weights of each neuron to a few levels of a step of its own",
    keeps="the decisions, as well as the levels allow",
)
def _levels(done: Compilation) -> Compilation:
    copies = done.options.in_time
    assert copies is not None, "refused by the pass before"
    try:
        return replace(done, levels=in_levels(done.network, copies, done.target))
    except ModelError as error:
        raise ModelError(f"{error}; {FORGET}") from error


@step(
    "puts neurons on cores, inputs on axons of the types that make their levels, and copies or relays where "
    "a spike has several targets",
    keeps="every spike; partial sums that travel in time saturate at 19",
)
def _place(done: Compilation) -> Compilation:
    provenance = done.options.provenance
    if isinstance(done.source, NativeNetwork):
        return replace(done, netlist=lower(done.source, done.target, provenance=provenance))
    if isinstance(done.source, Counters):
        return replace(done, netlist=lower_counters(done.source, done.target, provenance=provenance))
    return replace(done, netlist=lower_in_time(done.levels, done.target, provenance=provenance))


@step("holds the netlist against every rule and refuses one that breaks any", keeps="the netlist")
def _legalize(done: Compilation) -> Compilation:
    require_legal(done.netlist, done.target)
    return done


PASSES = (_expand, _levels, _place, _legalize)


def start(source: Source, options: Options, target: Target) -> tuple[Compilation, tuple[Pass[Compilation], ...]]:
    """What the passes begin with, and which of them are due; OptionError if whole numbers are to be rounded again."""
    whole = isinstance(source, NativeNetwork | Counters)
    if whole and options.in_time is not None:
        raise OptionError(f"--in-time {options.in_time}: the network is whole numbers already; omit it")
    if options.in_time not in (None, *COPIES):
        raise OptionError(f"--in-time {options.in_time}: allowed are {', '.join(map(str, COPIES))} axons an input")
    work = Compilation(source=source, options=options, target=target)
    return work, PASSES[2:] if whole else PASSES


def compile_crossbars(
    source: Source,
    options: Options | None = None,
    *,
    target: Target | None = None,
    after: Callable[[str, Compilation], object] | None = None,
) -> Compilation:
    """Lower a network by all passes that are due; `after` as of :func:`pipeline.run`."""
    chip = load_target("truenorth") if target is None else target
    work, passes = start(source, Options() if options is None else options, chip)
    return run(passes, work, after)
