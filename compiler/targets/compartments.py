"""Chips of compartments: the names that rooms which serve every chip take from them."""

from spikeloom.compiler.targets.loihi1 import registers
from spikeloom.compiler.targets.loihi1.bounds import one_sided_sums, prove_ranges
from spikeloom.compiler.targets.loihi1.integers import IntegerNetwork, IntegerPopulation, integer_simulation
from spikeloom.compiler.targets.loihi1.netlist import Netlist, write_netlist
from spikeloom.compiler.targets.loihi1.options import Options, check_packings
from spikeloom.compiler.targets.loihi1.passes import (
    Compilation,
    compile_network,
    lay_out_again,
    to_integers,
    without,
)
from spikeloom.compiler.targets.loihi1.registers import (
    DECAY_BITS,
    MEMBRANE_MAX,
    MEMBRANE_SHIFT,
    ONE_STEP_SUM_MAX,
    decay_registers,
    kept_shares,
    reach,
    step_units,
)
from spikeloom.compiler.targets.loihi1.remove import without_channels
from spikeloom.compiler.targets.loihi1.storage.choose_storage import round_to_forms
from spikeloom.compiler.targets.loihi1.storage.scales import layer_of, rounded
from spikeloom.compiler.targets.loihi1.storage.weight_storage import fullest, round_population

__all__ = [
    "DECAY_BITS",
    "MEMBRANE_MAX",
    "MEMBRANE_SHIFT",
    "ONE_STEP_SUM_MAX",
    "Compilation",
    "IntegerNetwork",
    "IntegerPopulation",
    "Netlist",
    "Options",
    "check_packings",
    "compile_network",
    "decay_registers",
    "fullest",
    "integer_simulation",
    "kept_shares",
    "lay_out_again",
    "layer_of",
    "one_sided_sums",
    "prove_ranges",
    "reach",
    "registers",
    "round_population",
    "round_to_forms",
    "rounded",
    "step_units",
    "to_integers",
    "without",
    "without_channels",
    "write_netlist",
]
