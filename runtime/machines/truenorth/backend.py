"""TrueNorth as a :class:`machines.base.Backend`."""

import os
from collections.abc import Callable
from typing import Any

from spikeloom.compiler.counters import Counters
from spikeloom.compiler.targets.netlist_file import Netlist
from spikeloom.runtime.inputs.files import shipped
from spikeloom.runtime.machines.backend import Backend, Lowered, Reference
from spikeloom.runtime.machines.base import Machine
from spikeloom.runtime.machines.exports import Format
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.requests.choices import ComparisonChoice
from spikeloom.runtime.requests.main_job import CompileRequest, InspectRequest


class TrueNorth(Backend):
    """Binary crossbars."""

    name = "truenorth"

    @property
    def counting_bits(self) -> int:
        """As wide as four axons of an input reach."""
        from spikeloom.compiler.targets.truenorth.counting import LARGEST

        return 1 + LARGEST.bit_length()

    @property
    def formats(self) -> tuple[Format, ...]:
        """See :mod:`truenorth.exports`."""
        from spikeloom.runtime.machines.truenorth.exports import FORMATS

        return FORMATS

    @property
    def passes(self) -> tuple[str, ...]:
        """Of :mod:`targets.truenorth.passes`."""
        from spikeloom.compiler.targets.truenorth.passes import PASSES

        return tuple(step.name for step in PASSES)

    def lower(self, request: CompileRequest, after: Callable[[str, Any], object]) -> Lowered:
        """Networks that were trained for the chip, and counting ones."""
        from spikeloom.runtime.machines.truenorth.lowering import lower

        return lower(request, after)

    def lower_counters(self, counters: Counters) -> Netlist:
        """Whole numbers already."""
        from spikeloom.compiler.targets.truenorth.passes import compile_crossbars

        return compile_crossbars(counters).netlist

    def machine(self, netlist: Any) -> Machine:
        """Its simulator."""
        from spikeloom.runtime.machines.truenorth.machine import TrueNorth as Simulated

        return Simulated(netlist)

    def load(self, path: str | os.PathLike[str]) -> Machine:
        """Held against every rule of the chip."""
        from spikeloom.runtime.machines.truenorth.machine import load

        return load(path)

    def describe(self, path: str | os.PathLike[str]) -> Outcome:
        """See :mod:`truenorth.description`."""
        from spikeloom.runtime.machines.truenorth.description import inspect

        return inspect(path)

    def is_trained_for(self, path: str) -> bool:
        """Whether it says so."""
        from spikeloom.compiler.targets.truenorth.native_file import is_trained

        return is_trained(shipped(path))

    def inspect(self, request: InspectRequest) -> Outcome:
        """Stages and levels."""
        from spikeloom.runtime.machines.truenorth.description import describe_trained
        from spikeloom.runtime.machines.truenorth.lowering import read

        return describe_trained(read(request.path, request))

    def reference(self, request: ComparisonChoice, netlist: Any) -> Reference:
        """Whole numbers, whose every spike must be the chip's."""
        from spikeloom.runtime.machines.truenorth.lowering import reference

        return reference(request, netlist)
