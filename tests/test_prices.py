"""Prices of chips and processors: each is what its quote says, and what other sources of it give."""

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

from spikeloom.compiler.targets.base import shipped
from spikeloom.runtime.machines.injection import injection, input_events, line, rows
from spikeloom.runtime.machines.microcontroller import CLOCK_HZ, PRICES

LOIHI, TRUENORTH = shipped()["loihi1"], shipped()["truenorth"]
NUMBER = re.compile(r"\d[\d,]*(?:\.\d+)?(?:e-\d+)?")
UNITS = {"pJ": 1e-12, "ns": 1e-9, "µs": 1e-6, "mW": 1e-3, "ms": 1e-3}


DERIVED = {
    "loihi1.energy.sanafe.neuron_active",
    "loihi1.limits.core.synapse_words",
    "loihi1.limits.core.synapse_formats",
    "loihi1.limits.mesh.tile_cores",
    "loihi1.static.frady2020",
    "truenorth.limits.tick.length",
    "truenorth.energy.marginal.synaptic_event",
    "truenorth.energy.marginal.floor",
}
"""Numbers that follow from their quotes, each in a test of its own."""


def numbers(quote):
    return [float(number.replace(",", "")) for number in NUMBER.findall(quote)]


def entries():
    """Every number of every chip, by its place."""
    found = {}
    for chip in (LOIHI, TRUENORTH):
        tables = {f"energy.{each.name}": each.prices for each in chip.energy}
        for each in chip.time:
            barriers = {f"barrier.{tiles}": length for tiles, length in each.barriers.items()}
            tables[f"time.{each.name}"] = {**each.latencies, **barriers, "link_buffer": each.link_buffer}
        tables |= {"limits": chip.limits, "static": chip.static}
        for table, of in tables.items():
            found |= {f"{chip.name}.{table}.{name}": entry for name, entry in of.items()}
    return found


ENTRIES = entries()


@pytest.mark.parametrize("name", [name for name in ENTRIES if ENTRIES[name].quote and name not in DERIVED])
def test_a_number_is_in_its_quote(name):
    entry = ENTRIES[name]
    wanted = (entry.value, entry.value * UNITS.get(entry.unit, 1.0))
    assert any(math.isclose(number, each) for number in numbers(entry.quote) for each in wanted)


def test_every_price_of_events_and_times_has_a_quote():
    priced = {name: entry for name, entry in ENTRIES.items() if ".energy." in name or ".time." in name}
    assert len(priced) == 31
    assert all(entry.quote and entry.source for entry in priced.values())


def test_an_update_is_an_access_and_what_comes_on_top():
    (sanafe,) = LOIHI.time
    prices = {each.name: each for each in LOIHI.energy}["sanafe"].prices
    access, update = numbers(prices["neuron_active"].quote)
    assert prices["neuron_active"].value == pytest.approx((access + update) * 1e12)
    assert prices["neuron_idle"].value == pytest.approx(access * 1e12)
    slots = LOIHI.limits["core.synapse_formats"]
    assert slots.value == numbers(slots.quote)[0] - 1  # index 0 is unused
    assert sanafe.barriers.keys() == {1, 2, 4, 29}
    tick = TRUENORTH.limits["tick.length"]
    assert tick.value == 1000 * numbers(tick.quote)[0]  # ms, in µs


def test_a_core_holds_its_published_memory_and_a_chip_its_published_neurons():
    limits = LOIHI.limits
    # Davies 2018, p. 89, constraint 2: 128 KB; Davies 2021, p. 913: 131,072 neurons on 128 cores
    assert limits["core.synapse_words"].value * limits["synapse.word_bits"].value == 128 * 1024 * 8
    assert limits["core.compartments"].value * limits["chip.cores"].value == 131_072
    tiles = limits["mesh.width"].value * limits["mesh.height"].value
    assert tiles * limits["mesh.tile_cores"].value == limits["chip.cores"].value
    # Davies 2018, p. 95: 60 mm2, 2,184 neurons a mm2
    assert limits["core.compartments"].value * limits["chip.cores"].value / 60 == pytest.approx(2184, abs=1)
    wide, high, cores = (
        TRUENORTH.limits[name].value for name in ("mesh.width", "mesh.height", "chip.cores")
    )
    assert wide * high == cores


