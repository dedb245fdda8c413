"""What a user may ask of a compilation."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.ir import Form
from spikeloom.compiler.storage import MAX_PLANES, Packing
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.types import AnyArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Options:
    """Options of a compilation."""

    forms: Sequence[Form] | None = None  # Storage that the network was fine-tuned for, by population
    # Packing of each layer, or one for all; 8 bits by default. A fine-tuned network brings its own and takes none.
    packings: Sequence[Packing] | None = None
    # Add planes and scales until every spike on the training recordings, all of them, is the float64 model's, see
    # :mod:`storage.spike_exact`; takes the width from `packings` and nothing else
    spike_exact: bool = False
    # Least share of equal decisions on held-out training recordings for which the cheapest storage is chosen, see
    # :mod:`storage.held_out`, where nothing else says how layers are stored; None: 8 bits
    keep: float | None = None
    share_lists: bool = False  # Round weights that repeat alike, so that cores store their lists once
    keep_all: bool = False  # Keep neurons that provably do nothing, too
    prune_unused: bool = False  # Remove neurons that did not fire on any training recording, too
    # (samples, taxels, polarities, steps); recordings for calibration: 32, evenly spaced, are used, of planes 256
    training_events: AnyArray | None = None
    # Least number of cores of a layer, by name; they hold no other. Its neurons are cut as evenly as possible.
    cores_for: Mapping[str, int] = field(default_factory=dict)
    chips: int = 1  # Number of chips at most; as few are used as hold the cores
    # No layer has a window, and blank steps follow each recording, see :mod:`loihi1.idle`
    free_running: bool = False
    provenance: Mapping[str, Any] = field(default_factory=dict)  # JSON values to store with the netlist

    @property
    def chooses(self) -> bool:
        """Whether held-out training recordings choose the storage."""
        said = self.packings is not None or self.spike_exact or self.forms is not None
        return self.keep is not None and self.training_events is not None and not said

    def require_consistent(self, *, calibrated: bool) -> None:
        """Refuse options that contradict each other; `calibrated` where there are, or will be, training events."""
        fine_tuned = self.forms is not None
        packings = self.packings or (Packing(),)
        plain = len(packings) == 1 and packings[0] == Packing(bits=packings[0].bits)
        without_evidence = not calibrated or self.keep_all or fine_tuned
        for refused, why in (
            (
                self.prune_unused and without_evidence,
                "--prune-unused: needs --calibrate; omit it with --keep-all and for a fine-tuned checkpoint",
            ),
            (
                fine_tuned and (self.packings is not None or self.spike_exact),
                "compile: the checkpoint was fine-tuned for its own storage; omit --weight-bits, --planes, "
                "--scale-groups and --spike-exact",
            ),
            (self.spike_exact and not calibrated, "--spike-exact: nothing to be exact on; give --calibrate"),
            (
                self.spike_exact and not plain,
                "--spike-exact: finds planes and scales itself; give one width, no --planes or --scale-groups",
            ),
            (self.chips < 1, f"--chips {self.chips}: not a number of chips; give 1 or more"),
        ):
            if refused:
                raise OptionError(why)


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
            raise OptionError(f"--planes {packing.planes}: allowed are 1 to {MAX_PLANES}; choose one of these")
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
