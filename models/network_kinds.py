"""The kinds of network that can be trained: all of them, here and nowhere else."""

from spikeloom.models.training import usual
from spikeloom.models.training.kinds import Kind
from spikeloom.models.truenorth import kind as truenorth

KINDS: tuple[Kind, ...] = (usual, truenorth)


def kind_of(system: str) -> Kind:
    """The kind of network that a system is."""
    return next(kind for kind in KINDS if system in kind.SYSTEMS)
