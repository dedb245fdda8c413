"""Every mistake that a user can make: one clear line on standard error, exit code 2, nothing half-written.

One table: what is typed, and the words that the line must hold: the option or file, the value, what is allowed.
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

from spikeloom.compiler.targets.loihi1.netlist import read_netlist, write_netlist
from spikeloom.runtime import cli

GOOD = events(2)[0].astype(np.float32)


FLAT = "flat: has no train/ and test/, so that the same recordings would train and test"


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
    return at


COMPILE = "compile {} -o out.loom"
NETLISTS = (
    "run --data data",
    "verify --checkpoint net.pt",
    "export --to onnx -o x.onnx",
    "stress --checkpoint net.pt --data data",
)
RUN = "run net.loom --data {}"
EXPLAIN = "explain net.loom --checkpoint net.pt --data data {}"
REPORT = "report net.loom --checkpoint net.pt --data data -o x.html {}"
VERIFY = "verify net.loom --checkpoint net.pt --data data {}"
STRESS = "stress net.loom --checkpoint net.pt --data data {}"
ANYTIME = "anytime net.loom --data data {}"
WATCH = "watch net.loom --input flat/tap_0_label_0.csv {}"
TRAIN = "train --data synthetic {} -o x.pt"
SEEDS = "train --data synthetic --graph manual {}"

TABLE = [
    # commands and options
    ("fly", "fly: no command|spikeloom --help"),
    ("compile net.pt", "arguments are required: -o/--output"),
    (COMPILE.format("net.pt more"), "unrecognized arguments: more"),
    ("inspect net.loom --beta 0.3", "--beta 0.3: is for checkpoints|net.loom is a netlist"),
    ("inspect net.loom --weights best", "--weights best|net.loom is a netlist"),
    (COMPILE.format("net.pt --dump-after nope"), "--dump-after nope|calibrate, disconnect"),
    (VERIFY.format("--require E0 --min-agreement 0.9"), "--min-agreement 0.9|E3=0.9"),
    (RUN.format("data --bin 0.05"), "--bin 0.05: data holds bins"),
    ("estimate net.loom --data synthetic --bin 0.05", "--bin 0.05: synthetic holds bins"),
    (VERIFY.format("--min-agreement 1.1"), "--min-agreement 1.1|from 0 to 1"),
    (VERIFY.format("--spec-samples 0"), "--spec-samples 0|at least 1"),
    # checkpoints
    *(
        (f"{command} missing.pt", "missing.pt: no such file")
        for command in ("inspect", "compile -o out.loom")
    ),
    ("inspect empty.pt", "empty.pt: is not a checkpoint"),
    ("inspect data", "data: is a folder|spikeloom data describe"),
    ("inspect notes.zip", "notes.zip: holds a/b/notes.txt"),
    ("inspect events.npz", "events.npz: holds polarity.npy, taxel.npy, time_s.npy|spikeloom data describe"),
    ("inspect bomb.pt", "bomb.pt|claim to hold 1048576"),
    (COMPILE.format("evil0.t7 --graph manual"), "evil0.t7: is a pickle that calls posix.mkdir"),
    (COMPILE.format("evil1.t7 --graph manual"), "evil1.t7: is a pickle that calls posix.mkdir"),
    ("inspect plain.pkl", "plain.pkl: is pickled with protocol 4|torch.save"),
    ("inspect net.t7 --run 3", "--run 3|runs 0 to 2"),
    ("inspect net.t7 --weights best", "--weights best|last epoch only"),
    ("inspect net.pt --weights best", "--weights best: the file holds last"),
    ("inspect net.pt --run 1", "--run 1|only run 0"),
    *((f"inspect net.t7 --beta {text}", f"beta {text}|0 <= beta < 1") for text in ("1", "nan")),
    *((f"inspect net.t7 --theta {text}", f"theta {text}|above 0") for text in ("0", "inf")),
    ("inspect pretrained:nope", "pretrained:nope: no such shipped|pretrained:grasps"),
    *(
        (COMPILE.format(name), "NIR, or in Python as spikeloom.compile(module, ex")
        for name in ("linear.pt", "evil0.t7")
    ),
    *((f"{command} net.t7", "net.t7: is a trained network; compile it first") for command in NETLISTS),
    *(
        (f"{command} grasp_label_1.npz", "grasp_label_1.npz: holds recordings; give the netlist")
        for command in NETLISTS
    ),
    (
        "run pretrained:grasps --data data",
        "compile it first: spikeloom compile pretrained:grasps -o NET.loom",
    ),
    (
        COMPILE.format("grasp_label_1.npz"),
        "grasp_label_1.npz: holds recordings; give the network here|--calibrate",
    ),
    ("join net.loom net.pt -o out.pt", "net.loom: is a netlist, its weights are rounded"),
    (
        "data describe semicolons.csv",
        "columns time_s;taxel;polarity, expected are|name them so, separated by commas",
    ),
    # graphs, targets, storage
    (COMPILE.format("bare.pt"), "bare.pt: the graph is not in this file|--graph: manual"),
    (COMPILE.format("bare.pt --graph manual"), f"the graph has 39 taxels, fc1 was trained on {TAXELS}"),
    (COMPILE.format("net.pt --graph manual"), "net.pt|trained on ring, --graph says manual"),
    (COMPILE.format("finger.pt --graph nope"), "graph 'nope': unknown; choose manual"),
    (COMPILE.format("net.pt --target loihi2"), "--target loihi2: not modelled|allowed: loihi1, truenorth"),
    (COMPILE.format("net.pt --target ../loihi1"), "--target ../loihi1: unknown|loihi1, truenorth"),
    (
        "finetune net.pt --data data --target truenorth -o x.pt",
        "--target truenorth: its cores are crossbars, this is for compartments; allowed: loihi1",
    ),
    *((COMPILE.format(f"net.pt --weight-bits {n}"), f"--weight-bits {n}|2, 3, 4, 5, 6, 8") for n in (7, 9)),
    (COMPILE.format("net.pt --weight-bits 8.0"), "--weight-bits 8.0: not a number|8,4,4,8"),
    (COMPILE.format("net.pt --calibrate nowhere"), "nowhere: no such folder or file|train/ and test/"),
    ("compile net.pt --chips 0 -o out.loom", "--chips 0: not a number of chips; give 1 or more"),
    # layouts
    *(
        (
            COMPILE.format(f"net.pt --cores-for {text!r}"),
            f"{word!r} is not LAYER=N, N from 1; write for example fc1=6",
        )
        for text, word in (("fc1=2,=3", "=3"), ("fc1=0", "fc1=0"))
    ),
    *(
        (COMPILE.format(f"net.pt --cores-for {text}"), f"--cores-for {text}: {why}")
        for text, why in (
            ("fc1=2,fc1=3", "names fc1 twice; give it once"),
            ("fc4=2", "no such layer; layers are conv1, fc1, fc2, fc3"),
            ("fc1=10", "fc1 has 9 neurons on the chip; give 9 or fewer"),
            ("conv1=200", "Intel Loihi 1 has 128 cores (loihi1.chip.cores); give 128 or fewer"),
        )
    ),
    (COMPILE.format("net.pt --calibrate data --keep 2"), "--keep 2: not a share"),
    (COMPILE.format("net.pt --keep 0.9"), "--keep 0.9: no recordings to hold out; give --calibrate"),
    *(
        (
            COMPILE.format(f"net.pt --calibrate data --keep 0.9 {more}"),
            "--keep 0.9: chooses storage; omit it, or",
        )
        for more in ("--planes 2", "--spike-exact")
    ),
    # formats
    ("export x.loom -o x --to sanafe --data x", "--data x: is for ranc"),
    ("export x.loom -o x --to onnx --recording 0", "--recording 0: is for ranc"),
    ("export x.loom -o x --to ranc --recording 1", "--recording 1: says which recording of --data"),
    ("export x.loom -o x --to nir --form step", "--form step: is for onnx"),
    ("export x.loom -o x --to sanafe --dt 1", "--dt 1.0: is for nir"),
    # studies
    (ANYTIME.format("--differ 0.1"), "--differ 0.1: |add --calibrate"),
    (ANYTIME.format("--held-out"), "--held-out: |add --calibrate"),
    (ANYTIME.format("--calibrate data --differ 1"), "--differ 1: |from 0 to below 1"),
    (STRESS.format("--only taxels_ded"), "choose from taxels_dead, "),
    (STRESS.format("--only events_lost --require taxels_dead:3>=0.5"), "--only leaves taxels_dead out"),
    (STRESS.format("--seeds 0"), "allowed are 1 or more"),
    *(
        (STRESS.format(f"--require {words}"), telling)
        for words, telling in (
            ("taxels_ded:3>=0.5", "'taxels_ded' is no perturbation; choose from taxels_dead, "),
            ("taxels_dead>=0.5", "is not NAME:LEVEL>=SHARE"),
            ("taxels_dead:3>=85", "'85' is no share; give a number from 0 to 1"),
            ("taxels_dead:2.5>=0.5", "'2.5' is no level of it; give a whole number from 0 (taxels)"),
            ("events_lost:many>=0.5", "'many' is no level of it; give a number from 0 to 1 (probability)"),
            ("taxels_dead:7>=0.5", "the sensor has 6 taxels"),
        )
    ),
    # streams
    ("watch net.loom --input none.csv", "none.csv: No such file"),
    ("watch net.loom --input notes.zip", "--input notes.zip: is no text; give event lines"),
    (
        "watch net.loom --input words.txt",
        "'hello' found; give one event 'time_s,taxel,polarity' a line, three numbers, or reset",
    ),
    ("watch net.loom --input empty.pt", "empty.pt: empty stream"),
    (WATCH.format("--until-sure"), "--until-sure: |--bins"),
    (WATCH.format("--bins 5 --until-sure -1"), "--until-sure -1: "),
    *((WATCH.format(words), f"{words}: ") for words in ("--bin nan", "--bins 0")),
    # training
    (TRAIN.format("--system counters --epochs 3"), "--epochs 3: counters are trained without; omit it"),
    (
        TRAIN.format("--system counters --window 50"),
        "--window 50%: counters see what comes later; give --parts 2",
    ),
    (TRAIN.format("--system counters --seed 3"), "omit --recipe, --seed and --seeds"),
    (TRAIN.format("--system mlp --parts 3"), "--parts 3: is for --system counters; omit it"),
    (TRAIN.format("--system mlp --hops 2"), "--hops 2: an MLP has no hops to choose; omit it"),
    (TRAIN.format("--system mlp --hidden 0"), "--hidden 0: allowed are 1 to 1024"),
    (SEEDS.format("-o x.pt --seeds 0"), "--seeds 0: allowed are 1 or more"),
    (SEEDS.format("-o x.pt --robust 1"), "--robust 1: allowed are numbers from 0 to below 1"),
    (SEEDS.format(f"-o x.pt --seed {10**22}"), f"--seed {10**22}: allowed are 0 to {2**63 - 1}"),
    (SEEDS.format("-o x.pt --picture none/x.png"), "--picture none/x.png: the folder does not exist"),
    (
        SEEDS.format("-o x.pt --epochs 1 --resume"),
        "nothing was interrupted, neither x.pt nor x.pt.state.validation",
    ),
    (TRAIN.format("--system counters --levels 0"), "--levels 0: allowed are 1 or more"),
    *(
        (f"train --data nowhere --graph manual -o x.pt {words}", f"{words}: allowed are ")
        for words in ("--epochs 0", "--batch 0", "--robust 2", "--seed -5", "--decay-epochs 0")
    ),
    *(
        (f"finetune net.pt --data nowhere -o x.pt {words}", f"{words}: ")
        for words in ("--epochs 0", "--seed -5", "--robust 2", "--weight-bits 7")
    ),
    *(
        (f"{command} --jobs 0", "--jobs 0: allowed are 1")
        for command in ("smallest --data data -o x.loom", "chart net.pt --data data -o x")
    ),
    *(
        (f"smallest --data data -o x.loom --levels {n}", f"--levels {n}: {why}")
        for n, why in ((0, "allowed are 1"), (3, "4 classes are no"))
    ),
    # prices
    ("estimate net.loom --data data --detail spikes", "argument --detail: invalid choice|counts|cycle"),
    # places to write
    *(
        (f"{command} {where!r}", f"{command.split()[-1]} {where}: {why}")
        for command in (
            "compile net.pt -o",
            "run net.loom --data data --spikes",
            "train --data data --graph manual -o",
        )
        for where, why in (
            ("nowhere/out", "the folder does not exist"),
            ("data", "is not a regular file"),
            ("", "is not a regular file"),
            (f"{'x' * 250}.pt", "cannot be written (File name too long)"),
        )
    ),
    ("chart net.pt --data data -o nowhere/out", "-o nowhere/out: the folder does not exist"),
    ("data convert data -o nowhere/out", "-o nowhere/out: the folder does not exist"),
    ("compile net.pt -o net.pt", "-o net.pt: is an input of this command"),
    ("run net.loom --data data --spikes net.loom", "--spikes net.loom: is an input"),
    ("train --data words.txt --graph manual -o words.txt", "-o words.txt: is an input"),
    *(
        (f"{command} --picture x.txt", "--picture x.txt: has to end in .png or .svg or .pdf")
        for command in (
            "train --data data -o x.pt",
            NETLISTS[3].replace(" ", " net.loom ", 1),
            "certify net.loom --data data",
        )
    ),
    ("certify net.loom --data data -o x.svg --picture x.svg", "--picture x.svg: is also the -o file"),
    *(
        (f"{command} x.txt", f"{command.split()[-1]} x.txt: has to end in {kind}; give another name")
        for command, kind in (
            ("compile net.pt -o", ".loom"),
            ("train --data synthetic --graph manual -o", ".pt"),
            ("finetune net.pt --data data -o", ".pt or .nir"),
            ("join net.pt same.pt -o", ".pt"),
            ("smallest --data data -o", ".loom"),
            ("lean net.pt --data data -o", ".loom"),
            ("lean net.pt --data data --network", ".pt"),
            ("run net.loom --data data --spikes", ".npz"),
            ("export net.loom --to onnx -o", ".onnx"),
            ("export net.loom --to sanafe -o", ".yaml"),
        )
    ),
    ("data convert grasp_label_1.npz -o grasp_label_1.npz", "-o grasp_label_1.npz: exists already"),
    # what does not belong together
    ("verify net.loom --data data --checkpoint bare.pt", "bare.pt: the graph is not in this file"),
    ("verify net.loom --data data --checkpoint other.pt", "the netlist has taxels 6|fc2 8|fc2 7"),
    (VERIFY.format("--graph manual"), "trained on ring, --graph says manual"),
    ("verify finger.loom --checkpoint finger.pt --graph manual", "compiled for graph knn:1, this is manual"),
    (
        "verify net.loom --checkpoint net.pt --require E0",
        "--require E0: is about recordings, give --data too",
    ),
    ("explain net.loom --checkpoint other.pt --data data", "netlist and checkpoint disagree|fc2 8|fc2 7"),
    (REPORT.replace("x.html", "x.pdf").format(""), "-o x.pdf: has to end in .html; give another name"),
    *(
        (f"{command} --data data --checkpoint {other}", why)
        for command in ("report -o x.html", "explain", "stress")
        for other, why in (
            ("same.pt net.loom", "net.loom: compiled from a checkpoint of sha256"),
            ("finger.pt finger.loom --graph knn:2", "compiled for graph knn:1, this is knn:2"),
            (
                "finger.pt finger.loom --theta 0.9",
                "conv1 was compiled with theta 0.5, this has 0.9; give --theta 0.5",
            ),
        )
    ),
    ("lean net.pt --data data --differ 1.5", "--differ 1.5: not a share; give a number from 0 to below 1"),
    # one recording
    (EXPLAIN.format("--top 0"), "--top 0|at least 1"),
    (EXPLAIN.format("--sample sample_9_label_1.npy"), "among 6 of split test|near are sample_5_label_1.npy"),
    (
        EXPLAIN.format("--sample sample_5_label_1.npy --limit 1"),
        "among 1 of split test|near are sample_0_label_0",
    ),
    (REPORT.format("--recording 6"), "--recording 6|0 to 5"),
    # recordings
    *(
        (f"{command} --data flat", FLAT)
        for command in ("train --graph manual -o x.pt", "smallest -o x.loom", "lean net.pt")
    ),
    ("finetune net.pt --weight-bits 4 --data flat -o x.pt", FLAT),
    (
        "train --data square --graph manual -o x.pt",
        "square: has events of taxels 0..3 only, the network has 39; |--taxels",
    ),
    (
        COMPILE.format("net.pt --calibrate square"),
        "square: has events of taxels 0..3 only, the network has 6; ",
    ),
    (
        "run binned.loom --data flat --bin 0.1",
        "--bin 0.1: the network was trained on bins of 0.05 s; omit --bin",
    ),
    (
        RUN.format("pressures"),
        "pressures: test/sample_0_label_0.npy: |value 0.5 at taxel 0|allowed are 0 and 1",
    ),
    (
        COMPILE.format("net.pt --calibrate five"),
        "five: train/sample_0_label_0.npy: has 5 taxels, the network has 6",
    ),
    ("estimate net.loom --data polarities", "test/sample_1_label_1.npy: shape (6, 1, 24)|(6, 2, 24)"),
    (RUN.format("nowhere"), "nowhere: no such folder or file"),
    (RUN.format("net.loom"), "net.loom: no recordings"),
    (RUN.format("words.txt"), "words.txt: not a recording|.csv, .npz or .npy"),
    (RUN.format("data --limit 0"), "--limit 0: at least 1"),
    (RUN.format("data --limit two"), "--limit: invalid int value: 'two'"),
    (RUN.format("data --split ../data/test"), "split '../data/test' is missing|test, train"),
    (RUN.format("synthetic --split nope"), "--split nope|train, test"),
    (RUN.format("synthetic --limit 1"), "synthetic|has 39 taxels, the network has 6"),
    ("run finger.loom --data synthetic --limit 4", "synthetic|label 3, the network has 3 classes"),
    # netlists
    ("run data --data data", "data: is not a file|spikeloom compile"),
    ("run --data data '\x1b[2J.loom'", r"\x1b[2J.loom: no such file"),
    ("run --data data nowhere.loom", "nowhere.loom: no such file; write it with spikeloom compile"),
    ("run --data data half.loom", "half.loom: is truncated or damaged"),
]


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
    line = refusal(*shlex.split(words))
    for part in telling.split("|"):
        assert part in line


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
