import tomllib
from importlib import resources

import pytest

from compiler.errors import OptionError
from compiler.passes.legalize import REMEDIES
from compiler.targets import known_targets, load_target

LIMITS = {
    "core.compartments": 1024,
    "core.axons_in": 4096,
    "core.axons_out": 4096,
    "core.synapse_words": 16 * 1024,  # 128 KiB of 64-bit words
    "core.threshold_slots": 8,
    "core.synapse_formats": 7,
    "core.compartment_configs": 32,
    "core.dense_base": 256,
    "chip.cores": 128,
    "synapse.block": 64,
    "synapse.block_header_bits": 4 + 6,
    "synapse.word_bits": 64,
    "mesh.tile_cores": 4,
    "mesh.width": 8,
    "mesh.height": 4,
}
CHOICES = {
    "synapse.weight_bits": (2, 3, 4, 5, 6, 8),
    "synapse.index_bits": (0, 6, 7, 8, 9, 10, 11, 12),
    "synapse.exponent": (-1, 0, 1, 2, 3, 4, 5, 6, 7),
}
DAVIES = {
    "synaptic_operation": 23.6,
    "neuron_idle": 52.0,
    "neuron_active": 81.0,
    "packet": 1.7,
    "hop_east_west": 3.0,
    "hop_north_south": 4.0,
}
SANAFE = {
    "synaptic_operation_dense": 35.5,
    "synaptic_operation_sparse": 33.6,
    "neuron_idle": 51.2,
    "neuron_active": 72.8,
    "spike": 69.3,
    "packet": 111.0,
    "hop_east_west": 3.0,
    "hop_north_south": 4.2,
}


def test_limits_are_the_published_ones():
    target = load_target("loihi1")
    assert (target.name, target.title) == ("loihi1", "Intel Loihi 1")
    assert {rule: entry.value for rule, entry in target.limits.items()} == LIMITS
    assert [target.limit(rule) for rule in LIMITS] == list(LIMITS.values())


def test_the_mesh_has_a_tile_for_every_core():
    target = load_target("loihi1")
    tiles = target.limit("mesh.width") * target.limit("mesh.height")
    assert tiles * target.limit("mesh.tile_cores") == target.limit("chip.cores")


def test_choices_are_the_published_ones():
    assert dict(load_target("loihi1").choices) == CHOICES


@pytest.mark.parametrize(("table", "prices"), [("davies2018", DAVIES), ("sanafe", SANAFE)])
def test_energies_are_the_published_ones(table, prices):
    found = {entry.name: entry for entry in load_target("loihi1").energy}
    assert set(found) == {"davies2018", "sanafe"}
    assert {event: price.value for event, price in found[table].prices.items()} == prices
    assert {price.unit for price in found[table].prices.values()} == {"pJ"}
    for event, picojoule in prices.items():
        assert found[table].joule(event) == pytest.approx(picojoule * 1e-12, rel=1e-15)


def test_an_event_without_a_price_is_unknown_not_free():
    davies = next(table for table in load_target("loihi1").energy if table.name == "davies2018")
    with pytest.raises(KeyError):
        davies.joule("spike")


def test_every_number_has_unit_and_source():
    raw = tomllib.loads((resources.files("compiler.targets") / "loihi1.toml").read_text("utf-8"))

    def leaves(table):
        for value in table.values():
            if isinstance(value, dict) and not {"value", "values"} & set(value):
                yield from leaves(value)
            elif isinstance(value, dict):
                yield value

    found = list(leaves(raw))
    assert len(found) == len(LIMITS) + len(CHOICES) + len(DAVIES) + len(SANAFE)
    assert all(entry["unit"] and entry["source"] for entry in found)


def test_every_limit_of_a_core_has_a_remedy():
    rules = {rule for rule in LIMITS if rule.startswith(("core.", "chip."))}
    assert set(REMEDIES) == rules


def test_known_targets_are_the_files():
    assert known_targets() == ("loihi1",)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("loihi2", "--target loihi2: not modelled; no public per-event energies; allowed: loihi1"),
        (
            "truenorth",
            "--target truenorth: not modelled; its additive leak cannot express a multiplicative decay; "
            "allowed: loihi1",
        ),
        ("loihi", "--target loihi: unknown; allowed: loihi1"),
        ("../loihi1", "--target ../loihi1: unknown; allowed: loihi1"),
        ("", "--target : unknown; allowed: loihi1"),
    ],
)
def test_a_target_that_does_not_exist(name, message):
    with pytest.raises(OptionError) as caught:
        load_target(name)
    assert str(caught.value) == message
