"""What commands do not do in silence: each says it, or refuses it. Options without effect: ``refusals.txt``."""

import shutil
from pathlib import Path

import commands
import numpy as np
import pytest
from made_files import CLASSES, TAXELS, own_file, weights

from spikeloom.compiler.targets.loihi1.netlist import read_netlist
from spikeloom.models.recordings.conditions import conditions
from spikeloom.models.recordings.events import load_data

BIN = 0.05


def write(
    folder: Path, *, seed: int, samples: int = 9, steps: int = 30, lengths=(1.0,), unit=1.0, both=True
) -> Path:
    """Event files of several lengths, as shares of `steps`, in the unit of so many seconds."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    for index in range(samples):
        grid = rng.random((int(steps * lengths[index % len(lengths)]), TAXELS, 2)) < 0.3
        grid[-1, 0, 1] = True  # the last event says how long it is
        grid[..., 0] &= both
        rows = [
            f"{(step + 0.5) * BIN / unit:.6g},{taxel},{polarity}"
            for step, taxel, polarity in np.argwhere(grid)
        ]
        name = f"speed{index % 2}_force=0.{index % 3}_label_{index % CLASSES}_{index}.csv"
        (folder / name).write_text("\n".join(["time_s,taxel,polarity", *rows, ""]))
    return folder


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Recordings, and networks that know them, their bins, or nothing of any."""
    at = tmp_path_factory.mktemp("said")
    write(at / "data" / "train", seed=1)
    write(at / "data" / "test", seed=2)
    write(at / "uneven" / "train", seed=1, lengths=(1, 0.5, 0.4))
    write(at / "uneven" / "test", seed=2, lengths=(1, 0.5, 0.4))
    own_file(at / "net.pt", last=weights(3, gain=2.5), training={"data": "data", "bin_s": BIN})
    own_file(at / "other.pt", last=weights(4, gain=2.5), training={"data": "data", "bin_s": BIN})
    own_file(at / "free.pt", last=weights(3, gain=2.5))
    commands.as_json("compile", at / "net.pt", "-o", at / "net.loom")
    commands.as_json("compile", at / "free.pt", "-o", at / "free.loom")
    shared = ("--data", at / "data", "--bin", BIN, "--taxels", TAXELS)
    commands.as_json("train", "--system", "counters", *shared, "-o", at / "counters.pt")
    commands.as_json("compile", at / "counters.pt", "-o", at / "counters.loom")
    return at


@pytest.fixture
def said(place, monkeypatch):
    """What a command that succeeds prints, and what it says on standard error."""
    monkeypatch.chdir(place)

    def run(words: str) -> tuple[str, str]:
        code, out, err = commands.run(*words.split())
        assert code == 0, err
        return out, err

    return run


@pytest.fixture
def refused(place, monkeypatch):
    monkeypatch.chdir(place)
    return lambda words: commands.refusal(*words.split())


# -- early decisions ---------------------------------------------------------------------------------------------------
def test_figures_of_unequal_recordings_are_not_those_of_the_live_command(said):
    for words in ("anytime net.loom --data uneven", "anytime net.loom --data uneven --calibrate uneven"):
        out, _ = said(words)
        assert "--bins 30 --until-sure" in out
        assert "ends with its own last step here, after 12 to 30; live, all are padded" in " ".join(
            out.split()
        )
    assert "padded" not in said("anytime net.loom --data data")[0]


def test_recordings_that_calibrate_are_not_reported_in_silence(said, refused, place):
    assert "calibrat" not in said("anytime net.loom --data data --calibrate data")[1]
    once = "warning: test: 9 of 9 test recordings are training recordings, too"
    assert once in said("anytime net.loom --data data/test --calibrate data/test")[1]
    assert "warning: data: 9 of 9 test" in said("lean net.pt --data data --split train")[1]
    told = "--held-out: data trained the network; omit it, or give others"
    assert refused("anytime counters.loom --data data --calibrate data --held-out") == told


