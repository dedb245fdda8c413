"""Formats of other programs that the machines can write."""

from __future__ import annotations

from spikeloom.runtime.machines.export_format import Format
from spikeloom.runtime.machines.loihi1.exports import FORMATS as LOIHI1
from spikeloom.runtime.machines.truenorth.exports import FORMATS as TRUENORTH

FORMATS: tuple[Format, ...] = (*LOIHI1, *TRUENORTH)
