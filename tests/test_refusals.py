"""Every mistake that a user can make: one clear line on standard error, exit code 2, nothing half-written.

One table, ``refusals.txt``: what is typed, and what the line must hold: the option or file, the value, what is allowed.
"""

import dataclasses
import errno
import io
import os
import pickle
import shlex
import zipfile
from pathlib import Path

import commands
import numpy as np
import pytest
import torch
from made_files import (
    CLASSES,
    TAXELS,
    csv_folder,
    events,
    own_file,
    recordings_folder,
    released,
    state_dict,
    zipped,
)
from made_files import weights as made_weights
from random_crossbars import random_network
from zoo import specimen

from spikeloom.compiler.targets.loihi1.netlist import read_netlist, write_netlist
from spikeloom.compiler.targets.truenorth.native_file import write_trained
from spikeloom.runtime import cli

GOOD = events(2)[0].astype(np.float32)


class Evil:
    """Would make a folder if it were unpickled."""

    def __reduce__(self):
        return os.mkdir, ("unpickled",)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with recordings, checkpoints and netlists, good ones and damaged ones."""
    at = tmp_path_factory.mktemp("bad")
    recordings_folder(at / "data")
    own_file(at / "net.pt")
    assert cli.main(["compile", f"{at}/net.pt", "-o", f"{at}/net.loom"]) == 0
    torch.save(state_dict(made_weights()), at / "bare.pt")
    torch.save(released(*[state_dict(made_weights(run)) for run in range(3)]), at / "net.t7")
    torch.save(state_dict(made_weights(taxels=39, sizes=(3, 3, 3))), at / "finger.pt")
    assert cli.main(["compile", f"{at}/finger.pt", "--graph", "knn:1", "-o", f"{at}/finger.loom"]) == 0
    own_file(at / "other.pt", last=made_weights(sizes=(9, 7, CLASSES)))
    own_file(at / "same.pt", last=made_weights(7))
    (at / "empty.pt").touch()
    (at / "words.txt").write_text("hello")
    (at / "semicolons.csv").write_text("time_s;taxel;polarity\n0;1;1\n")
    (at / "bomb.pt").write_bytes(zipped({"manifest.json": bytes(1 << 20)}, zipfile.ZIP_DEFLATED))
    (at / "notes.zip").write_bytes(zipped({"a/b/notes.txt": "hello"}))
    for name in ("events", "grasp_label_1"):
        np.savez(at / f"{name}.npz", time_s=np.zeros(1), taxel=np.zeros(1), polarity=np.ones(1))
    for new in (True, False):
        evil = released({"fc1.weight": Evil()})
        torch.save(evil, at / f"evil{int(new)}.t7", _use_new_zipfile_serialization=new)
    (at / "plain.pkl").write_bytes(pickle.dumps({"net_list": [Evil()]}))
    (at / "pressures" / "test").mkdir(parents=True)
    np.save(at / "pressures" / "test" / "sample_0_label_0.npy", GOOD * 0.5)
    recordings_folder(at / "polarities")
    np.save(at / "polarities" / "test" / "sample_1_label_1.npy", GOOD[:, :1])
    recordings_folder(at / "five", train=events(taxels=5), test=events(taxels=5))
    (at / "half.loom").write_bytes((at / "net.loom").read_bytes()[:900])
    csv_folder(at / "flat", taxels=6)
    for split in ("train", "test"):
        csv_folder(at / "square" / split, taxels=4)
    torch.save(torch.nn.Linear(2, 3).state_dict(), at / "linear.pt")
    own_file(at / "binned.pt", training={"data": "taps", "bin_s": 0.05})
    assert cli.main(["compile", f"{at}/binned.pt", "-o", f"{at}/binned.loom"]) == 0
    native = {
        weights: random_network(seed, taxels=TAXELS, classes=CLASSES)
        for seed, weights in enumerate(("last", "best"))
    }
    write_trained(at / "native.pt", native, graph="ring", edges=np.array([[0, 1], [1, 0]]), training={})
    words = ["compile", f"{at}/native.pt", "--weights", "best", "--target", "truenorth"]
    assert cli.main([*words, "-o", f"{at}/native.loom"]) == 0
    return at


def read_table():
    """Commands of ``refusals.txt``, and what the line of each must hold: the indented lines below it."""
    table, telling = [], []
    for line in Path(__file__).with_name("refusals.txt").read_text("utf-8").splitlines():
        if line.startswith("    "):
            telling.append(line.strip())
        elif line and not line.startswith("#"):
            telling = [] if telling else telling  # several commands may share their lines
            table.append((line, telling))
    return table


LONG = f"{'x' * 250}.pt"
TABLE = [
    *read_table(),
    (
        f"compile net.pt -o {LONG}",
        [f"-o {LONG[:100]}", ".pt: cannot be written (File name too long); name another"],
    ),
    ("run --data data '\x1b[2J.loom'", [r"\x1b[2J.loom: no such file"]),
]


class Zoo(dict):
    """Networks of the zoo by name, as ``{timed.network}`` stands for the file of one."""

    def __missing__(self, name):
        return specimen(name)


@pytest.fixture
def refusal(place, monkeypatch):
    """Run a command in that folder that must fail; returns its only line."""
    monkeypatch.chdir(place)
    before = sorted(path.name for path in place.iterdir())

    def command(*words):
        code, out, err = commands.run(*words)
        assert (code, out, err.count("\n")) == (2, "", 1)
        return err.removeprefix("spikeloom: ").rstrip("\n")

    yield command
    assert sorted(path.name for path in place.iterdir()) == before


@pytest.mark.parametrize(("words", "telling"), TABLE, ids=[words for words, _ in TABLE])
def test_refusals(refusal, words, telling):
    line = refusal(*shlex.split(words.format_map(Zoo())))
    assert telling
    for part in telling:
        assert part.format_map(Zoo()) in line


def test_recordings_of_another_number_of_channels(refusal, tmp_path):
    arrays = (
        made_weights()
    )  # an own checkpoint may have any number of channels; recordings have two polarities
    arrays["conv1.hops"] = arrays["conv1.hops"][:, :, :1]
    own_file(tmp_path / "one.pt", last=arrays)
    assert cli.main(["compile", f"{tmp_path}/one.pt", "-o", f"{tmp_path}/one.loom"]) == 0
    for words in (["run"], ["estimate"], ["verify", "--checkpoint", tmp_path / "one.pt"]):
        assert "12 input channels found, the netlist has 6" in refusal(
            *words, tmp_path / "one.loom", "--data", "data"
        )
    line = refusal("compile", tmp_path / "one.pt", "--calibrate", "data", "-o", "out.loom")
    assert "the recordings have 12 channels, the network has 6" in line


def test_overflow_on_the_chip_names_neuron_step_and_recording(refusal, tmp_path):
    recordings_folder(tmp_path / "quiet", train=events(rate=0.01), test=events(3, rate=1.0))
    netlist = read_netlist("net.loom")
    write_netlist(
        dataclasses.replace(netlist, format_exponent=np.full_like(netlist.format_exponent, 7)),
        tmp_path / "net.loom",
    )
    line = refusal("run", tmp_path / "net.loom", "--data", tmp_path / "quiet")
    for part in ("conv1 neuron ", "on core 0, chip step 0", "2097151 allowed", "recording 0 of 6"):
        assert part in line


def test_a_violated_limit_is_named(place, tmp_path):
    arrays = made_weights(taxels=39, features=128, sizes=(2, 2, 2))
    signs = {name: np.where(array >= 0, 0.5, -0.5).astype(np.float32) for name, array in arrays.items()}
    torch.save(state_dict(signs), tmp_path / "wide.pt")
    words = [
        "compile",
        f"{tmp_path}/wide.pt",
        "--graph",
        "mst:0",
        "--keep-all",
        "-o",
        f"{tmp_path}/out.loom",
    ]
    (line,) = commands.run(*words)[2].splitlines()
    assert f"fc1 neuron 0: {39 * 128} used" in line
    assert "(loihi1.core.axons_in)" in line
    assert not (tmp_path / "out.loom").exists()


def test_unreadable_files(refusal, monkeypatch):
    as_ever = Path.open

    def denied(path, *words, **options):
        if path.stem == "net":
            raise PermissionError(errno.EACCES, "Permission denied", "secret")
        return as_ever(path, *words, **options)

    monkeypatch.setattr(Path, "open", denied)
    assert "net.pt: cannot be read (Permission denied)" in refusal("inspect", "net.pt")
    assert "net.loom: cannot be read (Permission denied)" in refusal("run", "net.loom", "--data", "data")


class FullDisk(io.FileIO):
    """Takes a few bytes."""

    def write(self, content):
        if self.tell() + len(content) > 1000:
            raise OSError(errno.ENOSPC, "No space left on device")
        return super().write(content)


def interrupt(*_words, **_options):
    raise KeyboardInterrupt


def exhausted(*_words, **_options):
    raise MemoryError("Unable to allocate 9.9 TiB")


def almost_full(path, mode="r", *options, whole=Path.open, **more):
    return io.BufferedWriter(FullDisk(path, mode)) if mode == "xb" else whole(path, mode, *options, **more)


@pytest.mark.parametrize(
    ("old", "name", "words"),
    [
        (b"an older result", "out.loom", ["compile", "net.pt", "-o"]),
        (None, "out.npz", ["run", "net.loom", "--data", "data", "--spikes"]),
    ],
)
@pytest.mark.parametrize(
    ("patched", "replacement", "line"),
    [
        ("pathlib.Path.open", almost_full, "No space left on device"),
        ("os.fsync", interrupt, "nothing was written"),
    ],
    ids=["full disk", "interrupt"],
)
def test_an_older_file_stays_intact(
    refusal, tmp_path, monkeypatch, old, name, words, patched, replacement, line
):
    path = tmp_path / name
    if old is not None:
        path.write_bytes(old)
    monkeypatch.setattr(patched, replacement)
    assert line in refusal(*words, path)
    monkeypatch.undo()
    assert [file.name for file in tmp_path.iterdir()] == ([] if old is None else [name])
    assert old is None or path.read_bytes() == old


def full(*_words, **_options):
    raise OSError(errno.ENOSPC, "No space left on device", "lean.pt")


@pytest.mark.parametrize(
    ("trouble", "line"),
    [
        (interrupt, "interrupted; {} was written"),
        (full, "lean.pt: No space left on device; check space and permissions; written before: {}"),
    ],
)
def test_of_two_files_the_first_is_named(refusal, tmp_path, monkeypatch, trouble, line):
    netlist = tmp_path / "lean.loom"
    monkeypatch.setattr("spikeloom.compiler.formats.own_checkpoint.save_again", trouble)
    words = ["lean", "net.pt", "--data", "data", "-o", netlist, "--network", tmp_path / "lean.pt"]
    assert refusal(*words) == line.format(netlist)
    assert netlist.exists()


@pytest.mark.parametrize(
    ("trouble", "line"),
    [(interrupt, "nothing was written"), (exhausted, "out of memory (Unable to allocate 9.9 TiB)")],
)
def test_trouble_while_the_engine_runs(refusal, monkeypatch, trouble, line):
    monkeypatch.setattr("spikeloom.runtime.machines.loihi1.engine.simulate", trouble)
    assert line in refusal("verify", "net.loom", "--checkpoint", "net.pt", "--data", "data")
