"""The networks of a chart, and the storages that a grid asks for."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any, ClassVar

from spikeloom.compiler.archive import arrays_digest
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.formats.counters import SYSTEM, counting_network, read_counters
from spikeloom.compiler.ir import Form
from spikeloom.compiler.storage import Packing
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.compartments import check_packings
from spikeloom.compiler.targets.netlist_file import origin_of
from spikeloom.compiler.types import JsonObject
from spikeloom.models.recordings.evtouch import WHOLE, Recordings, data_digest, first_part
from spikeloom.models.systems import NO_GRAPH
from spikeloom.runtime.inputs import repeat
from spikeloom.runtime.inputs.checkpoint import load_checkpoint, load_graph, propagation
from spikeloom.runtime.inputs.files import PRETRAINED, shipped
from spikeloom.runtime.inputs.network import CHECKPOINT, COUNTING, reader_of
from spikeloom.runtime.report.encode import HIDDEN, key
from spikeloom.runtime.requests.choices import NetworkChoice
from spikeloom.runtime.requests.choose import ChartRequest
from spikeloom.runtime.studies.chart.grid import Grid


@dataclass(frozen=True, slots=True, kw_only=True)
class Storage:
    """How a network is stored on the chip: width of all layers or of each, planes, scale groups, pruning."""

    bits: tuple[int, ...]
    planes: int
    groups: int
    prune: bool
    own: bool = field(default=False, metadata=key("fine_tuned"))  # Whether the network was fine-tuned for it

    def options(self) -> JsonObject:
        """Options of ``compile`` that ask for it; a network that was fine-tuned for its own takes none."""
        if self.own:
            return {}
        return {
            "weight_bits": ",".join(map(str, self.bits)),
            "planes": None if self.planes == 1 else str(self.planes),
            "scale_groups": None if self.groups == 1 else str(self.groups),
            "prune_unused": self.prune,
        }

    def label(self) -> str:
        """Short name: ``4b``, ``8-4-4-8b 2p 3g pruned``."""
        parts = [f"{'-'.join(map(str, self.bits))}b"]
        parts += [] if self.planes == 1 else [f"{self.planes}p"]
        parts += [] if self.groups == 1 else [f"{self.groups}g"]
        return " ".join([*parts, *(["pruned"] if self.prune else [])])


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkFile:
    """A network of a chart."""

    json_properties: ClassVar = ("validation",)

    path: str
    name: str  # Short, and no other network of the chart has it
    graph: str  # That it was trained on; ``none`` of systems without
    sha256: str
    weights: str  # Which of those in the file
    system: str
    bins: int = 1  # Bins of the recordings that a step joins
    length: int | None = field(
        default=None, metadata=HIDDEN
    )  # Steps that every recording is run, where it says so
    options: tuple[tuple[str, Any], ...] = field(
        metadata=HIDDEN
    )  # How it is read: as typed, if they suit it
    sees: str = field(default="", metadata=HIDDEN)  # Hash over what its first layer sees
    taxels: int = field(metadata=HIDDEN)
    classes: int = field(metadata=HIDDEN)
    layers: tuple[str, ...] = field(metadata=HIDDEN)  # Names
    training: Mapping[str, Any] = field(metadata=HIDDEN, compare=False)  # As far as the file knows it
    forms: tuple[Form, ...] | None = field(
        default=None, metadata=HIDDEN, compare=False
    )  # That it was fine-tuned for

    @property
    def validation(self) -> float | None:
        """Share of recordings that its training left out and then decided right, where the file says so."""
        counts = self.training.get("validation")
        if not isinstance(counts, Mapping) or not counts.get("samples"):
            return None
        return float(counts["correct"] / counts["samples"])

    @property
    def window(self) -> int:
        """Per cent of each recording that trained it."""
        window: int = origin_of(self.training).get("window", WHOLE)
        return window

    @property
    def identity(self) -> JsonObject:
        """What tells it from others, wherever its file is."""
        about = {"checkpoint": self.sha256, "weights": self.weights, "sees": self.sees}
        return about | {"options": dict(self.options)}

    def choice(self) -> NetworkChoice:
        """How it is read."""
        return NetworkChoice(**dict(self.options))

    def storages(self, grid: Grid) -> Iterator[Storage]:
        """Every storage that a grid asks for; of a network that was fine-tuned for one its own and no other."""
        if self.forms is not None:
            bits = tuple(form.bits for form in self.forms)
            yield Storage(
                bits=bits[:1] if len(set(bits)) == 1 else bits,
                planes=max(len(form.exponents) for form in self.forms),
                groups=max(len(set(form.threshold.tolist())) for form in self.forms),
                prune=False,
                own=True,
            )
        else:
            for bits, planes, groups, prune in product(grid.bits, grid.planes, grid.groups, grid.prune):
                yield Storage(bits=bits, planes=planes, groups=groups, prune=bool(prune))


def read_networks(request: ChartRequest) -> tuple[NetworkFile, ...]:
    """Networks of ``checkpoints``; refused if one cannot be used, or is given twice."""
    paths = request.checkpoints
    for path in paths:
        if paths.count(path) > 1:
            raise OptionError(f"{path}: is given twice; give each checkpoint once")
    stems = [Path(path.removeprefix(PRETRAINED)).stem for path in paths]
    names = [stem if stems.count(stem) == 1 else f"{stem}-{number}" for number, stem in enumerate(stems, 1)]
    return tuple(_read(path, name, request) for path, name in zip(paths, names, strict=True))


def _read(path: str, name: str, request: ChartRequest) -> NetworkFile:
    reader = reader_of(path)
    if reader is COUNTING:
        return _counting(path, name)
    if reader is not CHECKPOINT:
        raise ModelError(
            f"{path}: is {reader.title}, a chart takes checkpoints; give the checkpoint that it was made of"
        )
    checkpoint = load_checkpoint(path, request)
    typed = repeat.given(request, repeat.NETWORK)
    if checkpoint.edges is not None:  # one that knows its graph needs no option; others of the same call may
        typed |= {"graph": None, "edges": None, "directed": False}
    known_graph = load_graph(replace(request, **typed), checkpoint.system)
    graph, sees = propagation(checkpoint, known_graph, path)
    if checkpoint.edges is not None:
        typed["taxels"] = None
    return NetworkFile(
        path=path,
        name=name,
        graph=graph,
        sha256=checkpoint.sha256,
        weights=checkpoint.weights,
        system=checkpoint.system,
        bins=checkpoint.bins,
        options=tuple(typed.items()),
        sees=arrays_digest({"propagation": sees}),
        taxels=checkpoint.taxels,
        classes=checkpoint.classes,
        layers=tuple(checkpoint.neurons),
        training=checkpoint.training or {},
        forms=checkpoint.forms,
    )


def _counting(path: str, name: str) -> NetworkFile:
    counters, sha256 = read_counters(shipped(path))
    return NetworkFile(
        path=path,
        name=name,
        graph=NO_GRAPH,
        sha256=sha256,
        weights="last",
        system=SYSTEM,
        bins=counters.bins,
        length=counters.clocks.length,
        options=tuple((option, repeat.USUAL.get(option)) for option in repeat.NETWORK),
        taxels=counters.taxels,
        classes=counters.classes,
        layers=tuple(population.name for population in counting_network(counters).populations),
        training=counters.training,
    )


def require_suited(networks: Sequence[NetworkFile], splits: Mapping[str, Recordings], digest: str) -> None:
    """Refuse networks that do not belong together, or were trained on other recordings than these of this hash."""
    first = networks[0]
    for network in networks:
        if (network.taxels, network.classes) != (first.taxels, first.classes):
            raise ModelError(
                f"{network.path}: has {network.taxels} taxels and {network.classes} classes, {first.path} has "
                f"{first.taxels} and {first.classes}; chart networks of one data set at a time"
            )
        width = splits["test"].seconds
        own = network.training.get("bin_s")
        if own not in (None, width):
            raise ModelError(
                f"{network.path}: was trained on bins of {own:g} s, {first.path} reads bins of {width:g} s; chart "
                "networks of one width at a time"
            )
        parts = [first_part(splits[split], network.window) for split in ("train", "test")]
        trained = digest if network.window == WHOLE else data_digest(*parts)
        if network.training.get("data_sha256") not in (None, trained):
            raise ModelError(
                f"{network.path}: was trained on other recordings ({network.training.get('data', 'others')}) "
                f"than {splits['test'].source}; give those, or a checkpoint that was trained on these"
            )


def require_grid(networks: Sequence[NetworkFile], grid: Grid, target: Target) -> None:
    """Refuse widths and layouts by layer that do not suit a network's layers."""
    for network in networks:
        path = network.path
        layers = network.layers
        for bits in grid.bits if network.forms is None else ():
            if len(bits) not in (1, len(layers)):
                raise OptionError(
                    f"--grid bits={'+'.join(map(str, bits))}: {len(bits)} widths, {path} has {len(layers)} "
                    f"layers ({', '.join(layers)}); give one width, or one for each layer"
                )
            check_packings([Packing(bits=width) for width in bits], len(layers), target)
        for layout in grid.cores:
            for part in layout.split("+") if ":" in layout else ():
                layer = part.partition(":")[0]
                if layer not in layers:
                    raise OptionError(
                        f"--grid cores={layout}: {path} has no layer {layer}; it has {', '.join(layers)}"
                    )
