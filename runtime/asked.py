"""The float network that a command is given: a checkpoint on its graph, or an ONNX or NIR file that holds all."""

from __future__ import annotations

import argparse
from dataclasses import dataclass

from compiler.errors import OptionError
from compiler.fixedpoint import FloatArray
from compiler.frontends.checkpoint import Checkpoint
from compiler.frontends.nir import SUFFIX as NIR
from compiler.frontends.nir import NirNetwork, read_nir
from compiler.frontends.onnx import SUFFIX as ONNX
from compiler.frontends.onnx import OnnxNetwork, read_onnx
from compiler.ir import Network
from compiler.passes.expand import expand
from runtime.inputs import asked_checkpoint, asked_graph, progress, propagation

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
        What its first layer sees, likewise; see :func:`compiler.passes.expand.stack_of`.
    graph : str or None
        Its name, likewise.
    facts : tuple of str
        What was read from an ONNX or NIR file and what was assumed.
    sha256 : str
        Of the file.
    """

    network: Network
    checkpoint: Checkpoint | None
    adjacency: FloatArray | None
    graph: str | None
    facts: tuple[str, ...]
    sha256: str

    @property
    def model(self) -> Checkpoint | Network:
        """What float spikes are computed from: the checkpoint in its own operator order where there is one."""
        return self.network if self.checkpoint is None else self.checkpoint


def asked_network(path: str, arguments: argparse.Namespace) -> Asked:
    """Read what a command is given.

    Raises
    ------
    OptionError, ModelError
        If it is not there, not as the options say, or an option is for the other kind of file.
    """
    suffix = next((suffix for suffix in (ONNX, NIR) if path.endswith(suffix)), None)
    _require_fit(path, suffix, arguments)
    if suffix is None:
        checkpoint = asked_checkpoint(path, arguments)
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
    found: OnnxNetwork | NirNetwork
    if suffix == ONNX:
        found = read_onnx(path, **layout)
    else:
        found = read_nir(path, dt=arguments.dt, convention=arguments.convention, **layout)
    return Asked(
        network=found.network, checkpoint=None, adjacency=None, graph=None, facts=found.facts, sha256=found.sha256
    )


def _require_fit(path: str, suffix: str | None, arguments: argparse.Namespace) -> None:
    """Refuse options that are for another kind of file."""
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
