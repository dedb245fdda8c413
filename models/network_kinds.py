"""Every kind of network that can be trained."""

from spikeloom.models.training import float_kind
from spikeloom.models.training.plan import NetworkKind
from spikeloom.models.truenorth import kind as truenorth

KINDS: tuple[NetworkKind, ...] = (float_kind, truenorth)


def kind_of(system: str) -> NetworkKind:
    """The kind of network that a system is."""
    return next(kind for kind in KINDS if system in kind.SYSTEMS)
