"""Where a page is from: files and their hashes, versions, and the commands that repeat it."""

from __future__ import annotations

import argparse
import hashlib
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom import __version__
from spikeloom.compiler import Netlist
from spikeloom.compiler.files import sha256_of
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.types import JsonObject
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.inputs import repeat
from spikeloom.runtime.inputs.network import LoadedNetwork
from spikeloom.runtime.report.encode import INLINE

PACKAGES = ("numpy", "scipy", "torch", "numba", "networkx")
"""Packages whose versions may move a float spike."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Origin:
    """A file, or recordings with a hash over their events and labels, and what is known of it."""

    file: str
    sha256: str
    facts: Mapping[str, Any] = field(metadata=INLINE)


@dataclass(frozen=True, slots=True, kw_only=True)
class Provenance:
    """Files and their hashes, titles of the chip's tables, versions, and what to type for all of it again."""

    netlist: Origin
    checkpoint: Origin
    data: Origin
    tables: Mapping[str, str]
    versions: Mapping[str, str]
    commands: Mapping[str, str]


def provenance(
    arguments: argparse.Namespace,
    netlist: Netlist,
    target: Target,
    loaded: LoadedNetwork,
    data: Recordings,
    recording: str,
) -> Provenance:
    """Where everything is from; `recording` is the one that is drawn.

    File names are those of the files, without their folders; the page is always called ``report.html``.
    """
    checkpoint = loaded.checkpoint
    digest = hashlib.sha256()
    for name, array in data.identity().items():
        digest.update(f"{name} {array.shape} {array.dtype.str}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    facts: JsonObject = dict.fromkeys(("system", "weights", "dynamics", "training"))
    if checkpoint is not None:
        facts |= {"system": checkpoint.system, "weights": checkpoint.weights, "training": checkpoint.training}
        facts |= {"dynamics": None if checkpoint.dynamics.is_plain else checkpoint.dynamics.to_json()}
    facts |= {"graph": loaded.graph, "bins": netlist.bins}
    recorded = {"split": data.split, "samples": len(data), "bin_s": arguments.bin}
    return Provenance(
        netlist=Origin(
            file=Path(arguments.netlist).name,
            sha256=sha256_of(arguments.netlist),
            facts={"compiled": dict(netlist.provenance)},
        ),
        checkpoint=Origin(file=Path(arguments.checkpoint).name, sha256=loaded.sha256, facts=facts),
        data=Origin(file=Path(data.source).name, sha256=digest.hexdigest(), facts=recorded),
        tables={f"energy, {table.name}": table.title for table in target.energy}
        | {f"time, {table.name}": table.title for table in target.time},
        versions={"spikeloom": __version__, "python": platform.python_version()}
        | {name: metadata.version(name) for name in PACKAGES},
        commands=_commands(arguments, netlist, recording),
    )


def _commands(arguments: argparse.Namespace, netlist: Netlist, recording: str) -> dict[str, str]:
    """What to type, and what each is for."""

    def name(given: Any) -> str:
        path = "" if given is None else str(getattr(given, "source", given))  # recordings that Python handed over
        return Path(path).name or path

    net, checkpoint, data = name(arguments.netlist), name(arguments.checkpoint), name(arguments.data)
    options = repeat.given(arguments, repeat.NETWORK)
    options |= {option: name(options[option]) or None for option in ("taxels", "edges")}
    model = repeat.words(options | {"polarities": arguments.polarities})
    if arguments.polarities_first is not None:
        model.append("--polarities-first" if arguments.polarities_first else "--polarities-last")
    split = None if arguments.split == "test" else arguments.split
    read = ["--data", data, *repeat.words({"split": split, "limit": arguments.limit, "bin": arguments.bin})]
    spec = repeat.words({"spec_samples": None if arguments.spec_samples == 3 else arguments.spec_samples})
    both = [net, "--checkpoint", checkpoint, *model, *read]
    lines = {
        "verdict and ladder": ["verify", *both, *spec],
        "energy and time": ["estimate", net, *read],
        "why this recording differs": ["explain", *both, "--sample", recording],
        "this page": ["report", *both, *spec, "--recording", recording, "-o", "report.html"],
    }
    if "weight_bits" in netlist.provenance:
        compiled = repeat.words(_compile_options(netlist.provenance, data))
        lines = {"the netlist": ["compile", checkpoint, *model, *compiled, "-o", net]} | lines
    return {what: repeat.command(*words) for what, words in lines.items()}


def _compile_options(made: Mapping[str, Any], data: str) -> JsonObject:
    """Options of the compilation as far as the netlist remembers them."""
    options: dict[str, Any] = {}
    for name, usual in (("weight_bits", 8), ("planes", 1), ("scale_groups", 1)):
        value = made.get(name, usual)
        if value != usual and not made.get("fine_tuned"):
            options[name] = ",".join(map(str, value)) if isinstance(value, list) else value
    options |= {name: made.get(name) or None for name in ("spike_exact", "keep_all", "prune_unused")}
    if made.get("cores_for"):
        options["cores_for"] = ",".join(f"{layer}={count}" for layer, count in made["cores_for"].items())
    options |= {name: made.get(name) for name in ("chips", "optimize")}
    return options | {"calibrate": data if made.get("calibrated") else None}
