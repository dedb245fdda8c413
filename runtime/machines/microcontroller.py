"""A small processor that one can buy, and the arithmetic of one: what events and cycles take, and standing still.

References
----------
.. [1] M. Horowitz, "Computing's energy problem (and what we can do about it)", ISSCC 2014, figure 1.1.9.
.. [2] Arm, "Cortex-M4 Technical Reference Manual", table 3-1: a load takes two cycles, arithmetic and stores one.
"""

from spikeloom.compiler.targets.base import Quantity

SOLD = "STM32L4R5 (Cortex-M4), data sheet DS12023, typical at 3 V and 25 °C: "

DECK = "x3beche.github.io/stm32l4r5-deck/low-power, which restates the data sheet"
"""Where the figures of the data sheet were read."""

ARITHMETIC = "Horowitz, ISSCC 2014, figure 1.1.9 (45 nm, 0.9 V)"


def _sold(value: float, unit: str, what: str, quote: str) -> Quantity:
    """A figure of the data sheet."""
    return Quantity(
        value=value, unit=unit, source=f"{SOLD}{what}", confidence="secondary", quote=f"{quote} ({DECK})"
    )


PRICES = {
    "add": Quantity(value=0.1, unit="pJ of 32 bits", source=ARITHMETIC),
    "multiply": Quantity(value=0.2, unit="pJ of 8 bits", source=ARITHMETIC),
    "access_8": Quantity(value=10.0, unit="pJ of 64 bits in 8 KiB", source=ARITHMETIC),
    "access_32": Quantity(value=20.0, unit="pJ of 64 bits in 32 KiB", source=ARITHMETIC),
    "access_1024": Quantity(value=100.0, unit="pJ of 64 bits in 1 MiB", source=ARITHMETIC),
    "cycle": _sold(300.0, "pJ", "100 µA/MHz", "Run @ 80 MHz | ≈ 100 µA/MHz"),
    "asleep": _sold(3.6e-3, "mW", "1.2 µA, memory kept (Stop 2)", "Stop 2 | ≈ 1.2 µA | all SRAM + regs"),
    "idle": _sold(7.2, "mW", "30 µA/MHz at 80 MHz (Sleep)", "Sleep | ≈ 30 µA/MHz | everything"),
}
"""Of a processor: events in pJ, static power in mW."""

CLOCK_HZ = 80e6

# Load, raise and store a count, load its threshold, compare, branch; load a weight and a sum, add, store,
# count on
EVENT_CYCLES = 12
ADD_CYCLES = 8