def test_recordings_that_chose_the_storage_are_not_verified_on_in_silence(said, place):
    said("compile net.pt --calibrate data/test -o chosen.loom")
    told = "warning: test: these are the 9 recordings that the network was compiled on"
    for words in (
        "run chosen.loom --data data/test",
        "verify chosen.loom --checkpoint net.pt --data data/test --min-agreement 0",
        "estimate chosen.loom --data data/test",
    ):
        assert told in said(words)[1]
    said("compile net.pt --calibrate data -o right.loom")
    assert "the network was compiled on" not in said("run right.loom --data data")[1]
    told = "warning: test: these are 4 of the 9 recordings that the network was compiled on"
    assert told in said("run chosen.loom --data data/test --limit 4")[1]
    assert "the network was compiled on" not in said("run right.loom --data data --limit 4")[1]
    told = "warning: train: these are the 9 recordings that the network was compiled on"
    said("lean free.pt --data data --bin 0.05 -o lean.loom")
    assert told in said("run lean.loom --data data/train")[1]
    assert read_netlist(place / "lean.loom").provenance["bin_s"] == BIN
    said("compile counters.pt --calibrate data -o own.loom")
    provenance = read_netlist(place / "own.loom").provenance
    assert "train_sha256" in provenance
    assert "calibrated_sha256" not in provenance


def test_a_part_of_what_trained_the_network_is_not_reported_in_silence(said):
    few = "--features 2 --hidden 4 --epochs 1 --data data --bin 0.05 --taxels 6"
    said(f"train --system mlp {few} --window 50% -o half.pt")
    said("compile half.pt -o half.loom")
    for part in ("", " --window 100%", " --window 20%", " --limit 9"):
        told = "warning: train: these are the 9 recordings that trained the network"
        assert told in said(f"run half.loom --data data/train{part}")[1]
    told = "warning: train: these are 2 of the 9 recordings that trained the network"
    assert told in said("run half.loom --data data/train --limit 2")[1]


def test_counters_that_fewer_bits_would_silence_are_said(said):
    told = "of counters and sums round to zero, so it may decide otherwise"
    assert told in said("compile counters.pt --weight-bits 4 -o out.loom")[1]
    assert told not in said("compile counters.pt --weight-bits 8 -o out.loom")[1]


# -- classes, times and conditions -------------------------------------------------------------------------------------
def test_classes_that_training_recordings_lack_are_said(said, place):
    shutil.copytree(place / "data", place / "fewer", dirs_exist_ok=True)
    for file in (place / "fewer" / "train").glob("*_label_1_*"):
        file.unlink()
    told = "warning: fewer: no training recordings of class 1"
    for words in (
        "compile net.pt --calibrate fewer -o out.loom",
        "lean net.pt --data fewer",
        "finetune net.pt --data fewer --epochs 1 --weight-bits 8 -o tuned.pt",
        "train --system counters --data fewer --bin 0.05 --taxels 6 -o out.pt",
        "anytime net.loom --data fewer --calibrate fewer",
    ):
        assert told in said(words)[1], words
        assert "no training recordings" not in said(words.replace("fewer", "data"))[1]


@pytest.mark.parametrize(
    ("unit", "first", "options", "note"),
    [
        (0.001, 0, "", "times up to 1475 s with less than an event a second; write seconds"),
        (1, 70, "", "events begin at 70"),
        (1, 70, "--origin first", ""),
        (1, 0, "", ""),
    ],
)
def test_watch_says_of_times_what_run_says(said, place, unit, first, options, note):
    at = write(place / "live", seed=2, samples=1, steps=30, unit=unit)
    lines = next(at.iterdir()).read_text().splitlines()[1:]
    # hardly an event a second, as of a touch in milliseconds
    kept = [line.split(",", 1) for line in (lines[::6] if unit < 1 else lines)]
    text = "\n".join(f"{float(time) + first:g},{rest}" for time, rest in kept)
    next(at.iterdir()).write_text("time_s,taxel,polarity\n" + text + "\n")
    file = next(at.iterdir()).relative_to(place)
    watched = said(f"watch net.loom --input {file} {options}")[1]
    ran = said(f"run net.loom --data {file}")[1]
    if options:
        assert "warning" not in watched
        return
    for err in (watched, ran):
        assert note in err
        assert ("write seconds" in err or "count times" in err) == bool(note)


