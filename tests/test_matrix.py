"""One answer, whatever the way in and the way out: decisions, operations and energies are those of a plain count."""

import re
from dataclasses import replace

import pytest
import ways
from ways import NO_ANSWER, REFUSED, WAYS_OUT, RefusedError, case, refusal_of, truth
from ways_in import FORMATS, WAYS_IN

from spikeloom.compiler.formats import NETWORKS
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.models.recordings.evtouch import MAX_POLARITIES
from spikeloom.runtime import api, cli
from spikeloom.runtime.compiled import Compiled
from spikeloom.runtime.inputs.network import CHECKPOINT, READERS, reader_of
from spikeloom.runtime.machines.backends import BACKENDS, export_formats, machine_for, trained_for
from spikeloom.runtime.report import html
from spikeloom.runtime.requests.main_job import ENGINES
from spikeloom.runtime.requests.training import ALL_SYSTEMS
from spikeloom.runtime.studies.chart import sections
from spikeloom.runtime.studies.robustness.perturbations import SAMPLED

pytestmark = pytest.mark.filterwarnings("default")  # those of Dask are its own

SAMPLED_AS_IT_IS = dict(SAMPLED)


@pytest.fixture
def quick(monkeypatch):
    """Perturbations that do nothing, and results without their drawings."""
    for name, level in ways.NEUTRAL.items():
        if isinstance(level, str):
            monkeypatch.delitem(SAMPLED, name)
        else:
            monkeypatch.setitem(SAMPLED, name, replace(SAMPLED[name], levels=(level,)))
    monkeypatch.setattr(html, "page", lambda *_: "")
    monkeypatch.setattr(sections, "write_chart", lambda *_: None)


def cells():
    """The product; those that take long on all ways in are slow."""
    for name in WAYS_IN:
        for out, way in WAYS_OUT.items():
            slow = way.slow or name in ways.WIDE or (way.long and name not in ways.IN_SHORT)
            yield pytest.param(name, out, marks=[pytest.mark.slow] if slow else [], id=f"{name} | {out}")


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(("name", "out"), list(cells()))
def test_one_answer(name, out):
    made = case(name)
    if (words := refusal_of(made, out)) is not None:
        with pytest.raises(RefusedError, match=re.escape(words)):
            WAYS_OUT[out].ask(made)
        return
    answer = WAYS_OUT[out].ask(made)
    due = truth(made, answer.pop("netlist", None), answer.pop("window", None))
    assert answer.keys() & {"decisions", "right", "spikes of one", "operations"}
    for what, said in answer.items():
        assert said == about(due[what][: len(said)] if out in ways.OF_SOME else due[what]), what


def about(due):
    """As it is, or of numbers that are no whole ones nearly."""
    if isinstance(due, dict):
        return {name: about(each) for name, each in due.items()}
    floats = isinstance(due, float) or (isinstance(due, list) and isinstance(due[0], float))
    return pytest.approx(due, rel=1e-9) if floats else due


@pytest.mark.parametrize("name", WAYS_IN)
def test_something_is_tested(name):
    due = truth(case(name))
    assert all(due["spikes"]), "a layer is silent"
    assert any(map(any, due["votes"]))
    _, least, most = due["operations"]
    assert 0 < least < most


def test_every_command_format_and_function_is_a_way_out_or_says_why_not():
    exports = {f"export {each.name}" for each in export_formats()}
    methods = {name for name, each in vars(Compiled).items() if callable(each) and not name.startswith("_")}
    functions = {name for name in api.__all__ if name[0].islower()}
    known = (cli.COMMANDS.keys() - {"export"}) | exports | (methods - {"export"}) | functions
    asked = {way.command for way in WAYS_OUT.values()}
    assert asked | NO_ANSWER.keys() == known
    assert not asked & NO_ANSWER.keys()
    in_python = {way.command for way in WAYS_OUT.values() if way.door == "Python"}
    assert in_python == (methods | functions) - NO_ANSWER.keys() - {"export"}
    assert ways.NEUTRAL.keys() == SAMPLED_AS_IT_IS.keys()
    assert ENGINES == ("spikeloom", "onnx")


def test_every_format_system_and_chip_is_a_way_in():
    made = {name: case(name) for name in WAYS_IN}
    files = [each.network for each in made.values() if each.made.network is not None]
    assert {f".{file.rpartition('.')[2]}" for file in files} == set(NETWORKS)
    float_files = [file for file in files if not file.endswith(".net") and trained_for(file) is None]
    readers = {file: reader_of(file) for file in float_files}
    assert {reader.name for reader in readers.values()} == {reader.name for reader in READERS}
    checkpoints = [read_checkpoint(file) for file, reader in readers.items() if reader is CHECKPOINT]
    assert {each.layout for each in checkpoints} == {"spikeloom", "released", "state_dict"}
    native = [file for file in files if trained_for(file) is not None]
    systems = (
        {each.system for each in checkpoints}
        | {"counters"}
        | ({"tactilesgnet-truenorth"} if native else set())
    )
    assert systems == set(ALL_SYSTEMS)
    netlists = [each.said for each in made.values()]
    assert {each["target"] for each in netlists} == {backend.name for backend in BACKENDS}
    assert {1, 2, MAX_POLARITIES} <= {each["polarities"] for each in netlists}
    assert {each.made.recorded for each in made.values()} == set(FORMATS)
    assert any(each["bins"] > 1 for each in netlists)
    assert any(each["clocks"]["channels"] and "length" not in each["clocks"] for each in netlists)
    used = {
        (trait, key) for each in made.values() for trait in each.traits for key in REFUSED.get(trait, {})
    }
    assert used == {(trait, key) for trait, rows in REFUSED.items() for key in rows}


def test_a_stream_says_that_it_does_not_know_where_a_part_ends(capsys):
    for name, said in (
        ("window", "net.loom: was trained on the first 50 % of each recording"),
        ("timed", ""),
    ):
        machine_for(case(name).netlist).stream()
        assert said in (err := capsys.readouterr().err)
        assert bool(said) == bool(err)
