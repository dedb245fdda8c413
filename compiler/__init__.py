"""Checkpoint to network to integer netlist; imports nothing of ours outside this package."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from spikeloom.compiler.ir import IntegerNetwork, Network
    from spikeloom.compiler.targets.loihi1.lift import lift
    from spikeloom.compiler.targets.loihi1.netlist import Netlist, read_netlist, write_netlist
    from spikeloom.compiler.targets.loihi1.options import KEEP, MAX_PLANES, Options, Packing, check_packings
    from spikeloom.compiler.targets.loihi1.passes import Compilation, lay_out_again, to_integers, without
    from spikeloom.compiler.targets.loihi1.storage.choose_storage import round_to_forms
    from spikeloom.compiler.targets.loihi1.storage.scales import layer_of, rounded
    from spikeloom.compiler.targets.loihi1.storage.weight_storage import fullest, round_population

__version__ = "0.1.0"

DEFAULT_TARGET = "loihi1"

_NAMES = {
    "lift": "lift",
    "netlist": "Netlist read_netlist write_netlist",
    "options": "KEEP MAX_PLANES Options Packing check_packings",
    "passes": "Compilation lay_out_again to_integers without",
    "storage.choose_storage": "round_to_forms",
    "storage.scales": "layer_of rounded",
    "storage.weight_storage": "fullest round_population",
}
_PLACES = {name: module for module, names in _NAMES.items() for name in names.split()}
"""Module of the target that each public name is imported from when it is first used."""


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    from importlib import import_module

    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.targets.{DEFAULT_TARGET}.{_PLACES[name]}"), name)


def compile_network(
    source: Network | IntegerNetwork,
    options: Options | None = None,
    *,
    after: Callable[[str, Compilation], object] | None = None,
) -> Compilation:
    """Lower a network, wherever it comes from, to a placed netlist that obeys every limit of Loihi.

    Integers are taken as they stand. `after` is called with the name of each pass and the compilation as far as it is.
    OptionError, ModelError, DataError or CapacityError as the passes say.
    """
    from spikeloom.compiler.targets.loihi1 import passes

    return passes.compile_network(source, options, after=after)
