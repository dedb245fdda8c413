"""Recordings as people have them: arrays of any kind, silence, classes by name or number, several splits."""

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from commands import as_json, refusal, run
from made_files import CLASSES, events, own_file
from oracles import refused

from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.models.recordings import eventfiles, evtouch
from spikeloom.models.recordings.classes import class_in_name
from spikeloom.models.recordings.events import data_splits, load_data
from spikeloom.models.recordings.evtouch import UNLABELLED

HEADER = "time_s,taxel,polarity\n"


def packed(folder: Path, path: Path) -> Path:
    """A zip of all files in a folder."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(folder.rglob("*")):
            if file.is_file():
                archive.write(file, file.relative_to(folder).as_posix())
    return path


def spikes(seed: int, steps: int, taxels: int = 3) -> np.ndarray:
    """Spikes of taxels of one polarity, (steps, taxels)."""
    return np.random.default_rng(seed).random((steps, taxels)) < 0.1


@pytest.fixture
def textures(tmp_path) -> Path:
    """Arrays of 1 ms, of unequal length, named by texture and speed, with a table of classes."""
    folder = tmp_path / "own"
    folder.mkdir()
    rows = ["file,label"]
    for index in range(4):
        name = f"speed{index}_texture0{index % 2}.npz"
        np.savez(folder / name, spikes=spikes(index, 95 + 5 * index).astype(np.uint8))
        rows.append(f"{name},{'cork' if index % 2 else 'wood'}")
    (folder / "recordings.csv").write_text("\n".join(rows))
    np.save(folder / "bins.npy", 0.001)
    return folder


def test_arrays_of_one_polarity_in_npz(textures, tmp_path):
    for place in (textures, packed(textures, tmp_path / "a.zip")):
        found = load_data(place)
        assert found.events.shape == (4, 3, 2, 110)
        assert found.step_counts.tolist() == [95, 100, 105, 110]
        assert not found.events[:, :, 0].any()  # they rise
        for index, array in enumerate(found.events):
            np.testing.assert_array_equal(array[:, 1, : 95 + 5 * index].T, spikes(index, 95 + 5 * index))
        assert (found.bin_s, found.names) == (0.001, ("cork", "wood"))
        assert found.labels.tolist() == [1, 0, 1, 0]
        assert load_data(place, groups=["speed"]).groups == {"speed": ("0", "1", "2", "3")}


def test_arrays_of_two_polarities_in_npz(tmp_path):
    array = np.random.default_rng(0).random((30, 4, 2)) < 0.2
    np.savez(tmp_path / "a_label_1.npz", arr_0=array, bin_s=0.005)
    found = load_data(tmp_path / "a_label_1.npz")
    np.testing.assert_array_equal(found.events[0], np.moveaxis(array, 0, 2))
    assert (found.bin_s, found.labels.tolist()) == (0.005, [1])


@pytest.mark.parametrize(
    ("shape", "said"),
    [
        ((4,), "a.npz: x: shape (4,), allowed is (steps, taxels[, polarities])"),
        ((30, 0), "a.npz: x: shape (30, 0), allowed is (steps, taxels[, polarities])"),
        (
            (30, 2, 40),
            "a.npz: x: shape (30, 2, 40), allowed is (steps, taxels, polarities), up to 8 of them",
        ),
        ((30, 5000), "a.npz: x: shape (30, 5000), allowed is (steps, taxels[, polarities])"),
    ],
)
def test_arrays_of_other_shapes(tmp_path, shape, said):
    np.savez(tmp_path / "a.npz", x=np.zeros(shape))
    assert refused(DataError, "", load_data, tmp_path / "a.npz").startswith(said)


def test_arrays_that_hold_no_events(tmp_path):
    np.savez(tmp_path / "a.npz", x=np.full((2, 3), 0.5))
    said = "a.npz: x: value 0.5 at taxel 0, polarity 1, step 0, allowed are 0 and 1"
    assert refused(DataError, "", load_data, tmp_path / "a.npz").startswith(said)
    np.savez(tmp_path / "b.npz", x=np.zeros((2, 3)), y=np.zeros((2, 3)))
    said = "b.npz: holds x, y, without time_s, taxel, polarity; name the arrays time_s, taxel, polarity[, label], or "
    assert refused(DataError, "", load_data, tmp_path / "b.npz").startswith(said)


def test_bins_are_joined_to_what_is_asked_for(textures):
    fine, coarse = load_data(textures), load_data(textures, bin_s=0.02)
    assert coarse.step_counts.tolist() == [5, 5, 6, 6]
    for index in range(4):
        whole = np.zeros((3, 2, 120), np.uint8)
        whole[..., :110] = fine.events[index]
        expected = whole.reshape(3, 2, 6, 20).any(axis=3)
        np.testing.assert_array_equal(coarse.events[index], expected)
    assert coarse.bin_s == 0.02
    said = refused(OptionError, "", load_data, textures, bin_s=0.0015)
    assert said == ("--bin 0.0015: own holds bins of 0.001 s; give a multiple of that, or omit --bin")
    # a network that was trained on wider bins gets them
    assert load_data(textures, default_bin_s=0.02).sha256 == coarse.sha256
    assert load_data(textures, default_bin_s=0.0015).bin_s == 0.001
    np.savez(textures / "other.npz", x=spikes(9, 20), bin_s=0.002)
    assert "bins of 0.001 s and of 0.002 s" in refused(DataError, "", load_data, textures)
    assert load_data(textures, bin_s=0.02).step_counts.tolist() == [2, 5, 5, 6, 6]


def test_a_width_that_nobody_says_is_assumed_and_that_is_said(textures):
    (textures / "bins.npy").unlink()
    found = load_data(textures, bin_s=0.04)
    assert found.step_counts.tolist() == [48, 50, 53, 55]
    assert found.counts.notes[-1] == (
        "own: nothing says how long a bin of its arrays is: 0.02 s is assumed; "
        "write the seconds to bins.npy beside them"
    )
    said = refused(OptionError, "", load_data, textures, bin_s=0.01)
    assert "holds bins, of 0.02 s as nothing says it: write it to bins.npy; give a multiple" in said


def test_a_silent_recording_of_any_kind(tmp_path):
    folder = tmp_path / "own"
    folder.mkdir()
    for index, last in enumerate((0.09, 0.19, 0.39)):
        (folder / f"a{index}.csv").write_text(f"{HEADER}0,0,1\n{last},1,1\n")
    (folder / "b.csv").write_text(HEADER)
    np.savez(folder / "c.npz", time_s=[], taxel=[], polarity=[])
    np.save(folder / "d.npy", np.zeros((2, 2, 7)))
    np.save(folder / "e.npy", np.zeros((2, 2, 0)))
    np.savez(folder / "f.npz", spikes=np.zeros((0, 2)))
    np.save(folder / "bins.npy", 0.02)
    found = load_data(folder)
    assert found.step_counts.tolist() == [5, 10, 20, 8, 8, 7, 8, 8]
    assert not found.events[3:].any()
    assert found.counts.notes == ("own: 5 recordings without events: 4 of them taken as long as the others",)

    rows = [
        f"{name},{seconds}"
        for name, seconds in (("b.csv", 0.3), ("e.npy", 0.25), ("a0.csv", 0.15), ("c.npz", ""))
    ]
    (folder / "recordings.csv").write_text("\n".join(["file,duration_s", *rows]))
    found = load_data(folder)
    assert found.step_counts.tolist() == [8, 10, 20, 15, 12, 7, 13, 12]
    assert found.groups == {}


def test_two_tables_say_what_one_does_not(write):
    for name in ("test/a.csv", "test/b.csv", "train/b.csv"):
        write(f"own/{name}", f"{HEADER}0,0,1\n0.1,0,1\n")
    write("own/labels.csv", "file,label,hand\ntest/b.csv,1,\nb.csv,3,\na.csv,2,left\n")
    folder = write(
        "own/test/recordings.csv", "file,duration_s,hand\na.csv,0.2,left\nb.csv,0.3,right\n"
    ).parents[1]
    found = load_data(folder, split="test")
    assert found.labels.tolist() == [2, 1]  # the row of a path before that of a name
    assert (found.step_counts.tolist(), found.groups) == ([10, 15], {"hand": ("left", "right")})
    write("own/test/labels.csv", "file,label,hand\na.csv,5,\n")
    found = load_data(folder, split="test")
    assert found.labels.tolist() == [5, 1]  # the nearer table
    assert found.groups == {"hand": ("left", "right")}
    write("own/test/recordings.csv", "file,label\na.csv,4\n")
    words = "own: test/recordings.csv: test/a.csv: label is '4' here and '5' in the table beside it; keep one of them"
    assert refused(DataError, "", load_data, folder, split="test") == words


def test_a_row_with_more_cells_than_its_table(write):
    write("own/a.csv", f"{HEADER}0,0,1\n")
    folder = write("own/labels.csv", "file,duration_s\na.csv,1,5\n").parent
    words = "own: labels.csv: row 2: ['a.csv', '1', '5']; give a file, and one value in each column"
    assert refused(DataError, "", load_data, folder) == words
    write("own/labels.csv", "file,duration_s\na.csv,1,\n")
    assert load_data(folder).step_counts.tolist() == [50]


@pytest.mark.parametrize(
    ("seconds", "said"),
    [
        ("0.3", "own: a.csv: an event at 0.39 s, its table says 0.3 s; fix one of them"),
        ("1e9", "own: a.csv: 1e+09 s in its table are past 1000000 bins of 0.02 s; use wider bins"),
        ("-1", "own: labels.csv: row 2: duration_s is '-1'; give seconds above 0, or nothing"),
        ("long", "own: labels.csv: row 2: duration_s is 'long'; give seconds above 0, or nothing"),
    ],
)
def test_lengths_that_cannot_be(write, seconds, said):
    write("own/a.csv", f"{HEADER}0.39,0,1\n")
    folder = write("own/labels.csv", f"file,duration_s\na.csv,{seconds}\n").parent
    assert refused(DataError, "", load_data, folder) == said


def test_names_of_classes_stand_wherever_numbers_do(write, tmp_path):
    write("own/a.csv", "time_s,taxel,polarity,label\n0,0,1,wood\n0.1,0,1,wood\n")
    write("own/b_label_cork_left.csv", f"{HEADER}0,0,1\n")
    np.savez(tmp_path / "own/c.npz", time_s=[0.0], taxel=[0], polarity=[1], label="wood")
    write("own/d.csv", f"{HEADER}0,0,1\n")
    write("own/e.csv", f"{HEADER}0,0,1\n")
    folder = write("own/labels.csv", "file,class\nd.csv,bark 2\nelsewhere.csv,zinc\n").parent
    found = load_data(folder)
    assert found.names == ("bark 2", "cork", "wood", "zinc")
    assert found.labels.tolist() == [2, 1, 2, 0, UNLABELLED]
    write("own/a.csv", "0,0,1,wood\n0.1,0,1,cork\n")
    assert "a.csv: labels wood and cork in one file, allowed is one" in refused(
        DataError, "", load_data, folder
    )
    write("own/a.csv", "0,0,1,7\n0.1,0,1,7\n")
    assert refused(DataError, "", load_data, folder) == (
        "own: classes '7' and 'bark 2'; give numbers from 0, or names, to all recordings"
    )


@pytest.mark.parametrize("text", ["0,0,1,wood\n0,0\n", "0,0,1,wood\n0,x,1,wood\n"])
def test_a_column_of_names_hides_no_fault(write, text):
    assert refused(DataError, "", load_data, write("a.csv", text)).startswith("a.csv: line 2: ")


def write_split(folder: Path, seed: int, names: list[str]) -> None:
    """Four recordings of each of these classes, of which each likes a taxel, counted from the last."""
    folder.mkdir(parents=True)
    made = events(seed, samples=4 * len(names), rate=0.1)
    for i, recording in enumerate(made):
        recording[i % len(names) - len(names)] |= events(100 + i, samples=1, rate=0.6)[0, 0]
        np.save(folder / f"sample_{i}_label_{names[i % len(names)]}.npy", recording)


COUNT = ("train", "--data", "data", "--system", "counters", "--thresholds", "1,3", "-o", "net.pt")


@pytest.fixture(params=[("5", "15", "25", "35"), ("cork", "felt", "silk", "wood")], ids=["numbers", "names"])
def scene(request, tmp_path, monkeypatch):
    """A data set with a split for validation, whose classes have gaps, or names."""
    names = list(request.param)
    for seed, split in enumerate(("train", "validation", "test")):
        write_split(tmp_path / "data" / split, seed, names if split == "train" else names[1:])
    monkeypatch.chdir(tmp_path)
    return names


def test_a_network_has_as_many_classes_as_there_are_and_knows_their_names(scene):
    code, out, err = run(*COUNT, "--json")
    assert (code, err) == (0, "")
    record = json.loads(out)["record"]
    assert record["class_names"] == scene
    assert as_json("inspect", "net.pt")["classes"] == CLASSES
    assert run("compile", "net.pt", "-o", "net.loom")[0] == 0
    found = as_json("run", "net.loom", "--data", "data")
    assert found["class_names"] == scene
    named = [scene[label] for label in found["labels"]]
    assert named == [class_in_name(name) for name in found["files"]]
    assert found["accuracy"] > 0.5
    assert found["accuracy"] == json.loads(out)["record"]["test_correct"] / 12

    np.save("unknown.npy", np.load(Path("data/test", found["files"][0])))
    words = run("run", "net.loom", "--data", "unknown.npy")[1].splitlines()
    assert words[1].split()[:2] == ["unknown.npy", found["class_names"][found["predictions"][0]]]
    Path("data/test/sample_99_label_99.npy").write_bytes(Path("unknown.npy").read_bytes())
    if scene[0] == "5":
        assert f"data: class '99', the network knows {', '.join(scene)}" in refusal(
            "run", "net.loom", "--data", "data"
        )


def test_other_commands_take_the_same_numbers(scene):
    assert run(*COUNT)[0] == 0
    assert run("compile", "net.pt", "-o", "net.loom")[0] == 0
    reached = as_json("run", "net.loom", "--data", "data")["accuracy"]
    verdict = as_json("verify", "net.loom", "--checkpoint", "net.pt", "--data", "data")
    assert verdict["accuracy"]["chip"] == reached


def test_describe_names_classes(scene):
    found = as_json("data", "describe", "data", "--split", "train")
    assert found["labels"] == dict.fromkeys(scene, 4)


def test_several_splits(scene):
    assert data_splits("data") == ("test", "train", "validation")
    before = as_json(*COUNT)
    assert run("compile", "net.pt", "-o", "net.loom")[0] == 0
    ran = as_json("run", "net.loom", "--data", "data", "--split", "validation")
    assert len(ran["files"]) == 12
    assert as_json("data", "describe", "data", "--split", "validation")["recordings"] == 12
    assert set(as_json("data", "convert", "data", "-o", "out")["splits"]) == {"train", "validation", "test"}
    converted = load_data("out", "validation")
    np.testing.assert_array_equal(converted.events, load_data("data", "validation").events)
    named = [converted.class_name(each) for each in converted.labels]
    assert named == [class_in_name(name) for name in load_data("data", "validation").files]
    for file in Path("data/validation").iterdir():
        file.unlink()
    assert as_json(*COUNT) == before


def test_networks_that_know_no_names_say_so(scene):
    names = [str(index) for index in range(CLASSES)]
    for seed, split in enumerate(("train", "test")):
        write_split(Path("plain", split), seed, names)
    assert run(*COUNT[:2], "plain", *COUNT[3:])[0] == 0
    assert run("compile", "net.pt", "-o", "net.loom")[0] == 0
    code, _, err = run("run", "net.loom", "--data", "data", "--split", "train")
    if scene[0] == "5":
        assert code == 2
        assert "label 5, the network has 4 classes (0..3)" in err
    else:
        assert code == 0
        assert "the network does not know names of classes: cork, felt, silk, wood are 0, 1, …" in err


def test_a_zip_in_a_zip_is_limited(textures, tmp_path, monkeypatch):
    place = packed(textures, tmp_path / "a.zip")
    monkeypatch.setattr(evtouch, "MAX_FILE_BYTES", 100)
    assert "more than 100 bytes, the limit of a recording" in refused(DataError, "", load_data, place)
    monkeypatch.undo()
    monkeypatch.setattr(eventfiles, "MAX_NPZ_BYTES", 100)
    assert "more than 100 bytes, the limit of a recording" in refused(DataError, "", load_data, place)
    monkeypatch.undo()
    monkeypatch.setattr(evtouch, "MAX_TOTAL_BYTES", 600)
    assert "limit 600" in refused(DataError, "", load_data, place)


def test_nothing_is_unpickled(tmp_path):
    content = io.BytesIO()
    np.savez(content, spikes=np.array([{}], dtype=object))
    (tmp_path / "a.npz").write_bytes(content.getvalue())
    assert "holds an array of objects" in refused(DataError, "", load_data, tmp_path / "a.npz")


def test_the_textures_of_another_laboratory(request, tmp_path):
    shared = request.getfixturevalue("objects_zip").parent / "ntp-textures.zip"
    if not shared.exists():
        pytest.skip("no textures on this machine")
    found = load_data(shared, limit=3, groups=["speed", "force"])
    assert found.events.shape[1:3] == (10, 2)
    assert found.groups == {"speed": ("1200",) * 3, "force": ("0.0", "0.5", "1.0")}
    with np.load(io.BytesIO(zipfile.ZipFile(shared).read(found.files[0]))) as archive:
        np.testing.assert_array_equal(found.events[0, :, 1, : len(archive["spikes"])].T, archive["spikes"])


def test_watch_says_names(scene):
    assert run(*COUNT)[0] == 0
    assert run("compile", "net.pt", "-o", "net.loom")[0] == 0
    Path("live.csv").write_text(f"{HEADER}0,5,1\n0.1,5,1\n")
    said = run("watch", "net.loom", "--input", "live.csv")[1]
    (grasp,) = [line for line in said.splitlines() if line.startswith("grasp 1: class ")]
    assert grasp.split()[3].rstrip(",") in scene
    lines = run("watch", "net.loom", "--input", "live.csv", "--json")[1].splitlines()
    decided = json.loads(lines[-2])
    assert decided["class_name"] == scene[decided["decision"]]


def test_names_survive_joining_and_nir(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for file, names in (("a.pt", "abcd"), ("b.pt", "abcd"), ("c.pt", "abdc")):
        own_file(tmp_path / file, training={"seed": 0, "class_names": list(names)})
    assert refusal("join", "a.pt", "c.pt", "-o", "j.pt") == (
        "join: networks whose classes have other names; give those of the same classes"
    )
    assert run("join", "a.pt", "b.pt", "-o", "j.pt")[0] == 0
    assert run("compile", "j.pt", "--weight-bits", "8", "-o", "j.loom")[0] == 0
    assert run("export", "j.loom", "--to", "nir", "-o", "j.nir")[0] == 0
    assert run("compile", "j.nir", "-o", "again.loom")[0] == 0
    np.save("x_label_c.npy", events(1, samples=1)[0])
    for netlist in ("j.loom", "again.loom"):
        found = as_json("run", netlist, "--data", "x_label_c.npy")
        assert (found["class_names"], found["labels"]) == (list("abcd"), [2])
