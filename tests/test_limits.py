"""Every limit and choice of a chip's file is checked: a chip that has a little less refuses the netlist."""

from dataclasses import replace

import numpy as np
import pytest
from commands import refusal
from oracles import refused
from zoo import specimen

from spikeloom.compiler.arrays import read_only
from spikeloom.compiler.errors import CapacityError
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.loihi1.legalize import measure, require_legal
from spikeloom.compiler.targets.loihi1.netlist import read_netlist, write_netlist

CHIP = load_target("loihi1")
UNITS = {"synapse.block", "synapse.block_header_bits", "synapse.word_bits", "mesh.width", "mesh.height"}
"""What others are counted in: words of lists, and tiles of a chip."""


@pytest.fixture(scope="module")
def netlist():
    return read_netlist(specimen("counters").netlist)


@pytest.mark.parametrize("rule", sorted(CHIP.limits.keys() - UNITS))
def test_a_chip_with_less_of_it_refuses(rule, netlist):
    used = {use.name: use.used for use in sorted(measure(netlist, CHIP), key=lambda use: use.used)}
    used["mesh.tile_cores"] = int(np.bincount(netlist.core_tile).max())
    less = replace(CHIP.limits[rule], value=used[rule] - 1)
    chip = replace(CHIP, limits={**CHIP.limits, rule: less})
    refused(CapacityError, f"{used[rule] - 1} allowed (loihi1.{rule})", require_legal, netlist, chip)


@pytest.mark.parametrize("rule", CHIP.choices)
def test_a_chip_without_the_choice_refuses(rule, netlist):
    values = getattr(netlist, f"format_{rule.removeprefix('synapse.')}")
    chip = replace(CHIP, choices={**CHIP.choices, rule: tuple({*CHIP.choices[rule]} - {values[0]})})
    refused(CapacityError, f"synapse formats: {values[0]}, |(loihi1.{rule})", require_legal, netlist, chip)


@pytest.mark.parametrize(
    ("rule", "name", "value"),
    [("synapse.weight_bits", "format_weight_bits", 2), ("mesh.tile_cores", "core_tile", 0)],
)
def test_a_file_that_breaks_one_is_refused_by_every_command(rule, name, value, tmp_path):
    made = specimen("grid-cnn")  # on five cores
    netlist = read_netlist(made.netlist)
    altered = replace(netlist, **{name: read_only(np.full(len(getattr(netlist, name)), value))})
    path = tmp_path / "net.loom"
    write_netlist(altered, path)
    data = ("--data", made.data)
    compared = ("--checkpoint", made.network, *data)
    for words in (
        ("run", path, *data),
        ("estimate", path, *data),
        ("certify", path, *data),
        ("verify", path, *compared),
        ("export", path, "--to", "nir", "-o", tmp_path / "out.nir"),
        ("export", path, "--to", "sanafe", "-o", tmp_path / "out.yaml"),
        ("inspect", path),
    ):
        assert f"loihi1.{rule}" in refusal(*words), words
