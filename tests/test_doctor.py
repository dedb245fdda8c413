"""``doctor`` says that all is well where it is, and what to do where it is not."""

import commands
import pytest

from spikeloom.compiler import layer_kernel
from spikeloom.compiler.errors import OptionError
from spikeloom.runtime.commands.main_job import doctor
from spikeloom.runtime.inputs.files import shipped


def by_name(found):
    return {check["what"]: check for check in found["checks"]}


def test_a_sound_installation():
    code, out, err = commands.run("doctor")
    assert (code, err) == (0, "")
    assert out.endswith("nothing is wrong\n")
    checks = by_name(commands.as_json("doctor"))
    assert {name for name, check in checks.items() if check["fix"]} == set()
    assert "numpy " in checks["libraries"]["found"]


def test_it_knows_every_shipped_network():
    with pytest.raises(OptionError) as raised:
        shipped("pretrained:x")
    assert str(raised.value).endswith(", ".join(f"pretrained:{name}" for name in doctor.SHIPPED))


def wrong(monkeypatch, target, name, value):
    monkeypatch.setattr(target, name, value)
    return by_name(commands.as_json("doctor", codes=(1,)))


def damaged(_spikes):
    raise RuntimeError("LLVM has another version")


def test_what_is_wrong_is_said_with_what_to_do(monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("SPIKELOOM_DATA", str(tmp_path / "file"))
    checks = wrong(monkeypatch, doctor, "SHIPPED", ("grasps", "gone"))
    assert checks["recordings"]["fix"] == "it cannot be written: set SPIKELOOM_DATA to another"
    assert "7 of 8 are" in checks["shipped files"]["found"]
    assert checks["shipped files"]["fix"].startswith("install spikeloom again; pretrained:gone (")
    checks = wrong(monkeypatch, doctor, "LIBRARIES", ("numpy", "no-such-library"))
    assert checks["libraries"]["fix"] == "pip install no-such-library"
    checks = wrong(monkeypatch, layer_kernel, "raster_of", damaged)
    assert checks["kernels"]["found"] == "RuntimeError: LLVM has another version"
    code, out, _ = commands.run("doctor")
    assert code == 1
    assert out.endswith("4 wrong: do what these lines say\n")
