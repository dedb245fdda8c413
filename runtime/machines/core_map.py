"""Where the cores of a netlist lie, how full each is, and who sends how much to whom."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from spikeloom.runtime.report.encode import key


@dataclass(frozen=True, slots=True, kw_only=True)
class Fill:
    """Use of a limit."""

    used: int
    allowed: int
    share: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Core:
    """A core: its place, what it holds, and its use of each limit, of which one is the fullest."""

    core: int
    chip: int
    tile: int
    x: int
    y: int
    layers: tuple[str, ...]
    compartments: int
    fullest: str
    fill: Mapping[str, Fill]


@dataclass(frozen=True, slots=True, kw_only=True)
class Way:
    """Packets of a mean recording from a core, or None for the input, to another."""

    source: int | None = field(metadata=key("from"))
    to: int
    packets: float
    axons: int
    hops: int | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Mesh:
    """Tiles of a chip, and cores of a tile."""

    width: int
    height: int
    tile_cores: int


@dataclass(frozen=True, slots=True, kw_only=True)
class CoreMap:
    """Where the cores lie, how full each is, and who sends how much to whom."""

    mesh: Mesh
    cores: tuple[Core, ...]
    traffic: tuple[Way, ...]
