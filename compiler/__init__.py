"""Checkpoint to network to integer netlist; imports nothing of ours outside this package."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from spikeloom.compiler.ir import IntegerNetwork, Network
    from spikeloom.compiler.passes.expand import Factored
    from spikeloom.compiler.targets.loihi1.alike import store_alike as store_alike
    from spikeloom.compiler.targets.loihi1.lift import lift as lift
    from spikeloom.compiler.targets.loihi1.netlist import Netlist as Netlist
    from spikeloom.compiler.targets.loihi1.netlist_file import read_netlist as read_netlist
    from spikeloom.compiler.targets.loihi1.netlist_file import write_netlist as write_netlist
    from spikeloom.compiler.targets.loihi1.options import GOALS as GOALS
    from spikeloom.compiler.targets.loihi1.options import MAX_PLANES as MAX_PLANES
    from spikeloom.compiler.targets.loihi1.options import Options as Options
    from spikeloom.compiler.targets.loihi1.options import Packing as Packing
    from spikeloom.compiler.targets.loihi1.options import check_packings as check_packings
    from spikeloom.compiler.targets.loihi1.passes import Compilation as Compilation
    from spikeloom.compiler.targets.loihi1.passes import lay_out_again as lay_out_again
    from spikeloom.compiler.targets.loihi1.passes import to_integers as to_integers
    from spikeloom.compiler.targets.loihi1.passes import without as without
    from spikeloom.compiler.targets.loihi1.storage.choose_storage import round_to_forms as round_to_forms
    from spikeloom.compiler.targets.loihi1.storage.scales import layer_of as layer_of
    from spikeloom.compiler.targets.loihi1.storage.scales import rounded as rounded
    from spikeloom.compiler.targets.loihi1.storage.width_search import WidthPoint as WidthPoint
    from spikeloom.compiler.targets.loihi1.storage.width_search import WidthSearch as WidthSearch
    from spikeloom.compiler.targets.loihi1.storage.width_search import check_widths as check_widths
    from spikeloom.compiler.targets.loihi1.storage.width_search import search_widths as search_widths
    from spikeloom.compiler.targets.loihi1.storage.width_search import widths_front as widths_front

__version__ = "0.1.0"

DEFAULT_TARGET = "loihi1"

_NAMES = {
    "alike": "store_alike",
    "lift": "lift",
    "netlist": "Netlist",
    "netlist_file": "read_netlist write_netlist",
    "options": "GOALS MAX_PLANES Options Packing check_packings",
    "passes": "Compilation lay_out_again to_integers without",
    "storage.choose_storage": "round_to_forms",
    "storage.scales": "layer_of rounded",
    "storage.width_search": "WidthPoint WidthSearch check_widths search_widths widths_front",
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
    source: Factored | Network | IntegerNetwork,
    options: Options | None = None,
    *,
    target: str = DEFAULT_TARGET,
    after: Callable[[str, Compilation], object] | None = None,
) -> Compilation:
    """Lower a network, wherever it comes from, to a placed netlist that obeys every limit of the chip.

    Parameters
    ----------
    source : Factored, Network or IntegerNetwork
        Trained weights on their graph, a float network, or integers that are taken as they stand.
    options : Options, optional
        Of the target.
    target : str
        Chip.
    after : callable, optional
        Called with the name of each pass and the compilation as far as it is.

    Raises
    ------
    OptionError, ModelError, DataError, CapacityError
        As the passes say.
    """
    from spikeloom.compiler.targets.base import load_target

    done: Compilation = load_target(target).compile(source, options, after=after)
    return done
