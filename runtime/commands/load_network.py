"""The float network that a command is given: a checkpoint on its graph, or an ONNX or NIR file that holds all."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.fixedpoint import FloatArray
from spikeloom.compiler.formats.checkpoint import Checkpoint
from spikeloom.compiler.formats.netx.layout import SUFFIX as NETX
from spikeloom.compiler.formats.nir.neurons import CONVENTIONS
from spikeloom.compiler.formats.nir.reader import SUFFIX as NIR
from spikeloom.compiler.formats.nir.reader import NirNetwork, read_nir
from spikeloom.compiler.formats.nir.sidecar import read_said
from spikeloom.compiler.formats.onnx.reader import SUFFIX as ONNX
from spikeloom.compiler.formats.onnx.reader import OnnxNetwork, read_onnx
from spikeloom.compiler.ir import Network
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.runtime.commands.inputs import asked_checkpoint, asked_graph, propagation
from spikeloom.runtime.report.console import progress

TITLES = {ONNX: "ONNX", NIR: "NIR"}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Asked:
    """A float network and where it is from.

    Parameters
    ----------
    network : Network
        Float stage.
    checkpoint : Checkpoint or None
        Where it is from one.
    adjacency : (taxels, taxels) or (filters, places, taxels) float64, or None
        What its first layer sees, likewise; see :func:`expand.stack_of`.
    graph : str or None
        Its name, likewise.
    facts : tuple of str
        What was read from an ONNX or NIR file and what was assumed.
    sha256 : str
        Of the file.
    format : str
        ``checkpoint``, ``onnx`` or ``nir``.
    read_as : JSON values
        How it was read, beyond what it says: the time step of a NIR file.
    """

    network: Network
    checkpoint: Checkpoint | None
    adjacency: FloatArray | None
    graph: str | None
    facts: tuple[str, ...]
    sha256: str
    format: str = "checkpoint"
    read_as: Mapping[str, Any] = field(default_factory=dict)

    def origin(self, run: int) -> dict[str, Any]:
        """What a netlist remembers of the file; `run` is which of a released file's runs was asked for."""
        if self.checkpoint is None:
            return {"format": self.format, **self.read_as}
        return {"run": run, "weights": self.checkpoint.weights, "graph": self.graph}

    @property
    def model(self) -> Checkpoint | Network:
        """What float spikes are computed from: the checkpoint in its own operator order where there is one."""
        return self.network if self.checkpoint is None else self.checkpoint


def asked_network(path: str, arguments: argparse.Namespace, netlist: Netlist | None = None) -> Asked:
    """Read what a command is given.

    Of a checkpoint that holds several epochs, the one that `netlist` was compiled from where the options name none.

    Raises
    ------
    OptionError, ModelError
        If it is not there, not as the options say, or an option is for the other kind of file.
    """
    suffix = next((suffix for suffix in (ONNX, NIR) if path.endswith(suffix)), None)
    _require_fit(path, suffix, arguments)
    if suffix is None:
        checkpoint = asked_checkpoint(path, arguments)
        if netlist is not None and arguments.weights is None and _from_file(netlist, checkpoint):
            made = netlist.provenance["weights"]
            checkpoint = asked_checkpoint(path, argparse.Namespace(**(vars(arguments) | {"weights": made})))
        graph, adjacency = propagation(checkpoint, asked_graph(arguments, checkpoint.system), path)
        return Asked(
            network=expand(checkpoint, adjacency),
            checkpoint=checkpoint,
            adjacency=adjacency,
            graph=graph,
            facts=(),
            sha256=checkpoint.sha256,
        )
    progress("reading the network")
    layout = {"polarities": arguments.polarities, "polarities_first": arguments.polarities_first}
    if suffix == ONNX:
        onnx = read_onnx(path, **layout)
        return _asked(onnx, "onnx", {})
    said = read_said(path, CONVENTIONS) if arguments.dt is None else None
    dt = arguments.dt if said is None else said.dt
    convention = arguments.convention or (CONVENTIONS[0] if said is None else said.convention)
    return _asked(read_nir(path, dt=dt, convention=convention, **layout), "nir", {"dt": dt, "convention": convention})


def _from_file(netlist: Netlist, checkpoint: Checkpoint) -> bool:
    """Whether a netlist was compiled from another epoch of the same file."""
    made = netlist.provenance
    if made.get("checkpoint_sha256") != checkpoint.sha256:
        return False
    return made.get("weights") in checkpoint.sets and made["weights"] != checkpoint.weights


def _asked(found: OnnxNetwork | NirNetwork, kind: str, read_as: Mapping[str, Any]) -> Asked:
    return Asked(
        network=found.network,
        checkpoint=None,
        adjacency=None,
        graph=None,
        facts=found.facts,
        sha256=found.sha256,
        format=kind,
        read_as=read_as,
    )


def _require_fit(path: str, suffix: str | None, arguments: argparse.Namespace) -> None:
    """Refuse options that are for another kind of file, and files that hold no float network."""
    if path.endswith(NETX):
        raise OptionError(f"{path}: holds integers, no float network to compare with; compile, inspect and run it")
    if suffix is None:
        layout = {"--polarities": arguments.polarities, "--polarities-first or -last": arguments.polarities_first}
        for option, value in layout.items():
            if value is not None:
                raise OptionError(f"{option}: is for ONNX and NIR files, {path} is none; leave it away")
    else:
        for name in ("system", "graph", "taxels", "edges", "directed", "weights", "beta", "theta", "run"):
            if getattr(arguments, name) not in (None, False, 0):
                raise OptionError(
                    f"--{name}: is for checkpoints, the {TITLES[suffix]} file {path} holds all it needs; leave it away"
                )
    if suffix != NIR:
        for name in ("dt", "convention"):
            if getattr(arguments, name) is not None:
                raise OptionError(f"--{name}: is for NIR files, {path} is none; leave it away")
