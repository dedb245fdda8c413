"""File of a network trained for crossbar cores; an archive of :mod:`compiler.archive`.

Members, format version 1: the ``manifest`` (``format`` "spikeloom-native", ``version``, ``taxels``,
``polarities``, ``classes``, ``copies``, ``clocks``, ``graph`` with ``name`` and ``edges``, ``layers``,
``towers``: 1, ``weights``: the sets in the file, and ``training``: how it was made and what it reached), for
every set and layer ``SET/0/LAYER/PART`` with the parts of :class:`native.Stage`, and the ``sha256``. All
numbers are whole: what is in the file is what the chip computes.
"""

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler import archive
from spikeloom.compiler.arrays import read_only
from spikeloom.compiler.checkpoint import WEIGHTS
from spikeloom.compiler.dynamics import Clocks
from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.files import reading, sha256_of
from spikeloom.compiler.targets.truenorth.native import NativeNetwork, Stage, faults
from spikeloom.compiler.types import IntArray

VERSION = 1
PARTS = {"inputs": 2, "level": 3, "threshold": 1, "floor": 1, "leak": 1}
"""Arrays of a stage, in file order, and their axes."""

KINDS: dict[str, archive.Kind] = {
    "layers": [str, ...],
    "clocks": archive.CLOCKS,
    "weights": [frozenset(WEIGHTS), ...],
    "graph": archive.GRAPH,
    "towers": (1, 1),
    "training": dict,
    **dict.fromkeys(("taxels", "polarities", "classes", "copies"), (1, 2**20)),
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trained:
    """What a file holds: the network of the chosen set `weights`, and all `sets`.

    `graph` and `edges` (edges, 2), source and target, are those of the taxel graph; `training` are JSON
    values: how the network was made and what it reached; the hash is the file's.
    """

    network: NativeNetwork
    weights: str
    sets: tuple[str, ...]
    graph: str
    edges: IntArray
    training: Mapping[str, Any]
    sha256: str


def write_trained(
    path: str | os.PathLike[str],
    networks: Mapping[str, NativeNetwork],
    *,
    graph: str,
    edges: IntArray,
    training: Mapping[str, Any],
) -> str:
    """Write a file, whole or not at all; return its sha256. Equal input gives equal bytes.

    The `networks`, ``last``, ``best`` or ``clean``, are of one shape; the rest is as in :class:`Trained`.
    """
    one = next(iter(networks.values()))
    manifest = {
        "format": archive.TRAINED,
        "version": VERSION,
        **{name: getattr(one, name) for name in ("taxels", "polarities", "classes", "copies")},
        "clocks": one.clocks.to_json(),
        "graph": {"name": graph, "edges": edges.tolist()},
        "layers": [stage.name for stage in one.stages],
        "towers": 1,
        "weights": list(networks),
        "training": dict(training),
    }
    arrays = {
        f"{which}/0/{stage.name}/{part}": getattr(stage, part)
        for which, network in networks.items()
        for stage in network.stages
        for part in PARTS
    }
    return archive.write_archive(archive.archive_bytes(manifest, arrays), path)


def is_trained(path: str | os.PathLike[str]) -> bool:
    """Whether a file is an archive that says it holds such a network."""
    return archive.stated(Path(path), "format") == archive.TRAINED


def read_trained(path: str | os.PathLike[str], *, weights: str | None = None) -> Trained:
    """Read and check a file; `weights` is the set to take, the first of ``last``, ``best`` and ``clean`` by default.

    ModelError if it is missing, damaged, altered, from a newer version or inconsistent, or has no such set.
    """
    path = Path(path)

    def names(manifest: Mapping[str, Any]) -> Iterable[str]:
        members = product(manifest["weights"], manifest["layers"], PARTS)
        return [f"{which}/0/{layer}/{part}" for which, layer, part in members]

    with reading(path, ModelError, archive.AGAIN):
        manifest, members = archive.read_archive(path, archive.TRAINED, VERSION, KINDS, names)
        sets = tuple(name for name in WEIGHTS if name in manifest["weights"])
        chosen = sets[0] if weights is None else weights
        if chosen not in sets:
            raise ModelError(
                f"--weights {weights}: the file holds {', '.join(sets)}; choose one that it holds"
            )
        stages: dict[str, dict[str, Any]] = {
            layer: {part: members[f"{chosen}/0/{layer}/{part}"] for part in PARTS}
            for layer in manifest["layers"]
        }
        archive.require_none(
            f"{name}: {fault}"
            for name, parts in stages.items()
            for fault in archive.array_faults(parts, PARTS)
        )
        network = NativeNetwork(
            **{name: manifest[name] for name in ("taxels", "polarities", "classes", "copies")},
            clocks=Clocks(**manifest["clocks"]),
            stages=tuple(
                Stage(
                    name=layer, **{part: read_only(array.astype(np.int64)) for part, array in parts.items()}
                )
                for layer, parts in stages.items()
            ),
        )
        wrong = faults(network)
        edges = np.array(manifest["graph"]["edges"], np.int64).reshape(-1, 2)
        if edges.max(initial=0) >= network.taxels:
            wrong.append(f"the graph joins taxels outside 0..{network.taxels - 1}")
        archive.require_none(wrong)
    return Trained(
        network=network,
        weights=chosen,
        sets=sets,
        graph=manifest["graph"]["name"],
        edges=read_only(edges),
        training=manifest["training"],
        sha256=sha256_of(path),
    )
