"""Loihi 1 as a :class:`machines.base.Backend`."""

import os
from collections.abc import Callable
from typing import Any

from spikeloom.compiler.counters import Counters
from spikeloom.compiler.targets.netlist_file import Netlist
from spikeloom.runtime.machines.backend import Backend, Lowered
from spikeloom.runtime.machines.base import Machine
from spikeloom.runtime.machines.exports import Format
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.requests.main_job import CompileRequest


class Loihi1(Backend):
    """Lists of weighted synapses onto compartments."""

    name = "loihi1"

    @property
    def counting_bits(self) -> int:
        """The widest that a synapse has."""
        return 8

    @property
    def formats(self) -> tuple[Format, ...]:
        """See :mod:`loihi1.exports`."""
        from spikeloom.runtime.machines.loihi1.exports import FORMATS

        return FORMATS

    @property
    def passes(self) -> tuple[str, ...]:
        """Of :mod:`targets.loihi1.passes`."""
        from spikeloom.compiler.targets.loihi1.passes import PASSES

        return tuple(step.name for step in PASSES)

    def lower(self, request: CompileRequest, after: Callable[[str, Any], object]) -> Lowered:
        """Networks of floats are rounded; a netx file brings its integers."""
        from spikeloom.runtime.machines.loihi1.lowering import lower

        return lower(request, after)

    def lower_counters(self, counters: Counters) -> Netlist:
        """As the float network that counts likewise, at 8 bits."""
        from spikeloom.compiler.formats.counters import counting_network
        from spikeloom.compiler.targets.loihi1.passes import compile_network

        return compile_network(counting_network(counters)).netlist

    def machine(self, netlist: Any) -> Machine:
        """Its simulator."""
        from spikeloom.runtime.machines.loihi1.machine import Loihi

        return Loihi(netlist)

    def load(self, path: str | os.PathLike[str]) -> Machine:
        """As :func:`netlist.read_netlist`."""
        from spikeloom.runtime.machines.loihi1.machine import load

        return load(path)

    def describe(self, path: str | os.PathLike[str]) -> Outcome:
        """See :mod:`loihi1.description`."""
        from spikeloom.runtime.machines.loihi1.description import inspect

        return inspect(path)
