"""What a user may ask of a compilation."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.ir import Form
from spikeloom.compiler.storage import EIGHT_BITS, MAX_PLANES, Exact, Given, Packing, Storage
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.types import AnyArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Options:
    """Options of a compilation."""

    storage: Storage = EIGHT_BITS  # What decides how weights are stored
    share_lists: bool = False  # Round weights that repeat alike, so that cores store their lists once
    keep_all: bool = False  # Keep neurons that provably do nothing, too
    prune_unused: bool = False  # Remove neurons that did not fire on any training recording, too
    # (samples, taxels, polarities, steps); recordings for calibration: 32, evenly spaced, are used, of
    # planes 256
    training_events: AnyArray | None = None
    # Least number of cores of a layer, by name; they hold no other. Its neurons are cut as evenly as
    # possible.
    cores_for: Mapping[str, int] = field(default_factory=dict)
    chips: int = 1  # Number of chips at most; as few are used as hold the cores
    # No layer has a window, and blank steps follow each recording, see :mod:`loihi1.idle`
    free_running: bool = False
    provenance: Mapping[str, Any] = field(default_factory=dict)  # JSON values to store with the netlist

    def require_consistent(self, *, calibrated: bool) -> None:
        """Refuse options that contradict each other; `calibrated` where there are, or will be, training events."""
        if self.prune_unused and (not calibrated or self.keep_all or isinstance(self.storage, Given)):
            raise OptionError(
                "--prune-unused: needs --calibrate; omit it with --keep-all and for a fine-tuned checkpoint"
            )
        if isinstance(self.storage, Exact) and not calibrated:
            raise OptionError("--spike-exact: nothing to be exact on; give --calibrate")
        if isinstance(self.storage, Exact) and self.share_lists:
            raise OptionError("--share-lists: --spike-exact rounds each weight for itself; omit one of them")
        if self.chips < 1:
            raise OptionError(f"--chips {self.chips}: not a number of chips; give 1 or more")


def check_packings(packings: Sequence[Packing], layers: int, target: Target) -> tuple[Packing, ...]:
    """One packing for each layer; OptionError unless there is one, or one a layer, and the chip has such storage."""
    if len(packings) not in (1, layers):
        raise OptionError(
            f"--weight-bits: {len(packings)} layers are described, the network has {layers}; "
            "give one number, or one for each layer"
        )
    allowed = target.choices["synapse.weight_bits"]
    for packing in packings:
        if packing.bits not in allowed:
            raise OptionError(
                f"--weight-bits {packing.bits}: {target.title} does not store that width; "
                f"allowed: {', '.join(map(str, allowed))}"
            )
        if not 1 <= packing.planes <= MAX_PLANES:
            raise OptionError(
                f"--planes {packing.planes}: allowed are 1 to {MAX_PLANES}; choose one of these"
            )
        slots = target.limit("core.threshold_slots")
        if not 1 <= packing.groups <= slots:
            holds = f"a core of {target.title} holds {slots} thresholds"
            raise OptionError(f"--scale-groups {packing.groups}: {holds}; give a number from 1 to {slots}")
    return tuple(packings) if len(packings) == layers else tuple(packings) * layers


def require_stored(forms: Sequence[Form], names: Sequence[str], target: Target) -> None:
    """Refuse storage that a network was fine-tuned for and the chip does not have; `names` are of the layers."""
    bits, exponents = (set(target.choices[f"synapse.{what}"]) for what in ("weight_bits", "exponent"))
    for name, form in zip(names, forms, strict=True):
        if form.bits not in bits or not set(form.exponents) <= exponents:
            raise OptionError(
                f"{name}: was fine-tuned for weights of {form.bits} bits with exponent "
                f"{', '.join(map(str, form.exponents))}, which {target.title} does not store; fine-tune for this target"
            )
