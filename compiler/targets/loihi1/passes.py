"""The passes of this chip in their order: a trained network at the top, a netlist that obeys every limit at the end."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial

from spikeloom.compiler import invariants
from spikeloom.compiler.errors import CapacityError, ModelError
from spikeloom.compiler.interpret import channels_last
from spikeloom.compiler.ir import INPUT, Network
from spikeloom.compiler.passes import calibrate as calibration
from spikeloom.compiler.passes import prune
from spikeloom.compiler.passes.calibrate import Calibration
from spikeloom.compiler.passes.prune import Masks
from spikeloom.compiler.pipeline import LATER, run, step
from spikeloom.compiler.storage import EIGHT_BITS, Cheapest, Exact, Fixed, Given, Packing
from spikeloom.compiler.targets.base import Target, load_target
from spikeloom.compiler.targets.loihi1 import integers, remove
from spikeloom.compiler.targets.loihi1.bounds import RangeProof, prove_ranges
from spikeloom.compiler.targets.loihi1.digest import digests
from spikeloom.compiler.targets.loihi1.emit import emit
from spikeloom.compiler.targets.loihi1.idle import forgotten
from spikeloom.compiler.targets.loihi1.integers import IntegerNetwork
from spikeloom.compiler.targets.loihi1.layout.choose import Layout, lay_out
from spikeloom.compiler.targets.loihi1.layout.choose import faults as layout_faults
from spikeloom.compiler.targets.loihi1.layout.place import Placement
from spikeloom.compiler.targets.loihi1.legalize import LimitUse, require_legal
from spikeloom.compiler.targets.loihi1.netlist import FILE, Netlist
from spikeloom.compiler.targets.loihi1.options import Options, check_packings, require_stored
from spikeloom.compiler.targets.loihi1.remove import Removal
from spikeloom.compiler.targets.loihi1.storage import held_out
from spikeloom.compiler.targets.loihi1.storage.choose_storage import Choice, choose_storage, round_to_forms
from spikeloom.compiler.targets.loihi1.storage.held_out import HeldOut
from spikeloom.compiler.targets.loihi1.storage.ladder import Trial, cheapest_first
from spikeloom.compiler.targets.loihi1.storage.spike_exact import Exactness, make_exact
from spikeloom.compiler.types import AnyArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Compilation:
    """Everything that one compilation was given and has made so far; the pass in brackets fills a field in."""

    options: Options  # What was asked for
    target: Target  # Chip
    network: Network = LATER  # What is compiled, where it is one of floats
    calibration: Calibration | None = (
        None  # What it did on training recordings, where there are any (`calibrate`)
    )
    rates: tuple[FloatArray, ...] | None = (
        None  # Spikes per step by population, likewise, by which traffic weighs
    )
    connected: Network = (
        LATER  # The same network without the weights of neurons that do nothing (`disconnect`)
    )
    quiet: Masks = ()  # Neurons that never fired in training and are to go for it, although some input makes them fire
    gone: Masks = ()  # Neurons that are to go in any case, see :func:`without`
    integer: IntegerNetwork = LATER  # In the integers of the chip (`quantize`)
    choices: tuple[Choice, ...] = ()  # Scale of each layer and why
    packing: Packing = EIGHT_BITS.packings[0]  # Of all layers, where held-out recordings choose
    trials: tuple[
        Trial, ...
    ] = ()  # Storages that were tried, the cheapest first, where held-out recordings choose
    exactness: tuple[
        Exactness, ...
    ] = ()  # What is in the way of equal spikes, where these were asked for; else empty
    proofs: tuple[RangeProof, ...] = ()  # Worst-case register values of each layer (`prove`)
    held: IntegerNetwork = LATER  # What the chip holds of it (`remove`)
    identity: tuple[IntArray, ...] = ()  # Which neurons these are, by population
    silent: Masks = ()  # Neurons that it does not hold as they cannot fire
    unread: Masks = ()  # Neurons that it does not hold as their spikes reach no neuron
    removals: tuple[Removal, ...] = ()  # The same in numbers, and why
    layout: Layout = LATER  # Cores and tiles (`place`)
    netlist: Netlist = LATER  # The result (`emit`)
    uses: tuple[LimitUse, ...] = ()  # Use of every limit by every core (`legalize`)

    @property
    def placement(self) -> Placement:
        """Tiles and what they cost."""
        return self.layout.placement

    @property
    def newest(self) -> Network | IntegerNetwork | Layout | Netlist:
        """What the last pass made that changed anything."""
        stages = (self.netlist, self.layout, self.held, self.integer, self.connected, self.network)
        return next(stage for stage in stages if stage is not LATER)

    def verify(self) -> None:
        """Check every rule of the newest artefact; VerifyError if a pass broke one."""
        newest = self.newest
        if isinstance(newest, Network):
            invariants.verify(newest)
        elif isinstance(newest, IntegerNetwork):
            integers.verify(newest)
        elif isinstance(newest, Layout):
            invariants.require_none([*layout_faults(newest, self.held, self.target)])
        else:
            FILE.verify(newest)


@step("runs the float network on training recordings, where there are any", keeps="the network")
def _calibrate(done: Compilation) -> Compilation:
    events = done.options.training_events
    if events is None:
        return done
    storage = done.options.storage
    few = held_out.split(len(events))[0]
    known = _spikes(done.network, events if isinstance(storage, Exact) else events[few])
    rates = known.rates
    if isinstance(storage, Fixed) and any(packing.planes > 1 for packing in storage.packings):
        known = _for_planes(done.network, events)
    return replace(done, calibration=known, rates=rates)


def _spikes(network: Network, events: AnyArray) -> Calibration:
    """Run the float network on recordings (samples, taxels, polarities, steps)."""
    return calibration.calibrate(network, channels_last(events, network.input.clocks))


def _for_planes(network: Network, events: AnyArray) -> Calibration:
    """The same on those that choose several planes, whether these are asked for or found on those held out."""
    several = held_out.split(len(events))[1]
    return _spikes(network, events[calibration.evenly_spaced(several, calibration.MANY)])


@step(
    "zeroes the weights of neurons that no input can make fire; with --prune-unused also of those that never "
    "fired in training",
    keeps="every spike on any input; with --prune-unused on any input on which these stay silent",
)
def _disconnect(done: Compilation) -> Compilation:
    quiet = prune.none_of(done.network)
    if done.options.keep_all or isinstance(done.options.storage, Given):
        return replace(done, connected=done.network, quiet=quiet)
    gone = proven = prune.never_fires(done.network)
    events = done.options.training_events
    if done.options.prune_unused and events is not None:
        gone = prune.either(proven, prune.never_fired(done.network, _spikes(done.network, events)))
        quiet = tuple(left & ~silent for left, silent in zip(gone, proven, strict=True))
    return replace(done, connected=prune.disconnect(done.network, gone), quiet=quiet)


@step(
    "chooses the scales of each layer and rounds weights, biases, thresholds and decays to registers",
    keeps="the decisions, as well as the width allows; every training spike where --spike-exact succeeds",
)
def _quantize(done: Compilation) -> Compilation:
    storage = done.options.storage
    network = done.connected
    target = done.target
    rounded = replace(done, connected=LATER)  # large, and no pass needs it again
    if isinstance(storage, Given):
        require_stored(storage.forms, [population.name for population in network.populations], target)
        integer, choices = round_to_forms(network, storage.forms, done.calibration)
        return replace(rounded, integer=integer, choices=choices)
    if isinstance(storage, Exact) and done.calibration is not None:
        check_packings((Packing(bits=storage.bits),), len(network.populations), target)
        integer, choices, exactness = make_exact(network, target, done.calibration, bits=storage.bits)
        return replace(rounded, integer=integer, choices=choices, exactness=exactness)
    integer, choices = choose_storage(
        network,
        target,
        packings=storage.packings if isinstance(storage, Fixed) else (done.packing,),
        calibration=done.calibration,
        share_lists=done.options.share_lists,
    )
    return replace(rounded, integer=integer, choices=choices)


@step("bounds every register by the weights alone", keeps="the network")
def _prove(done: Compilation) -> Compilation:
    return replace(done, proofs=prove_ranges(done.integer))


@step(
    "takes out the neurons that no input can make fire and those whose spikes reach no neuron",
    keeps="every spike of the neurons that are left, on any input",
)
def _remove(done: Compilation) -> Compilation:
    integer = done.integer
    network = done.network
    none = prune.none_of(integer)
    silent, unread = (none, none) if done.options.keep_all else remove.removable(integer)
    silent = prune.either(silent, done.gone or none)
    removals = () if network is LATER else remove.removals(network, silent, unread, done.quiet)
    kept, identity = remove.compact(integer, prune.either(silent, unread))
    return replace(done, held=kept, identity=identity, silent=silent, unread=unread, removals=removals)


@step(
    "cuts the layers over few cores, within every limit, and puts the cores on tiles with the fewest spike-hops",
    keeps="every spike: where a neuron sits has no influence on any",
)
def _place(done: Compilation) -> Compilation:
    options = done.options
    rates = done.rates and tuple(rate[ids] for rate, ids in zip(done.rates, done.identity, strict=True))
    layout = lay_out(done.held, done.target, cores_for=options.cores_for, chips=options.chips, rates=rates)
    return replace(done, layout=layout)


@step(
    "writes cores, axons and synapse lists down as a netlist",
    keeps="every synapse that is not zero, stored once",
)
def _emit(done: Compilation) -> Compilation:
    provenance = dict(done.options.provenance)
    if done.choices:
        provenance["compensated"] = [choice.layer for choice in done.choices if choice.compensated]
    provenance["digests"] = digests(done.integer, prune.either(done.silent, done.unread))
    if done.trials:
        provenance |= {"planes": done.packing.planes, "scale_groups": done.packing.groups}
    made = emit(
        done.held,
        done.layout.cores,
        done.placement.tiles,
        done.target,
        provenance,
        origin=done.integer,
        identity=done.identity,
        unread=done.unread,
    )
    blank = forgotten(made).steps if done.options.free_running else 0
    return replace(done, netlist=replace(made, blank=blank))


@step("measures every limit again on the netlist and refuses one that breaks any", keeps="the netlist")
def _legalize(done: Compilation) -> Compilation:
    return replace(done, uses=require_legal(done.netlist, done.target))


FLOATS = (_calibrate, _disconnect)
"""Passes on floats."""

INTEGERS = (_prove, _remove)
"""Passes on integers, wherever these come from."""

LAYOUT = (_place, _emit, _legalize)
"""Passes from integers to a netlist."""

PASSES = (*FLOATS, _quantize, *INTEGERS, *LAYOUT)

After = Callable[[str, Compilation], object] | None
"""Callback of :func:`pipeline.run`: gets the name of each pass and its work."""


def start(source: Network | IntegerNetwork, options: Options, target: Target) -> Compilation:
    """What passes begin with.

    OptionError if the options contradict each other, VerifyError if the network breaks a rule.
    """
    options.require_consistent(calibrated=options.training_events is not None)
    empty = Compilation(options=options, target=target)
    work = (
        replace(empty, integer=source)
        if isinstance(source, IntegerNetwork)
        else replace(empty, network=source)
    )
    work.verify()
    return work


def compile_network(
    source: Network | IntegerNetwork,
    options: Options | None = None,
    *,
    target: Target | None = None,
    after: After = None,
) -> Compilation:
    """Lower a network by all passes that are due: integers are rounded already."""
    chip = load_target("loihi1") if target is None else target
    work = start(source, Options() if options is None else options, chip)
    return run((*INTEGERS, *LAYOUT), _rounded(work, after), after)


def to_integers(source: Network, options: Options, target: Target) -> Compilation:
    """Round a network to the integers of the chip, without a layout: :func:`lay_out_again` makes as many as wanted."""
    return run(INTEGERS, _rounded(start(source, options, target)))


def _rounded(work: Compilation, after: After = None) -> Compilation:
    """A network in integers; of :class:`Cheapest` storages each is compiled to the end before one is taken."""
    if work.network is LATER:
        return work
    work = run(FLOATS, work, after)
    storage = work.options.storage
    events = work.options.training_events
    if isinstance(storage, Cheapest) and events is not None and len(events) > 1:
        work = _with_cheapest(work, storage, events)
        if after is not None:
            after(_quantize.name, work)
        return work
    return run((_quantize,), work, after)


def _with_cheapest(work: Compilation, storage: Cheapest, events: AnyArray) -> Compilation:
    """Round to the cheapest storage that keeps decisions of held-out recordings, or to the one that keeps most.

    Each is compiled to the end. CapacityError or ModelError if the chip does not hold even the first.
    """
    network = work.network
    few = work.calibration
    assert few is not None, "there are recordings"
    many = cache(partial(_for_planes, network, events))
    judge = HeldOut(network, events[held_out.split(len(events))[2]])
    best = work
    most = -1
    trials = list[Trial]()
    for packing in cheapest_first(work.target):
        known = many() if packing.planes > 1 else few
        trial = Trial(planes=packing.planes, groups=packing.groups)
        try:
            tried = run((_quantize, *INTEGERS, *LAYOUT), replace(work, packing=packing, calibration=known))
        except (CapacityError, ModelError) as error:
            if not trials:
                raise  # nor does what is larger fit
            trials.append(replace(trial, refused=str(error)))
            continue
        equal = judge.equal(tried.integer)
        trials.append(
            replace(
                trial,
                equal=equal,
                decisions=len(judge),
                operations=_operations(few, tried.integer),
                synapse_words=sum(use.used for use in tried.uses if use.name == "core.synapse_words"),
                cores=tried.netlist.n_cores,
            )
        )
        if equal > most:
            best = tried
            most = equal
        if most >= storage.keep * len(judge):
            break
    chosen = replace(work, connected=LATER, integer=best.integer, choices=best.choices)
    return replace(chosen, packing=best.packing, trials=tuple(trials))


def _operations(known: Calibration, integer: IntegerNetwork) -> float:
    """Synaptic operations of a training recording, on average, if every spike is the float model's."""
    total = 0.0
    for projection in integer.projections:
        weight = projection.weight
        total += float(known.rate(projection.pre, INPUT)[weight.indices] @ (weight.data != 0))
    return total * float(known.events.shape[1])


def lay_out_again(done: Compilation, options: Options) -> Compilation:
    """Lay out what was rounded already; of the options those that speak of layouts count, and the provenance."""
    return run(LAYOUT, replace(done, options=options))


def without(done: Compilation, gone: Masks, *, rates: tuple[FloatArray, ...] | None = None) -> Netlist:
    """Remove more neurons, (neurons,) bool by population, and lay out the rest on the fewest cores of one chip.

    Weights and thresholds are the same integers: on any recording on which none of these neurons fires,
    every other spike is as before. Each population must keep a neuron; `rates` are spikes per step of all,
    for the placement.
    """
    options = Options(provenance=done.netlist.provenance)
    work = replace(done, options=options, calibration=None, rates=rates, gone=gone)
    return lay_out_again(_remove.apply(work), options).netlist
