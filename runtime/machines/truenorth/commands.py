"""What TrueNorth does in its own way: networks that were trained for it, and history-free ones (``--in-time``)."""

from __future__ import annotations

import argparse
from typing import Any

from spikeloom.runtime.machines.truenorth import in_time, joining, native
from spikeloom.runtime.machines.truenorth.refusal import refuse

takes = native.is_named
inspect = native.inspect
verify = native.verify
join = joining.join


def compile_network(arguments: argparse.Namespace) -> Any:
    """Place a network on cores and write it, or say why it does not fit."""
    if takes(arguments.checkpoint):
        return native.compile_network(arguments)
    return refuse(arguments) if arguments.in_time is None else in_time.compile_network(arguments)
