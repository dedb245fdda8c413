"""What a chip does otherwise than its float network, and neurons run again without it."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

from spikeloom.compiler.types import BoolArray, FloatArray, IntArray

WEIGHTS = "weight rounding"
BIAS = "bias rounding"
BETA = "realised beta"
TRUNCATION = "round toward zero"
SATURATION = "saturation or overflow"
TIE = "tie (> or >=)"
LEFT_OUT = "neuron left out"
UNKNOWN = "not known"

Sources = tuple[tuple[tuple[int, BoolArray], ...], ...]
"""For each population its presynaptic populations, and which pairs (neurons of pre, neurons of post) are connected."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Memories:
    """Neurons of one population and what they remember: the steps from `begin` to `step`, the longest come first.

    In these steps `arrived` (steps, sources) reached them, of :meth:`Deviations.sources_into`, and float
    network and chip both `fired`, (steps, neurons).
    """

    neurons: IntArray
    begin: IntArray
    step: IntArray
    arrived: FloatArray
    fired: BoolArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Replays:
    """Neurons run again as stored, which comes first, and without each deviation."""

    causes: Sequence[str]  # Of each variant, the deviation that is taken away
    unclipped: Sequence[bool]  # Whether weights that the range cuts off are all that is taken away
    margins: FloatArray  # (variants, neurons); register minus threshold in the last step
    early: BoolArray  # (variants, neurons); whether a neuron fired before it, where it should not
    threshold: FloatArray  # (neurons,); registers
    unit: FloatArray  # (neurons,); registers that are one of the float network's units
    reach: FloatArray  # (neurons,); sum of the float network's weights, without signs


class Deviations(ABC):
    """Those of one chip, between a netlist and its float network."""

    @property
    @abstractmethod
    def sources(self) -> Sources:
        """By synapses whose weight is not zero on either side; the input, which cannot differ, is left out."""

    @abstractmethod
    def sources_into(self, post: int) -> tuple[int, ...]:
        """Presynaptic populations of a population on either side, the input first."""

    @abstractmethod
    def forgets(self, post: int) -> bool:
        """Whether a neuron of a population remembers nothing after a spike."""

    @abstractmethod
    def replays(self, post: int, memories: Memories) -> Replays:
        """Run neurons of a population from rest over what they remember, with one deviation taken away at a time."""

    @abstractmethod
    def remedy(self, cause: str, post: int, *, clipped: bool, held: bool) -> str | None:
        """What would remove a deviation of a population; `clipped` weights are cut off, a neuron not `held` is lost."""
