"""Every mistake that a user can make: one clear line on standard error, exit code 2, nothing half-written."""

import contextlib
import errno
import io
import json
import os
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from made_files import (
    CLASSES,
    FEATURES,
    STEPS,
    TAXELS,
    events,
    own_file,
    recordings_folder,
    released,
    state_dict,
)
from made_files import weights as made_weights

from spikeloom.compiler.archive import digest, read_members
from spikeloom.compiler.errors import FormatError
from spikeloom.compiler.targets.loihi1 import netlist_file as serialize
from spikeloom.models.graphs import CHOICES
from spikeloom.runtime import cli
from spikeloom.runtime.inputs import files as inputs

GIVE_CHECKPOINT = "give a file of spikeloom train or of the released layout"
GIVE_DATA = "give the folder or zip that holds train/ and test/"


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with recordings, checkpoints of every layout and a compiled netlist."""
    folder = tmp_path_factory.mktemp("bad")
    recordings_folder(folder / "data")
    own_file(folder / "net.pt")
    assert cli.main(["compile", f"{folder}/net.pt", "-o", f"{folder}/net.loom"]) == 0
    torch.save(state_dict(made_weights()), folder / "bare.pt")
    torch.save(released(*[state_dict(made_weights(run)) for run in range(3)]), folder / "net.t7")
    torch.save(state_dict(made_weights(taxels=39, sizes=(3, 3, 3))), folder / "finger.pt")
    return folder


@pytest.fixture
def refusal(capsys, place, monkeypatch):
    """Run a command in that folder that must fail; returns its only line, without the prefix."""
    monkeypatch.chdir(place)
    before = sorted(path.name for path in place.iterdir())

    def command(*words):
        capsys.readouterr()
        code = cli.main([str(word) for word in words])
        out, err = capsys.readouterr()
        assert (code, out) == (2, "")
        assert err.startswith("spikeloom: ")
        assert err.count("\n") == 1
        assert err.endswith("\n")
        return err.removeprefix("spikeloom: ").removesuffix("\n")

    yield command
    assert sorted(path.name for path in place.iterdir()) == before


# -- checkpoints -------------------------------------------------------------------------------------------------------


class Evil:
    """Would make a folder if it were unpickled."""

    def __reduce__(self):
        return os.mkdir, ("unpickled",)


def test_no_checkpoint(refusal, tmp_path):
    missing, empty, words = tmp_path / "missing.pt", tmp_path / "empty.pt", tmp_path / "words.pt"
    empty.touch()
    words.write_text("hello")
    archive = tmp_path / "archive.pt"
    with zipfile.ZipFile(archive, "w") as made:
        made.writestr("notes.txt", "hello")
    for command in (["compile", "-o", "out.loom", "--graph", "manual"], ["inspect"]):
        assert refusal(*command, missing) == f"{missing}: no such file; {GIVE_CHECKPOINT}"
        for path in (empty, words):
            assert refusal(*command, path) == f"{path}: is not a checkpoint; {GIVE_CHECKPOINT}"
    compiling = ["compile", "-o", "out.loom", "--graph", "manual"]
    assert refusal(*compiling, tmp_path) == f"{tmp_path}: no such file; {GIVE_CHECKPOINT}"
    assert refusal(*compiling, archive) == f"{archive}: is not a checkpoint; {GIVE_CHECKPOINT}"


def test_inspect_says_what_something_else_is(refusal, tmp_path):
    archive, events, empty = tmp_path / "archive.zip", tmp_path / "events.npz", tmp_path / "empty.zip"
    with zipfile.ZipFile(archive, "w") as made:
        made.writestr("a/b/notes.txt", "hello")
    np.savez(events, time_s=np.zeros(1), taxel=np.zeros(1), polarity=np.ones(1))
    zipfile.ZipFile(empty, "w").close()
    for path, holds in (
        (archive, "a/b/notes.txt"),
        (events, "polarity.npy, taxel.npy, time_s.npy"),
        (empty, "nothing"),
    ):
        assert refusal("inspect", path) == (
            f"{path}: holds {holds}, not a netlist or a checkpoint; recordings are shown by spikeloom data describe"
        )
    assert refusal("inspect", tmp_path) == (
        f"{tmp_path}: is a folder, not a netlist or a checkpoint; recordings are shown by spikeloom data describe"
    )


@pytest.mark.parametrize(
    ("option", "value"), [("--beta", "0.3"), ("--theta", "0.0"), ("--weights", "best"), ("--run", "1")]
)
def test_options_of_checkpoints_do_not_suit_a_netlist(refusal, option, value):
    assert refusal("inspect", "net.loom", option, value) == (
        f"{option} {value}: is for checkpoints, net.loom is a netlist; leave it away"
    )


def test_options_that_would_not_count(refusal):
    assert refusal("compile", "net.pt", "-o", "out.loom", "--margin", "0.2") == (
        "--margin 0.2: only observed ranges have one; add --ranges observed or leave it away"
    )
    words = ["verify", "net.loom", "--checkpoint", "net.pt", "--data", "data", "--require", "E0"]
    assert refusal(*words, "--min-agreement", "0.9") == (
        "--min-agreement 0.9: --require replaces it; write E3=0.9 into that instead"
    )
    for words in (["run", "net.loom"], ["estimate", "net.loom"]):
        assert refusal(*words, "--data", "data", "--bin", "0.05") == (
            "--bin 0.05: data holds bins, not times; leave --bin away"
        )
        assert refusal(*words, "--data", "synthetic", "--bin", "0.05") == (
            "--bin 0.05: synthetic holds bins, not times; leave --bin away"
        )
    assert refusal("data", "describe", "data", "--bin", "0.05") == (
        "--bin 0.05: data holds bins, not times; leave --bin away"
    )


@pytest.mark.parametrize(
    ("words", "option", "read"),
    [
        (["compile", "net.pt", "-o", "net.pt"], "-o", "net.pt"),
        (["compile", "net.pt", "-o", "./link.pt"], "-o", "net.pt"),
        (["run", "net.loom", "--data", "data", "--spikes", "net.loom"], "--spikes", "net.loom"),
        (["run", "net.loom", "--data", "one.npy", "--spikes", "one.npy"], "--spikes", "one.npy"),
        (["train", "--data", "one.npy", "--graph", "manual", "-o", "one.npy"], "-o", "one.npy"),
        (["data", "convert", "one.csv", "-o", "one.csv"], "-o", "one.csv"),
        (["data", "describe", "one.png", "--picture", "one.png"], "--picture", "one.png"),
    ],
)
def test_an_output_does_not_overwrite_an_input(refusal, place, words, option, read):
    made = [place / name for name in ("one.npy", "one.csv", "one.png")]
    for path in made:
        path.write_bytes(b"precious")
    link = place / "link.pt"
    link.symlink_to(place / "net.pt")
    before = {path: path.read_bytes() for path in place.iterdir() if path.is_file()}
    written = words[words.index(option) + 1]
    try:
        assert refusal(*words) == f"{option} {written}: is an input of this command ({read}); give another name"
        assert {path: path.read_bytes() for path in place.iterdir() if path.is_file()} == before
    finally:
        for path in (*made, link):
            path.unlink()


def test_a_missing_file_of_event_lines(refusal, tmp_path):
    assert refusal("watch", "net.loom", "--input", tmp_path / "no.csv") == (
        f"--input {tmp_path / 'no.csv'}: No such file or directory; give a file of event lines, or - for standard input"
    )
    assert refusal("watch", "net.loom", "--input", tmp_path) == (
        f"--input {tmp_path}: Is a directory; give a file of event lines, or - for standard input"
    )


@pytest.mark.parametrize("zipped", [True, False])
def test_pickle_with_code(refusal, tmp_path, zipped, monkeypatch):
    path = tmp_path / "evil.t7"
    torch.save(released({"fc1.weight": Evil()}), path, _use_new_zipfile_serialization=zipped)
    assert refusal("compile", path, "--graph", "manual", "-o", "out.loom") == (
        f"{path}: is a pickle that calls {os.mkdir.__module__}.mkdir, allowed are tensors alone, "
        "since code in a file could do anything; save the state_dict and nothing else"
    )
    assert not Path("unpickled").exists()


def test_pickle_of_another_program(refusal, tmp_path):
    path = tmp_path / "plain.pkl"
    path.write_bytes(pickle.dumps({"net_list": [Evil()]}))
    assert refusal("inspect", path) == (
        f"{path}: is pickled with protocol 4 or newer, which torch does not read without running it; "
        "save it with torch.save as it is by default"
    )
    assert not Path("unpickled").exists()


def test_missing_extra_and_misshaped_keys(refusal, tmp_path):
    path, state = tmp_path / "net.pt", state_dict(made_weights())
    del state["fc2.bias"]
    state |= {"fc3.weight": torch.zeros(CLASSES, 99), "fc9.weight": torch.zeros(1)}
    torch.save(state, path)
    assert refusal("compile", path, "--graph", "manual", "-o", "out.loom") == (
        f"{path}: fc2.bias is missing; fc3.weight is (4, 99), wanted (4, 8); fc9.weight is not part of a TactileSGNet; "
        "give the weights of a TactileSGNet"
    )


def test_weights_that_are_not_numbers(refusal, tmp_path):
    path, state = tmp_path / "net.pt", state_dict(made_weights())
    state["fc1.weight"][0, :3] = float("nan")
    state["conv1.bias"][:] = float("-inf")
    torch.save(state, path)
    assert refusal("compile", path, "--graph", "manual", "-o", "out.loom") == (
        f"{path}: conv1.bias has {FEATURES} of {FEATURES} values NaN or infinite; "
        "fc1.weight has 3 of 270 values NaN or infinite; give the weights of a TactileSGNet"
    )


def test_truncated_checkpoint(refusal, tmp_path, place):
    for name in ("net.pt", "net.t7"):
        path, whole = tmp_path / name, (place / name).read_bytes()
        path.write_bytes(whole[: len(whole) // 2])
        assert refusal("inspect", path).startswith(f"{path}: is truncated or damaged")


def test_altered_checkpoint(refusal, tmp_path):
    path, stated = tmp_path / "net.pt", b'"beta": 0.2'
    content = own_file(path).read_bytes()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(path, "w") as new:
        for name in old.namelist():
            new.writestr(name, old.read(name).replace(stated, b'"beta": 0.3'))
    assert refusal("compile", path, "-o", "out.loom") == (
        f"{path}: its content does not match its hash, so it was altered; copy or train it again"
    )


def test_newer_checkpoint(refusal, tmp_path):
    path = tmp_path / "net.pt"
    with zipfile.ZipFile(path, "w") as made:
        made.writestr("manifest.json", json.dumps({"format": "spikeloom-checkpoint", "version": 7}))
    assert refusal("inspect", path) == f"{path}: has format version 7, this program reads up to 6; update spikeloom"


def test_checkpoint_zip_bomb(refusal, tmp_path):
    path = tmp_path / "bomb.pt"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as made:
        made.writestr("manifest.json", bytes(1 << 20))
    assert f"{path.stat().st_size} bytes claim to hold {1 << 20}" in refusal("inspect", path)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["net.t7", "--run", "3"], "net.t7: --run 3: the file holds runs 0 to 2; choose one that it holds"),
        (["net.t7", "--run", "-1"], "net.t7: --run -1: the file holds runs 0 to 2; choose one that it holds"),
        (
            ["net.t7", "--weights", "best"],
            "net.t7: --weights best: the file holds the last epoch only; omit --weights",
        ),
        (["net.pt", "--weights", "best"], "net.pt: --weights best: the file holds last; choose one that it holds"),
        (["net.pt", "--run", "1"], "net.pt: --run 1: the file holds only run 0; omit --run"),
        *(
            (
                ["net.t7", "--beta", text],
                f"beta {text}: allowed are 0 <= beta < 1; it is the share of the membrane that a step keeps",
            )
            for text in ("1.5", "1", "-0.1", "nan")
        ),
        *(
            (
                ["net.t7", "--theta", text],
                f"theta {text}: allowed are numbers above 0; it is the threshold of a spike",
            )
            for text in ("0", "-1", "nan", "inf")
        ),
        (["pretrained:nope"], "pretrained:nope: no such shipped checkpoint; allowed: {shipped}"),
    ],
)
def test_choices_within_a_checkpoint(refusal, words, line, monkeypatch):
    shipped = sorted(path.stem for path in Path(inputs.__file__).parents[2].glob("models/pretrained/*.pt"))
    assert refusal("inspect", *words) == line.format(shipped=", ".join(f"pretrained:{name}" for name in shipped))


def test_unreadable_files(refusal, tmp_path, monkeypatch):
    as_ever = Path.open

    def denied(path, *words, **options):
        if path.stem == "net":
            raise PermissionError(errno.EACCES, "Permission denied", "secret")
        return as_ever(path, *words, **options)

    monkeypatch.setattr(Path, "open", denied)
    assert refusal("inspect", "net.pt") == "net.pt: cannot be read (Permission denied); check its permissions"
    assert refusal("run", "net.loom", "--data", "data") == (
        "secret: Permission denied; check space and permissions, nothing was changed"
    )


# -- graphs, targets, options ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["bare.pt"], f"bare.pt: the graph is not in this file; name it with --graph: {CHOICES}"),
        (["net.t7"], f"net.t7: the graph is not in this file; name it with --graph: {CHOICES}"),
        (
            ["bare.pt", "--graph", "manual"],
            f"graph and weights disagree: the graph has 39 taxels, fc1 was trained on {TAXELS}; "
            "give the graph that the checkpoint was trained on",
        ),
        (
            ["net.pt", "--graph", "manual"],
            "net.pt: graph and weights disagree: it was trained on ring, --graph says manual; leave --graph away",
        ),
        (["finger.pt", "--graph", "nope"], f"graph 'nope': unknown; choose {CHOICES}"),
        (
            ["finger.pt", "--graph", "knn:9"],
            "graph 'knn:9': K is '9', allowed are whole numbers 1..8; choose another K",
        ),
        (
            ["finger.pt", "--graph", "released:mst:-1"],
            "graph 'released:mst:-1': SIGMA is '-1', allowed are millimetres from 0 (tree only); choose another SIGMA",
        ),
        (
            ["net.pt", "--target", "loihi2"],
            "--target loihi2: not modelled; no public per-event energies; allowed: loihi1, truenorth",
        ),
        (["net.pt", "--target", "../loihi1"], "--target ../loihi1: unknown; allowed: loihi1, truenorth"),
        *(
            (
                ["net.pt", "--weight-bits", bits],
                f"--weight-bits {bits}: Intel Loihi 1 does not store that width; allowed: 2, 3, 4, 5, 6, 8",
            )
            for bits in ("7", "1", "9", "0", "-8")
        ),
        (
            ["net.pt", "--weight-bits", "8.0"],
            "--weight-bits 8.0: not a number; give one, or one for each layer as in 8,4,4,8",
        ),
        (
            ["net.pt", "--ranges", "observed"],
            "--ranges observed: nothing was observed; give --calibrate, or use --ranges proven",
        ),
        (["net.pt", "--ranges", "nope"], "--ranges nope: unknown; allowed: proven, observed"),
        *(
            (
                ["net.pt", "--ranges", "observed", "--margin", text],
                f"--margin {text}: is no share to add to a range; give a number from 0",
            )
            for text in ("-0.1", "nan", "inf")
        ),
        (["net.pt", "--calibrate", "nowhere"], f"nowhere: no such file or folder; {GIVE_DATA}"),
        ([], "the following arguments are required: checkpoint; see {help}"),
        (["net.pt", "more"], "unrecognized arguments: more; see spikeloom --help"),
    ],
)
def test_compile_options(refusal, words, line):
    assert refusal("compile", *words, "-o", "out.loom") == line.format(help="spikeloom compile --help")


@pytest.mark.parametrize(
    ("place_to_write", "why"),
    [
        ("nowhere/out.loom", "the folder does not exist; make it first"),
        ("net.pt/out.loom", "the folder does not exist; make it first"),
        ("data", "is not a regular file; give the name of a file to write"),
        ("/dev/null", "is not a regular file; give the name of a file to write"),
        ("", "is not a regular file; give the name of a file to write"),
    ],
)
def test_places_that_cannot_be_written(refusal, place_to_write, why):
    assert refusal("compile", "net.pt", "-o", place_to_write) == f"-o {place_to_write}: {why}"
    run = ["run", "net.loom", "--data", "data", "--spikes", place_to_write]
    assert refusal(*run) == f"--spikes {place_to_write}: {why}"
    train = ["train", "--data", "data", "--graph", "manual", "-o", place_to_write]
    assert refusal(*train) == f"-o {place_to_write}: {why}"


def test_no_command(refusal):
    assert refusal() == "the following arguments are required: COMMAND; see spikeloom --help"
    assert refusal("fly").startswith("argument COMMAND: invalid choice: 'fly' (choose from ")
    assert refusal("compile", "net.pt") == (
        "the following arguments are required: -o/--output; see spikeloom compile --help"
    )


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--min-agreement", "1.1"], "--min-agreement 1.1: not a share; give a number from 0 to 1"),
        (["--min-agreement", "-1"], "--min-agreement -1.0: not a share; give a number from 0 to 1"),
        (["--min-agreement", "nan"], "--min-agreement nan: not a share; give a number from 0 to 1"),
        (["--spec-samples", "0"], "--spec-samples 0: at least 1 recording is needed; give a positive number"),
        (
            ["--graph", "manual"],
            "net.pt: graph and weights disagree: it was trained on ring, --graph says manual; leave --graph away",
        ),
    ],
)
def test_verify_options(refusal, words, line):
    assert refusal("verify", "net.loom", "--checkpoint", "net.pt", "--data", "data", *words) == line


def test_verify_with_parts_that_do_not_belong_together(refusal, tmp_path):
    words = ["verify", "net.loom", "--data", "data", "--checkpoint"]
    assert refusal(*words, "bare.pt") == (f"bare.pt: the graph is not in this file; name it with --graph: {CHOICES}")
    assert refusal(*words, "bare.pt", "--graph", "manual") == (
        f"graph and weights disagree: the graph has 39 taxels, fc1 was trained on {TAXELS}; "
        "give the graph that the checkpoint was trained on"
    )
    own_file(tmp_path / "other.pt", last=made_weights(sizes=(9, 7, CLASSES)))
    assert refusal(*words, tmp_path / "other.pt") == (
        "netlist and checkpoint disagree: the netlist has taxels 6, channels 2, conv1 30, fc1 9, fc2 8, fc3 4, "
        "the checkpoint taxels 6, channels 2, conv1 30, fc1 9, fc2 7, fc3 4; "
        "give the checkpoint that the netlist was compiled from"
    )


# -- recordings --------------------------------------------------------------------------------------------------------


GOOD = events(2)[0].astype(np.float32)


@pytest.mark.parametrize("command", ["compile", "run", "verify", "estimate"])
def test_every_command_checks_the_recordings(refusal, tmp_path, command):
    recordings_folder(tmp_path / "set", train=events(taxels=5), test=events(taxels=5))
    words = {
        "compile": ["net.pt", "-o", "out.loom", "--calibrate"],
        "run": ["net.loom", "--data"],
        "verify": ["net.loom", "--checkpoint", "net.pt", "--data"],
        "estimate": ["net.loom", "--data"],
    }
    split = "train" if command == "compile" else "test"
    assert refusal(command, *words[command], tmp_path / "set") == (
        f"set: {split}/sample_0_label_0.npy: has 5 taxels, the network has 6; use recordings of its sensor"
    )


@pytest.mark.parametrize(
    ("array", "why"),
    [
        (GOOD[:5], "has 5 taxels, the network has 6; use recordings of its sensor"),
        (
            GOOD * 0.5,
            "value 0.5 at taxel 0, polarity 0, step 3, allowed are 0 and 1; recordings are events, not pressures",
        ),
        (
            np.where(GOOD > 0, np.nan, 0),
            "value nan at taxel 0, polarity 0, step 3, allowed are 0 and 1; recordings are events, not pressures",
        ),
        (GOOD.astype(np.int64), "dtype '<i8', allowed are float32, float64, uint8 and bool; convert it"),
        (np.array([os.mkdir]), "dtype '|O', allowed are float32, float64, uint8 and bool; convert it"),
        (GOOD[0], "shape (2, 24), allowed is (taxels, 2, steps); one recording per file"),
        (GOOD[:, :1], "shape (6, 1, 24) has 1 polarities, allowed are 2; use (taxels, 2, steps)"),
    ],
    ids=["taxels", "pressures", "nan", "integers", "objects", "dimensions", "polarities"],
)
def test_recordings_of_another_kind(refusal, tmp_path, array, why):
    (tmp_path / "test").mkdir()
    np.save(tmp_path / "test" / "sample_0_label_0.npy", array)
    assert refusal("run", "net.loom", "--data", tmp_path) == f"{tmp_path.name}: test/sample_0_label_0.npy: {why}"


def test_recordings_of_different_length(refusal, tmp_path):
    recordings_folder(tmp_path / "set")
    np.save(tmp_path / "set" / "test" / "sample_1_label_1.npy", GOOD[:, :, :20])
    assert refusal("estimate", "net.loom", "--data", tmp_path / "set") == (
        f"set: test/sample_1_label_1.npy: shape (6, 2, 20), the recordings before it have (6, 2, {STEPS}); "
        "all of a split must agree"
    )


def test_label_beyond_classes(refusal, tmp_path):
    (tmp_path / "test").mkdir()
    np.save(tmp_path / "test" / f"sample_0_label_{CLASSES}.npy", GOOD)
    assert refusal("run", "net.loom", "--data", tmp_path) == (
        f"{tmp_path.name}: test/sample_0_label_4.npy: label 4, the network has 4 classes (0..3); "
        "use the network that was trained on these objects"
    )


def test_truncated_npy(refusal, tmp_path):
    (tmp_path / "test").mkdir()
    file = tmp_path / "test" / "sample_0_label_0.npy"
    np.save(file, GOOD)
    whole, where = file.read_bytes(), f"{tmp_path.name}: test/sample_0_label_0.npy"
    for length, why in (
        (-7, "1145 bytes of data, its header announces 1152; truncated or damaged; copy or download it again"),
        (50, "npy header truncated or damaged; copy or download it again"),
        (0, "not an npy file of version 1 to 3; save it with numpy.save"),
    ):
        file.write_bytes(whole[:length])
        assert refusal("run", "net.loom", "--data", tmp_path) == f"{where}: {why}"


def zipped(path: Path, name: str, content: bytes) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, content)
    return path


def test_zips_that_are_not_to_be_trusted(refusal, tmp_path, place):
    content = (place / "data" / "test" / "sample_0_label_0.npy").read_bytes()
    path = zipped(tmp_path / "cut.zip", "test/sample_0_label_0.npy", content)
    path.write_bytes(path.read_bytes()[:-30])
    assert refusal("run", "net.loom", "--data", path) == (
        f"{path}: zip truncated or damaged; copy or download it again"
    )
    path = zipped(tmp_path / "escape.zip", "../test/sample_0_label_0.npy", content)
    assert refusal("run", "net.loom", "--data", path) == (
        "escape.zip: unsafe name '../test/sample_0_label_0.npy' in the zip; do not trust this file"
    )
    path = zipped(tmp_path / "bomb.zip", "test/sample_0_label_0.npy", bytes((64 << 20) + 1))
    assert refusal("run", "net.loom", "--data", path) == (
        "bomb.zip: test/sample_0_label_0.npy: more than 67108864 bytes, the limit of a recording; split it"
    )
    assert not (place.parent / "test").exists()
    assert not (tmp_path.parent / "test").exists()


def test_no_recordings(refusal, tmp_path):
    run = ["run", "net.loom", "--data"]
    assert refusal(*run, tmp_path / "nowhere") == f"{tmp_path}/nowhere: no such file or folder; {GIVE_DATA}"
    (tmp_path / "test").mkdir()
    assert refusal(*run, tmp_path) == (
        f"{tmp_path.name}: no recordings; give a folder with event files (.csv, .npz) or bins (.npy), "
        "together or in train/ and test/, or a released zip"
    )
    (tmp_path / "train").mkdir()
    np.save(tmp_path / "train" / "sample_0_label_0.npy", GOOD)
    assert refusal(*run, tmp_path) == (
        f"{tmp_path.name}: split 'test' is missing or empty; splits with recordings: train"
    )
    assert refusal(*run, "net.loom") == (
        f"net.loom: no recordings (train/ or test/ with sample_N_label_L.npy); {GIVE_DATA}"
    )
    words = tmp_path / "words.txt"
    words.write_text("hello")
    assert refusal(*run, words) == (
        f"{words}: not a recording; give a folder, a released zip, or a .csv, .npz or .npy file"
    )


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["data", "--limit", "0"], "--limit 0: at least 1 recording is needed; give a positive number"),
        (["data", "--limit", "-1"], "--limit -1: at least 1 recording is needed; give a positive number"),
        (["data", "--limit", "two"], "argument --limit: invalid int value: 'two'; see spikeloom run --help"),
        (["data", "--split", "nope"], "data: split 'nope' is missing or empty; splits with recordings: test, train"),
        (
            ["data", "--split", "../data/test"],
            "data: split '../data/test' is missing or empty; splits with recordings: test, train",
        ),
        (["synthetic", "--limit", "0"], "--limit 0: at least 1 recording is needed; give a positive number"),
        (
            ["synthetic", "--split", "nope"],
            "--split nope: the synthetic grasps have no such split; allowed: train, test",
        ),
        (["synthetic", "--limit", "1"], "synthetic: has 39 taxels, the network has 6; use recordings of its sensor"),
    ],
)
def test_choices_within_the_recordings(refusal, words, line):
    assert refusal("run", "net.loom", "--data", *words) == line


def test_synthetic_grasps_for_a_network_of_fewer_classes(refusal, tmp_path):
    compiled = tmp_path / "finger.loom"
    assert cli.main(["compile", "finger.pt", "--graph", "knn:1", "-o", str(compiled)]) == 0
    assert refusal("run", compiled, "--data", "synthetic", "--limit", "4") == (
        "synthetic: label 3, the network has 3 classes (0..2); use the network that was trained on these objects"
    )


def test_recordings_of_another_number_of_channels(refusal, tmp_path):
    # an own checkpoint may have any number of channels; recordings have two polarities
    arrays = made_weights()
    arrays["conv1.hops"] = arrays["conv1.hops"][:, :, :1]
    own_file(tmp_path / "one.pt", last=arrays)
    assert cli.main(["compile", f"{tmp_path}/one.pt", "-o", f"{tmp_path}/one.loom"]) == 0
    line = (
        "recordings: 12 input channels found, the netlist has 6; "
        "use recordings of the sensor that the network was compiled for"
    )
    for words in (["run"], ["estimate"], ["verify", "--checkpoint", tmp_path / "one.pt"]):
        assert refusal(*words, tmp_path / "one.loom", "--data", "data") == line
    assert refusal("compile", tmp_path / "one.pt", "--calibrate", "data", "-o", "out.loom") == (
        "calibration: the recordings have 12 channels, the network has 6; "
        "give recordings of the sensor that it was trained on"
    )


# -- netlists ----------------------------------------------------------------------------------------------------------


def rewritten(place: Path, path: Path, change, *, sign: bool = True) -> Path:
    """Write the netlist after `change` was applied to its manifest and its members; with a fitting hash if `sign`."""
    members = read_members(place / "net.loom")
    manifest = json.loads(str(members["manifest"]))
    stated = members.pop("sha256")
    change(manifest, members)
    members["manifest"] = np.array(json.dumps(manifest, sort_keys=True))
    if sign:
        held = {name: members[name] for name in serialize.ARRAYS if name in members}
        stated = np.array(digest({"manifest": members["manifest"], **held}))
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in (members | {"sha256": stated}).items():
            content = io.BytesIO()
            np.lib.format.write_array(content, array, allow_pickle=False)
            archive.writestr(f"{name}.npy", content.getvalue())
    return path


COMMANDS = [["run", "--data", "data"], ["estimate", "--data", "data"], ["inspect"]]


def test_no_netlist(refusal, tmp_path):
    for command in COMMANDS:
        assert refusal(*command, "nowhere.loom") == "nowhere.loom: no such file; write one with spikeloom compile"
    assert refusal("run", "--data", "data", tmp_path) == f"{tmp_path}: is not a file; write one with spikeloom compile"
    empty = tmp_path / "empty.loom"
    empty.touch()
    assert refusal("inspect", empty) == (
        f"{empty}: is truncated or not a netlist (File is not a zip file); compile it again"
    )
    archive = zipped(tmp_path / "a.loom", "notes.txt", b"hello")
    assert "has compressed members" in refusal("inspect", archive)
    assert refusal("run", "--data", "data", "net.t7").startswith("net.t7: ")


def test_truncated_netlist(refusal, tmp_path, place):
    path, whole = tmp_path / "net.loom", (place / "net.loom").read_bytes()
    for share in (0.01, 0.5, 0.999):
        path.write_bytes(whole[: int(share * len(whole))])
        for command in COMMANDS:
            assert refusal(*command, path) == (
                f"{path}: is truncated or not a netlist (File is not a zip file); compile it again"
            )


def test_altered_netlist(refusal, tmp_path, place):
    altered = f"{tmp_path}/net.loom: its content does not match its hash, so it was altered; compile it again"

    def thresholds(_manifest, members):
        members["threshold"] = members["threshold"] + 1

    def name(manifest, _members):
        manifest["provenance"]["graph"] = "manual"

    for change in (thresholds, name):
        path = rewritten(place, tmp_path / "net.loom", change, sign=False)
        for command in COMMANDS:
            assert refusal(*command, path) == altered


def test_flipped_bits_of_a_netlist(refusal, tmp_path, place):
    whole, path = bytearray((place / "net.loom").read_bytes()), tmp_path / "net.loom"
    rng, refused = np.random.default_rng(0), 0
    for position in rng.integers(len(whole), size=40).tolist():
        flipped = bytearray(whole)
        flipped[position] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        with contextlib.suppress(FormatError):
            # read: then it was a bit that says nothing, such as the creation date of a member
            assert serialize.netlist_bytes(serialize.read_netlist(path)) == bytes(whole), position
            continue
        assert refusal("run", "--data", "data", path).startswith(f"{path}: ")
        refused += 1
    assert refused > 30


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (
            lambda manifest, _: manifest.update(version=5),
            "has format version 5, this program reads 2, 3, 4; compile it again or update spikeloom",
        ),
        (lambda manifest, _: manifest.update(format="x"), "is not a netlist; write one with spikeloom compile"),
        (
            lambda manifest, _: manifest.update(target="loihi9"),
            "is for 'loihi9', this program knows loihi1; update spikeloom",
        ),
        (lambda manifest, _: manifest.pop("target"), "the manifest has no usable target; compile it again"),
        (lambda manifest, _: manifest.update(taxels="6"), "the manifest has no usable taxels; compile it again"),
        (lambda manifest, _: manifest.update(layers=[]), "the manifest has no usable layers; compile it again"),
        (
            lambda manifest, _: manifest["layers"][0].update(neurons=-1),
            "the manifest has no usable layers; compile it again",
        ),
        (
            lambda manifest, _: manifest["layers"][0].update(depth=-1),
            "the manifest has no usable layers; compile it again",
        ),
        (
            lambda _, members: members.pop("threshold"),
            "has missing or unknown members (threshold); compile it again",
        ),
        (
            lambda _, members: members.update(threshold=members["threshold"] / 2),
            "threshold is no list of integers; compile it again",
        ),
        (
            lambda _, members: members.update(format_exponent=members["format_exponent"] - 9),
            "format_exponent has values outside -1 … 7; compile it again",
        ),
        (
            lambda _, members: members.update(synapse_target=members["synapse_target"].astype(int) + 99),
            "synapse_target points beyond its core; compile it again",
        ),
    ],
)
def test_netlists_that_are_signed_but_wrong(refusal, tmp_path, place, change, why):
    path = rewritten(place, tmp_path / "net.loom", change)
    for command in COMMANDS:
        assert refusal(*command, path) == f"{path}: {why}"


def test_a_netlist_that_announces_more_than_it_has(refusal, tmp_path, place):
    path = tmp_path / "net.loom"
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<i8", "fortran_order": False, "shape": (10**15,)})
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("manifest.npy", header.getvalue())
    assert refusal("inspect", path).startswith(f"{path}: is truncated or not a netlist (")


def test_overflow_on_the_chip_names_neuron_step_and_recording(refusal, tmp_path):
    recordings_folder(tmp_path / "quiet", train=events(rate=0.01), test=events(3, rate=1.0))
    words = ["--calibrate", tmp_path / "quiet", "--ranges", "observed", "--margin", "0", "-o", tmp_path / "net.loom"]
    assert cli.main(["compile", "net.pt", *map(str, words)]) == 0
    line = refusal("run", tmp_path / "net.loom", "--data", tmp_path / "quiet")
    where, _, rest = line.partition(": synaptic sum ")
    assert where.startswith("conv1 neuron ")
    assert where.endswith(" on core 0, chip step 0")
    assert rest.endswith(
        " found, magnitudes up to 2097151 allowed; compile with a smaller scale for conv1 "
        "(recording 0 of 6, counted from 0)"
    )


# -- networks that cannot fit ------------------------------------------------------------------------------------------


def signs(**options) -> dict[str, np.ndarray]:
    """Weights of plus and minus one half, none of which rounds to zero."""
    return {name: np.where(array >= 0, 0.5, -0.5).astype(np.float32) for name, array in made_weights(**options).items()}


@pytest.mark.parametrize(
    ("features", "lines"),
    [
        (
            128,
            [
                "fc1 neuron 0: 4992 used, 4096 allowed (loihi1.core.axons_in); "
                "fewer inputs to the layer: fewer features, taxels or a grouped layer"
            ],
        ),
        (
            424,
            [
                "fc1 neuron 0: 16536 used, 4096 allowed (loihi1.core.axons_in); "
                "fewer inputs to the layer: fewer features, taxels or a grouped layer",
                "fc1 neuron 0: 16536 used, 16384 allowed (loihi1.core.synapse_words); "
                "fewer weight bits, fewer synapses or more cores",
            ],
        ),
    ],
)
def test_every_violated_limit_is_listed(place, capsys, monkeypatch, tmp_path, features, lines):
    torch.save(state_dict(signs(taxels=39, features=features, sizes=(2, 2, 2))), tmp_path / "wide.pt")
    words = ["compile", f"{tmp_path}/wide.pt", "--graph", "mst:0", "--keep-all", "-o", f"{tmp_path}/out.loom"]
    assert cli.main(words) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines() == [f"spikeloom: {line}" for line in lines]
    assert not (tmp_path / "out.loom").exists()


# -- interrupted and full disks ----------------------------------------------------------------------------------------


class FullDisk(io.FileIO):
    """Takes a few bytes."""

    def write(self, content):
        if self.tell() + len(content) > 1000:
            raise OSError(errno.ENOSPC, "No space left on device")
        return super().write(content)


def interrupt(*_words, **_options):
    raise KeyboardInterrupt


def almost_full(path, mode="r", *options, whole=Path.open, **more):
    return io.BufferedWriter(FullDisk(path, mode)) if mode == "xb" else whole(path, mode, *options, **more)


@pytest.mark.parametrize("old", [b"an older result", None], ids=["over an older file", "new"])
@pytest.mark.parametrize("words", [["compile", "net.pt", "-o"], ["run", "net.loom", "--data", "data", "--spikes"]])
@pytest.mark.parametrize(
    ("patched", "replacement", "line"),
    [
        (
            "pathlib.Path.open",
            almost_full,
            "{path}: No space left on device; check space and permissions, nothing was changed",
        ),
        ("os.fsync", interrupt, "interrupted; nothing was written"),
    ],
    ids=["full disk", "interrupt"],
)
def test_an_older_file_stays_intact(refusal, tmp_path, monkeypatch, old, words, patched, replacement, line):
    path = tmp_path / "result"
    if old is not None:
        path.write_bytes(old)
    monkeypatch.setattr(patched, replacement)
    assert refusal(*words, path) == line.format(path=path)
    monkeypatch.undo()
    assert [file.name for file in tmp_path.iterdir()] == ([] if old is None else ["result"])
    if old is not None:
        assert path.read_bytes() == old


def test_an_interrupted_comparison(refusal, monkeypatch):
    monkeypatch.setattr("spikeloom.runtime.machines.loihi1.engine.simulate", interrupt)
    words = ["verify", "net.loom", "--checkpoint", "net.pt", "--data", "data"]
    assert refusal(*words) == "interrupted; nothing was written"


def test_memory_that_does_not_suffice(refusal, monkeypatch):
    def exhausted(*_words, **_options):
        raise MemoryError("Unable to allocate 9.9 TiB")

    monkeypatch.setattr("spikeloom.runtime.machines.loihi1.engine.simulate", exhausted)
    assert refusal("run", "net.loom", "--data", "data") == (
        "out of memory (Unable to allocate 9.9 TiB); give fewer recordings with --limit"
    )