@pytest.mark.parametrize(
    "words",
    [
        "run free.loom --data data --bin 50",
        "run net.loom --data minutes",
        "train --system counters --data data --bin 0.05 --taxels 6 --join 4 -o out.pt",
        "train --system mlp --features 2 --hidden 4 --epochs 1 --data data --bin 0.05 --taxels 6 --join 100 -o out.pt",
        "data describe data --bin 50",
        "data convert data --bin 0.05 --join 100 -o joined.zip",
    ],
)
def test_recordings_of_hardly_a_step_are_said(said, place, words):
    write(place / "minutes" / "test", seed=2, unit=60)
    assert " in the longest recording; are its times seconds, and are steps so long?" in said(words)[1]


def test_recordings_of_a_sensible_length_are_not_doubted(said):
    assert "longest recording;" not in said("run net.loom --data data")[1]


def test_lengths_in_milliseconds_are_said(said, place):
    shutil.copytree(place / "data", place / "lengths", dirs_exist_ok=True)
    for scale in (1000, 1):
        rows = [f"{file.name},{scale * 1.6:g}" for file in sorted((place / "lengths" / "test").iterdir())]
        (place / "lengths" / "recordings.csv").write_text("\n".join(["file,duration_s", *rows]))
        doubted = "no event after a tenth of each recording" in said("run net.loom --data lengths")[1]
        assert doubted == (scale == 1000)


def test_a_polarity_that_nothing_has_is_said(said, place):
    write(place / "rising" / "test", seed=2, both=False)
    assert "rising: no event of polarity 0 in 9 recordings" in said("run net.loom --data rising")[1]
    assert "no event of polarity" not in said("run net.loom --data data")[1]
    rng = np.random.default_rng(0)
    (place / "flat").mkdir(exist_ok=True)
    for index in range(9):  # one polarity, which counts as rising
        np.savez(place / "flat" / f"a_{index}_label_0.npz", events=rng.random((30, TAXELS)) < 0.3, bin_s=BIN)
    assert "flat: no event of polarity 0 in 9 recordings" in said("run net.loom --data flat")[1]


def test_conditions_of_some_recordings_are_said(said, place):
    shutil.copytree(place / "data", place / "mixed", dirs_exist_ok=True)
    files = sorted((place / "mixed" / "test").iterdir())
    rows = [f"{file.name},{'' if index < 2 else index % 2}" for index, file in enumerate(files)]
    (place / "mixed" / "recordings.csv").write_text("\n".join(["file,speed", *rows]))
    told = "warning: mixed: 2 of 9 recordings have no speed: no condition"
    assert told in said("run net.loom --data mixed")[1]


def test_converted_recordings_keep_their_conditions(said, place):
    shutil.copytree(place / "data", place / "known", dirs_exist_ok=True)
    files = sorted((place / "known").glob("*/*.csv"))
    rows = [f"{file.parent.name}/{file.name},{index % 2}" for index, file in enumerate(files)]
    (place / "known" / "recordings.csv").write_text("\n".join(["file,hand", *rows]))
    said("data convert known --bin 0.05 -o converted")
    for groups in (None, ["speed", "force", "hand"]):
        before, after = (
            load_data(place / name, "test", bin_s=BIN, groups=groups) for name in ("known", "converted")
        )
        assert before.groups == after.groups
        assert before.sha256 == after.sha256
    assert {*conditions(after)} == {"speed", "force", "hand"}


def test_a_network_that_is_joined_to_itself_is_said(said):
    told = "warning: join: one network stands there twice"
    assert told in said("join net.pt net.pt -o twice.pt")[1]
    assert told in said("join twice.pt net.pt -o thrice.pt")[1]
    assert told not in said("join net.pt other.pt -o two.pt")[1]


def test_a_folder_of_one_split_has_the_bins_that_are_said_beside_it(said):
    said("data convert data --bin 0.05 -o binned")
    for path in ("binned", "binned/test"):
        assert "1.5 s in bins of 0.05 s" in said(f"data describe {path}")[0]
    said("run net.loom --data binned/test")


def test_recordings_that_last_longer_than_the_clocks_are_said(said, place):
    write(place / "longer" / "test", seed=2, steps=40)
    write(place / "longer" / "train", seed=1, steps=20)
    few = "--features 2 --hidden 4 --epochs 1 --data data --bin 0.05 --taxels 6"
    said(f"train --system mlp {few} --clocks 4 -o clocks.pt")
    said("compile clocks.pt -o clocks.loom")
    told = "warning: longer: up to 40 steps, the network's clocks stop after 32"
    for command in ("run", "certify --most 1", "stress --checkpoint clocks.pt --seeds 1"):
        assert said(f"{command} clocks.loom --data longer")[1].count(told) == 1
    assert told in said("lean clocks.pt --data longer")[1]
    assert "clocks stop" not in said("run clocks.loom --data data")[1]