def test_power_that_grows_with_time_is_that_of_other_measurements():
    watts, chips = (numbers(LOIHI.static["frady2020"].quote)[at] for at in (0, 1))
    assert LOIHI.static["frady2020"].value == pytest.approx(1000 * watts / chips, rel=1e-3)
    # the same paper's larger system, 53.4 W, which is 16 times as large
    assert LOIHI.static["frady2020"].value == pytest.approx(1000 * 53.4 / 512, rel=2e-3)
    measured = json.loads((Path(__file__).parents[1] / "benchmarks/results/silicon.json").read_text())[
        "measured"
    ]
    spotter, largest = measured["spotter"], measured["N=10"]
    # the paper's table against its logs, the x86 off
    assert LOIHI.static["blouw2019"].value == pytest.approx(1000 * spotter["idle_w"]["total"], rel=0.03)
    assert LOIHI.host["awake"].value == pytest.approx(1000 * spotter["after_w"]["total"], rel=1e-3)
    x86 = LOIHI.injection["x86 cores awake"].value
    for network in (spotter, largest):
        assert x86 == pytest.approx(
            1000 * (network["after_w"]["total"] - network["idle_w"]["total"]), rel=5e-3
        )
    assert 1000 * 2.09 / 32 < x86 < 1000 * 2.14 / 32  # Frady 2020, table 1, of another board
    for name, found in {"step_least": spotter, "step_most": largest}.items():
        assert LOIHI.host[name].value == pytest.approx(1000 / 10 / found["inferences_per_s"], rel=2e-3)


def test_prices_of_truenorth_are_those_of_measured_power():
    per_neuron = 2**20 * 128  # events a second of 1 Hz
    assert TRUENORTH.energy[0].joule("synaptic_event") == pytest.approx(72e-3 / (20 * per_neuron), rel=0.04)
    *points, synapses = numbers(TRUENORTH.energy[1].prices["synaptic_event"].quote)
    watts, rates = 1e-3 * np.array(points[::2]), np.array(points[1::2])
    slope = (watts[-1] - watts[0]) / (rates[-1] - rates[0])
    assert synapses == 128
    assert TRUENORTH.energy[1].joule("synaptic_event") == pytest.approx(slope / per_neuron, rel=5e-3)
    assert TRUENORTH.energy[1].floor_w == pytest.approx(watts[0] - slope * rates[0], rel=1e-3)
    # and the least squares through all three
    fitted = np.polyfit(rates * per_neuron, watts, 1)
    assert (TRUENORTH.energy[1].joule("synaptic_event"), TRUENORTH.energy[1].floor_w) == pytest.approx(
        tuple(fitted), rel=0.01
    )


def test_the_link_of_truenorth_is_its_bits():
    entry = TRUENORTH.injection["link and periphery"]
    link, _, periphery, _ = numbers(entry.quote)
    assert entry.value == 32 * (link + periphery)


def test_events_handed_in_are_priced_as_a_range():
    events = np.array([100, 300])
    steps = np.array([50, 150])
    program = 12 * 300e-12
    found = injection(LOIHI, 2, events, steps, 0.02)
    assert (found.events, found.least.mean, found.least.max) == pytest.approx(
        (200, 200 * program, 300 * program)
    )
    assert found.most.min == pytest.approx(100 * program + 2 * 66.6e-3)
    assert found.least.parts == ("a microcontroller's program",)
    crossbars = injection(TRUENORTH, 1, events, steps, 0.02)
    assert (crossbars.least.mean, crossbars.most.mean) == pytest.approx(
        (200 * 896e-12, 200 * (program + 896e-12))
    )
    assert "link and periphery, 896 pJ (Merolla" in line(crossbars)
    assert rows(found)[1] == ["events handed in, most", "266 mJ", "133 mJ", "400 mJ"]


def test_events_after_the_end_of_a_recording_are_not_handed_in():
    channels = np.ones((2, 3, 5), np.uint8)
    channels[1, 0, :] = 0
    assert input_events(channels, np.array([5, 2])).tolist() == [15, 4]


def test_prices_of_a_microcontroller_are_its_currents_at_three_volts():
    def amperes(name):
        return 1e-6 * numbers(PRICES[name].quote.split("≈")[1])[0]

    assert PRICES["cycle"].value * 1e-12 == pytest.approx(3 * amperes("cycle") / 1e6)
    assert PRICES["asleep"].value * 1e-3 == pytest.approx(3 * amperes("asleep"))
    assert PRICES["idle"].value * 1e-3 == pytest.approx(3 * amperes("idle") * CLOCK_HZ / 1e6)
