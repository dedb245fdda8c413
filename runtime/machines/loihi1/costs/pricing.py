"""Loihi 1's prices as :class:`machines.base.Pricing`."""

from dataclasses import dataclass

from spikeloom.compiler.types import EventArray, IntArray
from spikeloom.runtime.machines.base import Price
from spikeloom.runtime.machines.loihi1.costs.estimate import Estimator, Totals
from spikeloom.runtime.machines.loihi1.costs.result import cost_report
from spikeloom.runtime.machines.loihi1.costs.sections import sections
from spikeloom.runtime.machines.loihi1.trace import Trace
from spikeloom.runtime.report.sections import Outcome

HELD = 1 << 25
"""Bytes of spikes and updates, of sums of the time model, or of counts that are held at a time."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoihiPricing:
    """Costs, of the cores' tiles and times too."""

    estimator: Estimator

    def batch(self, steps: int) -> int:
        """As many recordings as keep small what is held of each step."""
        netlist = self.estimator.engine.netlist
        charges = self.estimator.charges
        sums = 0 if charges is None else 8 * charges.sources.shape[1]
        each_step = 2 * netlist.n_compartments if self.estimator.deep else sums
        return max(1, HELD // max(each_step * (steps + netlist.drain), 16 * netlist.n_compartments))

    def run(self, channels: EventArray, lengths: IntArray | None) -> tuple[Trace, Totals]:
        """Events, and times of each step."""
        trace, estimated = self.estimator.estimate(channels, lengths)
        return trace, estimated.totals

    def price(self, totals: Totals, bin_s: float) -> Price:
        """By layer, core and table."""
        target = self.estimator.target
        report = cost_report(self.estimator.engine.netlist, target, totals, bin_s=bin_s)
        costs = totals.costs(target)
        energy = {name: each.sum(axis=1) for name, each in costs.energy.items()}
        return Price(
            synaptic_operations=costs.synaptic_operations.sum(axis=1),
            energy_j=energy,
            time_s={name: times.seconds for name, times in totals.simple.items()},
            step_s={name: float(times.longest_ns.max() * 1e-9) for name, times in totals.simple.items()},
            dynamic_j=energy,
            static_w={each.source: each.chips * each.chip_w for each in report.static},
            outcome=Outcome(report, sections),
        )