def test_watch_says_of_widths_what_run_says(said, place):
    said("export free.loom --to nir --dt 0.001 -o fine.nir")
    said("compile fine.nir -o fine.loom")
    file = next((place / "data" / "test").iterdir()).relative_to(place)
    told = "bins of 0.05 s, the network was read in steps of 0.001 s; are these its steps?"
    assert told in said(f"run fine.loom --data {file} --bin 0.05")[1]
    assert told in said(f"watch fine.loom --input {file} --bin 0.05")[1]
    assert "read in steps" not in said(f"watch net.loom --input {file}")[1]


# -- options and words -------------------------------------------------------------------------------------------------
def test_counters_end_a_grasp_early_without_being_told_its_length(said, place):
    file = next((place / "data" / "test").iterdir()).relative_to(place)
    length = read_netlist(place / "counters.loom").clocks.length
    known = said(f"watch counters.loom --input {file} --until-sure")
    assert known == said(f"watch counters.loom --input {file} --until-sure --bins {length}")


def test_no_polarities_are_refused(refused, said):
    said("export free.loom --to nir -o flat.nir")
    told = "--polarities 0: allowed are numbers from 1"
    assert refused("compile flat.nir --polarities 0 -o out.loom") == told
    for option in ("--polarities 1", "--polarities-first"):
        told = f"{option}: the file says 2 polarities, taxel by taxel; omit it"
        assert refused(f"compile flat.nir {option} -o out.loom") == told
    said("compile flat.nir --polarities 2 --polarities-last -o out.loom")


def test_a_file_of_integers_is_to_be_compiled_first(refused, place):
    (place / "x.net").write_bytes(b"\x89HDF\r\n\x1a\n")
    told = "x.net: is a trained network; compile it first: spikeloom compile x.net -o NET.loom"
    assert refused("inspect x.net") == told


def test_progress_is_of_a_form_that_is_known(refused, said, monkeypatch):
    monkeypatch.setenv("SPIKELOOM_PROGRESS", "xml")
    assert (
        refused("inspect net.loom")
        == "SPIKELOOM_PROGRESS=xml: no form of progress; allowed is json, or unset it"
    )
    monkeypatch.setenv("SPIKELOOM_PROGRESS", "")
    said("inspect net.loom")


def test_steps_of_unequal_recordings_are_the_most(said):
    assert said("estimate net.loom --data uneven")[0].startswith("per inference of up to 33 chip steps")
    assert said("estimate net.loom --data data")[0].startswith("per inference of 33 chip steps")


def test_certificates_call_classes_by_name(said, place):
    for split in ("train", "test"):
        shutil.copytree(place / "data" / split, place / "named" / split, dirs_exist_ok=True)
        for file in (place / "named" / split).iterdir():
            index = int(file.stem.split("_label_")[1][0])
            name = ("cork", "foam", "steel", "wool", "wood", "iron", "sand", "clay")[index]
            file.rename(file.with_name(file.name.replace(f"_label_{index}", f"_label_{name}")))
    said("train --system counters --data named --bin 0.05 --taxels 6 -o named.pt")
    said("compile named.pt -o named.loom")
    out, _ = said("certify named.loom --data named --limit 2 --most 1 --shift 1")
    rows = [line.split() for line in out.splitlines() if "_label_" in line]
    assert [name.split("_label_")[1].partition("_")[0] for name, *_ in rows] == [row[1] for row in rows]
    assert {row[2] for row in rows} <= {"cork", "foam", "steel", "wool"}


def test_storage_that_nothing_tests_is_not_said_to_keep_decisions(said, place):
    own_file(place / "mute.pt", last=weights(3, gain=0.001), training={"data": "data", "bin_s": BIN})
    out, _ = said("compile mute.pt --calibrate data -o mute.loom")
    assert "0 of 0" not in out
    assert "untested: the float model decides no thinned, held-out training recording" in out
