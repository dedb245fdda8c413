import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from oracles import comparable
from random_networks import random_checkpoint, ring

from spikeloom.compiler import Options, compile_network, targets
from spikeloom.compiler.errors import VerifyError
from spikeloom.compiler.interpret import channels_last, run_integer
from spikeloom.compiler.passes.expand import Factored, expand
from spikeloom.compiler.pipeline import run
from spikeloom.compiler.range_proof import prove_ranges
from spikeloom.compiler.targets import base
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.loihi1.netlist import one_step_bounds
from spikeloom.compiler.targets.loihi1.netlist_file import read_netlist, write_netlist
from spikeloom.compiler.targets.loihi1.passes import start
from spikeloom.compiler.text import text
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.trace import aligned


def grasps(samples=6, *, taxels=5, steps=40, seed=0):
    return (np.random.default_rng(seed).random((samples, taxels, 2, steps)) < 0.2).astype(np.uint8)


# --- a toy
def test_the_passes_run_in_order_and_hand_on_what_they_make():
    seen = {}
    source = Factored(checkpoint=random_checkpoint(), propagation=ring(5))
    done = compile_network(source, after=lambda name, made: seen.setdefault(name, made.newest))
    assert list(seen) == [step.name for step in load_target("loihi1").passes]
    assert [seen[name] for name in ("expand", "quantize", "remove", "emit")] == [
        done.network,
        done.integer,
        done.held,
        done.netlist,
    ]
    assert text(done.network) == text(expand(random_checkpoint(), ring(5)))
    assert done.proofs == prove_ranges(done.integer)
    assert all(proof.holds for proof in done.proofs)
    assert [choice.layer for choice in done.choices] == ["conv1", "fc1", "fc2", "fc3"]
    assert tuple(done.netlist.core_tile) == done.placement.tiles
    assert (done.core_bound, done.netlist.n_cores) == (1, 1)
    assert all(use.used <= use.allowed for use in done.uses)
    assert done.netlist.provenance == {"compensated": []}
    assert (done.layout, done.layout.expected) == (done.usual, None)


def test_the_table_of_passes_in_the_docs():
    docs = (Path(__file__).parents[1] / "docs" / "compile.md").read_text("utf-8")
    for step in load_target("loihi1").passes:
        assert f"| {step.name} | {step.does} | {step.keeps} |" in docs


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("calibrate", lambda done: replace(done, network=replace(done.network, classes=0))),
        ("quantize", lambda done: replace(done, integer=replace(done.integer, classes=0))),
        ("emit", lambda done: replace(done, netlist=replace(done.netlist, layer=done.netlist.layer + 9))),
    ],
)
def test_a_pass_that_breaks_a_rule_is_named_at_once(name, change):
    passes = [
        replace(step, apply=lambda done, apply=step.apply: change(apply(done))) if step.name == name else step
        for step in load_target("loihi1").passes
    ]
    work, _ = start(expand(random_checkpoint(), ring(5)), Options(), load_target("loihi1"))
    seen = []
    with pytest.raises(VerifyError):
        run(passes, work, lambda name, _: seen.append(name))
    assert name not in seen


TOY = """
from dataclasses import replace
from spikeloom.compiler.passes.prune import compact, without_channels
from spikeloom.compiler.pipeline import Pass
from spikeloom.compiler.targets.loihi1 import passes
from spikeloom.compiler.targets.loihi1.options import Options

def unplug(done):
    channels = [channel == 0 for channel in range(done.integer.input.size)]
    import numpy as np
    return replace(done, integer=without_channels(done.integer, np.array(channels)))

PASSES = (*passes.FLOATS, Pass(name="unplug", does="ignores channel 0", keeps="the rest", apply=unplug),
          *passes.INTEGERS, *passes.LAYOUT)

def start(source, options, target):
    return passes.start(source, options, target)[0], PASSES
"""


@pytest.fixture
def toy(tmp_path, monkeypatch):
    """A third chip: a folder with other limits and one other pass."""
    (tmp_path / "toy").mkdir()
    (tmp_path / "toy" / "passes.py").write_text(TOY)
    limits = (Path(targets.__path__[0]) / "loihi1" / "chip.toml").read_text("utf-8")
    small = limits.replace("core.compartments = { value = 1024", "core.compartments = { value = 8")
    (tmp_path / "toy" / "chip.toml").write_text(small.replace('"loihi1"', '"toy"'))
    monkeypatch.setattr(targets, "__path__", [*targets.__path__, str(tmp_path)])
    base.shipped.cache_clear()
    yield
    base.shipped.cache_clear()
    for name in [name for name in sys.modules if name.startswith("spikeloom.compiler.targets.toy")]:
        del sys.modules[name]


@pytest.mark.usefixtures("toy")
def test_a_third_chip_is_a_folder(tmp_path):
    done = compile_network(expand(random_checkpoint(), ring(5)), target="toy")
    assert [step.name for step in load_target("toy").passes][4] == "unplug"
    assert np.diff(done.netlist.core_compartments).max() <= 8
    assert not (done.netlist.axon_source == 0).any()
    write_netlist(done.netlist, tmp_path / "net.loom")
    netlist = read_netlist(tmp_path / "net.loom")
    assert netlist.target == "toy"
    batch = grasps().reshape(6, 10, 40)
    ran = engine.simulate(netlist, batch, spikes=True).spikes
    expected = run_integer(done.integer, channels_last(grasps()))
    for layer in range(4):
        np.testing.assert_array_equal(
            aligned(netlist, ran, layer), expected.spikes[layer][..., comparable(netlist, layer)]
        )


def test_the_proof_covers_the_netlist():
    """Bounds of the network and of the netlist are counted in two places and agree."""
    done = compile_network(expand(random_checkpoint(seed=2), ring(5)))
    positive, negative = one_step_bounds(done.netlist)
    for layer, proof in enumerate(done.proofs):
        ids = done.netlist.compartments_of(layer)
        assert proof.accumulator == 64 * max(positive[ids].max(), negative[ids].max())
