"""Costs laid out for people: the mean inference and its range, where energy and time go."""

from spikeloom.models.recordings.counts import number
from spikeloom.runtime.machines import injection
from spikeloom.runtime.machines.loihi1.costs.result import Amounts, CostReport, Host
from spikeloom.runtime.report.numbers import dominant, si
from spikeloom.runtime.report.sections import Section, Table, Text

DYNAMIC = "dynamic energy, "
"""Before the name of a table: what events take; what flows whatever happens, static power, stands by itself."""


def sections(report: CostReport) -> list[Section]:
    """Amounts, layers, parts of the chip, cores, and what power and times come to."""
    most = "up to " if report.unequal else ""
    steps = (
        f"per inference of {most}{report.chip_steps} chip steps, over {number(report.samples, 'recording')}:"
    )
    parts = report.energy_by_part_j
    rows = [[table, *(si(value, "J") for value in each.values())] for table, each in parts.items()]
    by_part = [Table(["dynamic energy by part", *next(iter(parts.values()))], rows)] if parts else []
    return [
        Section("Inference", [Text(steps), inference_table(report)]),
        Section("Layers", [layer_table(report)]),
        Section("Parts", by_part),
        Section("Cores", [core_table(report)] if report.time else []),
        Section("Power", [Text("\n".join(_lines(report)))]),
    ]


def inference_table(report: CostReport) -> Table:
    """Amounts, energies and times of the mean inference and their range."""
    columns = (report.per_inference, report.min, report.max)

    def counts(name: str) -> list[str]:
        return [f"{getattr(each, name):,.0f}" for each in columns]

    *counted, _ = Amounts.__dataclass_fields__
    known = [name for name in counted if getattr(report.per_inference, name) is not None]
    rows = [[name.replace("_", " "), *counts(name)] for name in known]
    tables = report.per_inference.energy_j
    rows += [[f"{DYNAMIC}{name}", *(si(each.energy_j[name], "J") for each in columns)] for name in tables]
    rows += injection.rows(report.injection)
    rows += [
        [
            f"time, {each.table}, {each.model} model",
            *(si(each.inference_s[end], "s") for end in ("mean", "min", "max")),
        ]
        for each in report.time
    ]
    return Table(["", "mean", "min", "max"], rows)


def layer_table(report: CostReport) -> Table:
    """What each layer costs in the mean inference."""

    def cells(amounts: Amounts) -> list[str]:
        counts = amounts.synaptic_operations, amounts.spikes, amounts.neuron_updates
        return [
            *(f"{count:,.0f}" for count in counts),
            *(si(joules, "J") for joules in amounts.energy_j.values()),
        ]

    head = ["layer (mean)", "synaptic operations", "spikes", "neuron updates"]
    head += [f"{DYNAMIC}{name}" for name in report.per_inference.energy_j]
    return Table(head, [[layer.name, *cells(layer.amounts)] for layer in report.layers])


def core_table(report: CostReport) -> Table:
    """What each core does, and in how many steps the others wait for it."""
    critical = {
        (each.model, found.core): found.share_of_steps
        for each in report.time
        for found in each.critical_core
    }
    models = [each.model for each in report.time]
    head = ["core", "layers", "sweep and send", "receive", *(f"slowest, {model}" for model in models)]
    energies = list(report.cores[0].energy_j) if report.cores else []
    rows = [
        [
            str(core.core),
            " ".join(core.layers),
            *(si(next(iter(times.values()), 0.0), "s") for times in (core.sweep_s, core.receive_s)),
            *(f"{100 * critical.get((model, core.core), 0):.0f} %" for model in models),
            *(si(core.energy_j[name], "J") for name in energies),
        ]
        for core in report.cores
    ]
    return Table([*head, *(f"{DYNAMIC}{name}" for name in energies)], rows)


def _lines(report: CostReport) -> list[str]:
    pace = report.pace
    ends = report.energy_range_j
    lines = [f"prices, {name}: {title}" for name, title in report.prices.items()]
    if ends is not None:
        low, high = (f"{si(ends[end].energy_j, 'J')} ({ends[end].table})" for end in ("low", "high"))
        lines.append(f"sources differ: a mean inference takes a dynamic energy of {low} to {high}")
    if report.energy_by_part_j:
        neurons = ", ".join(
            f"{100 * each['soma'] / (sum(each.values()) or 1):.0f} % ({name})"
            for name, each in report.energy_by_part_j.items()
        )
        lines.append(
            f"soma, mostly the update of every neuron in every step, takes {neurons} of it; events take the rest"
        )
    real_time = ", ".join(f"{si(value, 'W')} ({name})" for name, value in pace.real_time_w.items())
    lines.append(f"dynamic power at the sensor's pace, {1000 * pace.bin_s:g} ms a step: {real_time}")
    lines += [
        f"at full speed ({each.time_table}, {each.model} model): {si(each.power_w, 'W')}, mean energy-delay product "
        f"{si(each.energy_delay_js, 'J s')} ({each.energy_table})"
        for each in pace.full_speed
    ]
    lines += [
        f"mesh ({each.table}): senders blocked for {si(each.blocked_s, 's')} an inference; at most "
        f"{each.peak_link_load:.1f} messages on a link"
        for each in report.time
        if each.blocked_s is not None
    ]
    for static in report.static:
        full = ", ".join(
            f"{si(each.energy_j, 'J')} ({each.time_table}, {each.model})" for each in static.full_speed_j
        )
        lines.append(
            f"static, not in the above: {si(static.chip_w, 'W')} a chip ({static.source}), so an inference "
            f"{'' if static.chips == 1 else f'on {static.chips} chips '}takes {si(static.real_time_j, 'J')} at the "
            "sensor's pace" + (f"; at full speed {full}" if full else "")
        )
    if report.static and report.per_inference.energy_j:
        lines.append(
            dominant([each.real_time_j for each in report.static], report.per_inference.energy_j.values())
        )
    lines.append(injection.line(report.injection))
    if report.host is not None:
        lines.append(_host_line(report.host))
    if report.measured:
        lines.append(report.measured)
    lines += [f"not modelled: {line}" for line in report.not_modelled]
    return [*lines, *(f"not priced: {line}" for line in report.not_priced)]


def _host_line(host: Host) -> str:
    step, inference = (
        " to ".join(si(each, "s") for each in ends) for ends in (host.step_s, host.inference_s)
    )
    energy = " to ".join(si(each, "J") for each in host.energy_j)
    return (
        f"fed by a host: times are the cores' alone; spikes through a chip's x86 cores added {step} to a step, which "
        f"makes {inference} an inference, and {energy} with these awake ({si(host.awake_w, 'W')})"
    )
