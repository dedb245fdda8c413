"""How a chip of compartments rounds weights, thresholds and decays, for those who train with its own integers."""

from __future__ import annotations

from spikeloom.compiler.targets.loihi1.storage.quantize import round_to_forms
from spikeloom.compiler.targets.loihi1.storage.weight_storage import (
    DECAY_ONE,
    decay_registers,
    reach,
    round_steps,
    step_units,
)

__all__ = ["DECAY_ONE", "decay_registers", "reach", "round_steps", "round_to_forms", "step_units"]
