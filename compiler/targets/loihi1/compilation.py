"""The ordered passes: float network to netlist, verified after each, printable after each."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.fixedpoint import FloatArray
from spikeloom.compiler.interpret import channels_last
from spikeloom.compiler.invariants import verify
from spikeloom.compiler.ir import IntegerNetwork, Network
from spikeloom.compiler.passes.calibrate import FEW, MANY, Calibration, calibrate, evenly_spaced
from spikeloom.compiler.passes.prune import (
    Removal,
    disconnect,
    either,
    never_fired,
    never_fires,
    nobody,
    removable,
    removals,
)
from spikeloom.compiler.targets.base import Target, load_target
from spikeloom.compiler.targets.loihi1.layout.choose import Layout, require_goal
from spikeloom.compiler.targets.loihi1.layout.place import Placement
from spikeloom.compiler.targets.loihi1.legalize import LimitUse
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.placing import place_integers
from spikeloom.compiler.targets.loihi1.storage.quantize import Choice, Recipe, check_recipes, quantize, round_to_forms
from spikeloom.compiler.targets.loihi1.storage.range_proof import RangeProof, prove_ranges
from spikeloom.compiler.targets.loihi1.storage.spike_exact import Exactness, make_exact
from spikeloom.compiler.targets.loihi1.storage.weight_storage import Form

STAGES = ("expand", "quantize", "place")
"""Stages after which the artefact can be dumped: float network, integer network, netlist."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stored:
    """A network in the integers of the chip, from which any layout can be made.

    Parameters
    ----------
    network : Network
        Float stage, expanded.
    integer : IntegerNetwork
        Integer stage.
    choices, exactness : tuple of Choice, tuple of Exactness
        As in :class:`Compilation`.
    calibration : Calibration or None
        What the float model did on training recordings, where there are any.
    silent, unheard, unused : tuple of (neurons,) bool
        Neurons to leave out, by population, and why: they cannot fire, nobody hears them, they never fired.
    """

    network: Network
    integer: IntegerNetwork
    choices: tuple[Choice, ...]
    exactness: tuple[Exactness, ...]
    calibration: Calibration | None
    silent: tuple[npt.NDArray[np.bool_], ...]
    unheard: tuple[npt.NDArray[np.bool_], ...]
    unused: tuple[npt.NDArray[np.bool_], ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Compilation:
    """Everything that one compilation produced.

    Parameters
    ----------
    network : Network
        Float stage, expanded.
    integer : IntegerNetwork
        Integer stage.
    netlist : Netlist
        The result.
    choices : tuple of Choice
        Scale of each layer and why.
    exactness : tuple of Exactness
        What is in the way of equal spikes, where these were asked for; else empty.
    proofs : tuple of RangeProof
        Worst-case register values of each layer.
    uses : tuple of LimitUse
        Use of every limit by every core.
    removals : tuple of Removal
        What was left out of each layer.
    goal : str
        What the layout was chosen for.
    layout : Layout
        Cores and tiles, and what a step is expected to take.
    usual : Layout
        The same for the layout of fewest cores; often that is the layout.
    """

    network: Network
    integer: IntegerNetwork
    netlist: Netlist
    choices: tuple[Choice, ...]
    exactness: tuple[Exactness, ...]
    proofs: tuple[RangeProof, ...]
    uses: tuple[LimitUse, ...]
    removals: tuple[Removal, ...]
    goal: str
    layout: Layout
    usual: Layout

    @property
    def placement(self) -> Placement:
        """Tiles and what they cost."""
        return self.layout.placement

    @property
    def core_bound(self) -> int:
        """No legal partition uses fewer cores."""
        return self.layout.parts.bound


def compile_network(
    network: Network,
    *,
    forms: Sequence[Form] | None = None,
    target: str = "loihi1",
    recipes: Sequence[Recipe] | None = None,
    spike_exact: bool = False,
    keep_all: bool = False,
    prune_unused: bool = False,
    training_events: npt.NDArray[Any] | None = None,
    ranges: str = "proven",
    margin: float = 0.1,
    cores_for: Mapping[str, int] | None = None,
    chips: int = 1,
    optimize: str = "cores",
    provenance: Mapping[str, Any] | None = None,
    after: Callable[[str, Network | IntegerNetwork | Netlist], None] | None = None,
) -> Compilation:
    """Lower a float network, wherever it comes from, to a placed netlist that obeys every limit of the chip.

    Parameters
    ----------
    network : Network
        Float stage.
    forms : sequence of Form, optional
        Storage that the network was fine-tuned for, by population.
    target : str
        Chip.
    recipes : sequence of Recipe
        Storage of each layer, or one for all; 8 bits by default. A fine-tuned network brings its own and takes none.
    spike_exact : bool
        Add planes and scales until every spike on the training recordings, all of them, is the float64 model's, see
        :mod:`storage.spike_exact`; takes the width from `recipes` and nothing else.
    keep_all : bool
        Keep neurons that provably do nothing, too.
    prune_unused : bool
        Leave out neurons that did not fire on any training recording, too.
    training_events : (samples, taxels, polarities, steps), optional
        Training recordings for calibration, of which 32, evenly spaced, are used; with several planes 256.
    ranges : {"proven", "observed"}
        How scales are kept from overflowing, see :func:`quantize.quantize`.
    margin : float
        Share added to observed ranges.
    cores_for : mapping of str to int, optional
        Least number of cores of a layer, by name; they hold no other. Its neurons are cut as evenly as possible.
    chips : int
        Number of chips at most; as few are used as hold the cores.
    optimize : {"cores", "energy", "latency"}
        What the layout is chosen for, see :mod:`layout.choose`; all but cores need training events.
    provenance : mapping, optional
        JSON values to store with the netlist.
    after : callable, optional
        Called with the name of each stage in ``STAGES`` and its artefact.

    Raises
    ------
    OptionError, ModelError, DataError, CapacityError
        As the passes say.
    """
    chip = load_target(target)
    require_goal(optimize, cores_for, chip, calibrated=training_events is not None, chips=chips)
    publish = after or (lambda _stage, _artefact: None)
    stored = store(
        network,
        forms=forms,
        target=target,
        recipes=recipes,
        spike_exact=spike_exact,
        keep_all=keep_all,
        prune_unused=prune_unused,
        training_events=training_events,
        ranges=ranges,
        margin=margin,
        after=publish,
    )
    made = place(stored, target=target, cores_for=cores_for, chips=chips, optimize=optimize, provenance=provenance)
    publish("place", made.netlist)
    return made


def store(
    network: Network,
    *,
    forms: Sequence[Form] | None = None,
    target: str = "loihi1",
    recipes: Sequence[Recipe] | None = None,
    spike_exact: bool = False,
    keep_all: bool = False,
    prune_unused: bool = False,
    training_events: npt.NDArray[Any] | None = None,
    ranges: str = "proven",
    margin: float = 0.1,
    after: Callable[[str, Network | IntegerNetwork], object] | None = None,
) -> Stored:
    """Round a float network to the integers of the chip: the longest part of a compilation, before any layout.

    Parameters and errors as of :func:`compile_network`.
    """
    chip = load_target(target)
    if not 0 <= margin < math.inf:
        raise OptionError(f"--margin {margin:g}: is no share to add to a range; give a number from 0")
    publish = after or (lambda _stage, _artefact: None)

    verify(network)
    publish("expand", network)

    calibration: Calibration | None = None
    if training_events is not None:
        events = channels_last(training_events, network.input.clocks)
        several = any(recipe.planes > 1 for recipe in recipes or ())
        used = events if spike_exact or prune_unused else evenly_spaced(events, MANY if several else FEW)
        calibration = calibrate(network, used)
    unused = nobody(network)
    if prune_unused:
        if calibration is None or keep_all or forms is not None:
            raise OptionError(
                "--prune-unused: needs --calibrate, and neither --keep-all nor a fine-tuned checkpoint; "
                "change the options"
            )
        unused = never_fired(network, calibration)
    whole = network
    if not keep_all and forms is None:
        network = disconnect(network, either(never_fires(network), unused))

    exactness: tuple[Exactness, ...] = ()
    if forms is not None:
        if recipes is not None or spike_exact or ranges != "proven":
            raise OptionError(
                "compile: the checkpoint was fine-tuned for its own storage; leave --weight-bits, --planes, "
                "--scale-groups, --spike-exact and --ranges away"
            )
        _require_stored(network, forms, chip)
        integer, choices = round_to_forms(network, forms, calibration)
    elif spike_exact:
        integer, choices, exactness = _exact(network, chip, recipes or (Recipe(),), calibration, ranges)
    else:
        integer, choices = quantize(
            network, chip, recipes=recipes or (Recipe(),), calibration=calibration, ranges=ranges, margin=margin
        )
    verify(integer)
    publish("quantize", integer)

    silent, unheard = (nobody(network), nobody(network)) if keep_all else removable(integer)
    return Stored(
        network=whole,
        integer=integer,
        choices=choices,
        exactness=exactness,
        calibration=calibration,
        silent=silent,
        unheard=unheard,
        unused=unused,
    )


def place(
    stored: Stored,
    *,
    target: str = "loihi1",
    cores_for: Mapping[str, int] | None = None,
    chips: int = 1,
    optimize: str = "cores",
    provenance: Mapping[str, Any] | None = None,
) -> Compilation:
    """Lay out a rounded network: which neuron sits where has no influence on any spike.

    Parameters and errors as of :func:`compile_network`.
    """
    placed = place_integers(
        stored.integer,
        removed=(stored.silent, stored.unheard),
        target=target,
        cores_for=cores_for,
        chips=chips,
        optimize=optimize,
        calibration=stored.calibration,
        provenance=provenance,
    )
    return Compilation(
        network=stored.network,
        integer=stored.integer,
        netlist=placed.netlist,
        choices=stored.choices,
        exactness=stored.exactness,
        proofs=prove_ranges(stored.integer),
        uses=placed.uses,
        removals=removals(stored.network, stored.silent, stored.unheard, stored.unused),
        goal=optimize,
        layout=placed.layout,
        usual=placed.usual,
    )


def without(
    compilation: Compilation,
    unused: tuple[npt.NDArray[np.bool_], ...],
    *,
    target: str = "loihi1",
    rates: tuple[FloatArray, ...] | None = None,
) -> Netlist:
    """Leave more neurons out of what was compiled, and lay out the rest on the fewest cores.

    Weights and thresholds are the same integers: on any recording on which none of these neurons fires, every other
    spike is as before.

    Parameters
    ----------
    compilation : Compilation
        Of a network on one chip.
    unused : tuple of (neurons,) bool
        Neurons to leave out, by population; each keeps one.
    target : str
        Chip that it was compiled for.
    rates : tuple of (neurons,) float64, optional
        Spikes per step, for the placement.

    Raises
    ------
    CapacityError
        If a limit cannot be kept.
    """
    silent, unheard = removable(compilation.integer)
    return place_integers(
        compilation.integer,
        removed=(either(silent, unused), unheard),
        target=target,
        rates=rates,
        provenance=compilation.netlist.provenance,
    ).netlist


def _require_stored(network: Network, forms: Sequence[Form], chip: Target) -> None:
    allowed = {what: chip.choices[f"synapse.{what}"] for what in ("weight_bits", "exponent")}
    for population, form in zip(network.populations, forms, strict=True):
        if form.bits not in allowed["weight_bits"] or not set(form.exponents) <= set(allowed["exponent"]):
            raise OptionError(
                f"{population.name}: was fine-tuned for weights of {form.bits} bits with exponent "
                f"{', '.join(map(str, form.exponents))}, which {chip.title} does not store; fine-tune for this target"
            )


def _exact(
    network: Network, chip: Target, recipes: Sequence[Recipe], calibration: Calibration | None, ranges: str
) -> tuple[IntegerNetwork, tuple[Choice, ...], tuple[Exactness, ...]]:
    if calibration is None:
        raise OptionError("--spike-exact: nothing to be exact on; give --calibrate")
    if ranges != "proven":
        raise OptionError(f"--spike-exact: needs proven ranges, --ranges says {ranges}; leave --ranges away")
    if len(recipes) > 1 or recipes[0] != Recipe(bits=recipes[0].bits):
        raise OptionError(
            "--spike-exact: finds planes and scales itself; give one width, no --planes or --scale-groups"
        )
    check_recipes(recipes, len(network.populations), chip)
    return make_exact(network, chip, calibration, bits=recipes[0].bits)
