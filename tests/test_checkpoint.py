"""Reading and writing checkpoints: every layout, and what each refusal says."""

import hashlib
import io
import json
import subprocess
import sys
import zipfile
from pathlib import Path

import made_files as made
import numpy as np
import pytest
import torch
from made_files import checkpoint_bytes, rebuilt, state_dict, torch_bytes, zipped
from numpy.testing import assert_array_equal
from oracles import refused

from spikeloom.compiler.archive import npy_bytes
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.files import SIZE_LIMIT
from spikeloom.compiler.formats import torch_file
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.formats.own_checkpoint import save_checkpoint
from spikeloom.compiler.formats.torch_file import read_torch_file
from spikeloom.models.graphs import Graph

TAXELS, FEATURES, HOPS, SIZES, CLASSES = 6, 4, 3, (5, 7), 3
NOT_A_CHECKPOINT = "is not a checkpoint; give"
DAMAGED = "is truncated or damaged"


def tensors(seed: int = 0, *, old: bool = False) -> dict[str, torch.Tensor]:
    """State dict under the keys of current torch_geometric, or of old releases: hops side by side."""
    return state_dict(made.weights(seed, features=FEATURES, sizes=(*SIZES, CLASSES)), old=old)


def write(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def released(*states: dict[str, torch.Tensor], **more: object) -> bytes:
    return torch_bytes({"net_list": list(states), **more})


def refusal(path: Path, **options: object) -> str:
    """Message of the error, without the path that starts it; it is one line."""
    message = refused(ModelError, str(path), read_checkpoint, path, **options)
    assert "\n" not in message
    return message.removeprefix(f"{path}: ")


def weights(seed: int = 1) -> dict[str, np.ndarray]:
    return made.weights(seed, features=FEATURES, sizes=(5, CLASSES))


def ring() -> Graph:
    edges = np.array([[i, (i + 1) % TAXELS] for i in range(TAXELS)] + [[0, 1]])
    return Graph(name="ring", coordinates=np.arange(TAXELS, dtype=float)[:, None], edges=edges)


def own(**changes: object) -> bytes:
    options = {"beta": 0.25, "theta": 0.75, "training": {"seed": 4}} | changes
    sets = options.pop("weights", {"last": weights(), "best": weights(2)})
    return checkpoint_bytes(sets, options.pop("graph", ring()), **options)


@pytest.mark.parametrize("new", [True, False], ids=["zip", "pre-1.6"])
@pytest.mark.parametrize("old", [False, True], ids=["lins", "lin"])
def test_every_released_layout_gives_the_same_weights(tmp_path, old, new):
    state = tensors()
    path = write(tmp_path / "x.t7", torch_bytes(tensors(old=old), new=new))
    read = read_checkpoint(path)
    assert (read.layout, read.runs, read.training) == ("state_dict", 1, None)
    assert (read.taxels, read.classes, read.hops.shape) == (TAXELS, CLASSES, (HOPS + 1, FEATURES, 2))
    for k in range(HOPS + 1):
        assert_array_equal(read.hops[k], state[f"conv1.lins.{k}.weight"])
    assert_array_equal(read.conv_bias, state["conv1.bias"])
    assert [dense.name for dense in read.dense] == ["fc1", "fc2", "fc3"]
    for dense in read.dense:
        assert_array_equal(dense.weight, state[f"{dense.name}.weight"])
        assert_array_equal(dense.bias, state[f"{dense.name}.bias"])
    arrays = [read.hops, read.conv_bias, *(a for dense in read.dense for a in (dense.weight, dense.bias))]
    assert all(a.dtype == np.float32 and a.flags.c_contiguous and not a.flags.writeable for a in arrays)
    assert (read.graph, read.edges) == (None, None)
    assert read.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


def test_run_selects_a_state_dict_and_its_figures(tmp_path):
    figures = {
        "best_acc": torch.tensor([90.0, 91.25]),
        "num_epochs": 2,
        "acc_list": [torch.tensor([80.0, 85.0])] * 2 + [torch.tensor([81.0, 86.5])] * 2,
    }
    path = write(tmp_path / "x.t7", released(tensors(0), tensors(1), **figures))
    read = read_checkpoint(path, run=1)
    assert (read.layout, read.runs) == ("released", 2)
    assert_array_equal(read.conv_bias, tensors(1)["conv1.bias"])
    assert read.training == {
        "runs": 2,
        "weights": "last epoch",
        "epochs": 2,
        "last_acc": 86.5,
        "best_acc": 91.25,
        "best_acc_note": "of the best epoch on the test split, not of these weights",
    }
    assert read_checkpoint(path).training["best_acc"] == 90.0


def test_half_and_double_precision_become_float32(tmp_path):
    for kind in (torch.float64, torch.float16, torch.bfloat16):
        path = write(
            tmp_path / "x.t7", torch_bytes({key: value.to(kind) for key, value in tensors().items()})
        )
        expected = tensors()["fc2.weight"].to(kind).to(torch.float32)
        assert_array_equal(read_checkpoint(path).dense[1].weight, expected)


def test_constants_come_from_the_user_or_are_reported_as_assumed(tmp_path):
    path = write(tmp_path / "x.t7", torch_bytes(tensors()))
    read = read_checkpoint(path)
    assert (read.beta, read.theta, read.assumed) == (0.2, 0.5, ("beta", "theta"))
    read = read_checkpoint(path, theta=1.5)
    assert (read.beta, read.theta, read.assumed) == (0.2, 1.5, ("beta",))
    assert read_checkpoint(path, beta=0.0, theta=0.5).assumed == ()


def test_the_released_checkpoint(released_checkpoint):
    read = read_checkpoint(released_checkpoint)
    assert (read.layout, read.taxels, read.classes, read.hops.shape) == ("released", 39, 36, (4, 64, 2))
    assert [dense.weight.shape for dense in read.dense] == [(128, 2496), (256, 128), (36, 256)]
    assert (read.training["epochs"], read.training["last_acc"], read.training["best_acc"]) == (
        100,
        88.1944,
        90.2778,
    )


def changed(*, old: bool = False, **tensors_too: object) -> bytes:
    """A state dict with other tensors; None stands for one that is missing."""
    state = tensors(old=old) | {key.replace("__", "."): value for key, value in tensors_too.items()}
    return torch_bytes({key: value for key, value in state.items() if value is not None})


NEITHER = "holds neither net_list nor weights of a TactileSGNet, but"
REFUSED = {
    "pickle of an empty dict": (lambda: b"\x80\x02}q\x00.", DAMAGED),
    "other manifest": (
        lambda: zipped({"manifest.json": '{"format": "other", "files": []}'}),
        NOT_A_CHECKPOINT,
    ),
    "manifest that is no JSON": (lambda: zipped({"manifest.json": "{"}), DAMAGED),
    "nested": (lambda: torch_bytes({"epoch": 3, "model": tensors()}), f"{NEITHER} epoch, model"),
    "odd name": (lambda: torch_bytes({"a\nb": 1}), f"{NEITHER} 'a\\nb'"),
    "no run": (released, "net_list holds no run"),
    "columns": (
        lambda: changed(old=True, conv1__lin__weight=torch.ones(FEATURES, 7)),
        "conv1.lin.weight has 7 columns, not a whole number of hops",
    ),
    "taxels": (
        lambda: changed(fc1__weight=torch.ones(5, TAXELS * FEATURES + 1)),
        "fc1.weight has 25 inputs, not a whole number of taxels with 4",
    ),
    "sparse": (
        lambda: changed(fc3__bias=torch.ones(3).to_sparse()),
        "is a pickle that calls torch._utils._rebuild_sparse_tensor, allowed are plain tensors",
    ),
    "integers": (
        lambda: changed(fc3__bias=torch.ones(3, dtype=torch.int64)),
        "fc3.bias is a tensor of int64, wanted plain floating-point",
    ),
    "expanded": (
        lambda: changed(fc3__weight=torch.ones(1).expand(10**6, 10**6)),
        "fc3.weight claims 1000000000000 values, more than the file holds",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_files_that_are_refused(tmp_path, name):
    made, words = REFUSED[name]
    assert words in refusal(write(tmp_path / "x.t7", made()))


def test_large_files(tmp_path):
    with (tmp_path / "large").open("wb") as file:
        file.truncate(SIZE_LIMIT + 1)
    assert "more than 268435456 bytes, the limit of a checkpoint" in refusal(tmp_path / "large")


def test_every_fault_of_the_tensors_is_listed(tmp_path):
    weight = tensors()["fc1.weight"]
    weight[2, :3] = torch.tensor([torch.nan, torch.inf, -torch.inf])
    content = changed(
        conv1__lins__1__weight=None,
        fc2__bias=None,
        fc3__weight=torch.ones(CLASSES, 8),
        fc1__bias=torch.ones(4),
        fc4__weight=torch.ones(2, CLASSES),
        fc1__weight=weight,
    )
    said = refusal(write(tmp_path / "x.t7", content))
    assert said.rpartition("; ")[0].split("; ") == [
        "conv1.lins.1.weight is missing",
        "fc1.weight has 3 of 120 values NaN or infinite",
        "fc1.bias is (4,), wanted (5,)",
        "fc2.bias is missing",
        "fc3.weight is (3, 8), wanted (3, 7)",
        "fc4.weight is not part of a TactileSGNet",
    ]


def test_own_format_round_trip(tmp_path):
    path = tmp_path / "x.pt"
    save_checkpoint(
        path,
        {"last": weights(), "best": weights(2)},
        **made.graph_facts(ring()),
        beta=0.25,
        theta=0.75,
        training={"seed": 4},
    )
    for which, seed in (("last", 1), ("best", 2)):
        read = read_checkpoint(path, weights=which)
        expected = weights(seed)
        assert_array_equal(read.hops, expected["conv1.hops"])
        assert_array_equal(read.conv_bias, expected["conv1.bias"])
        assert [dense.name for dense in read.dense] == ["fc1", "fc2"]
        for dense in read.dense:
            assert_array_equal(dense.weight, expected[f"{dense.name}.weight"])
            assert_array_equal(dense.bias, expected[f"{dense.name}.bias"])
    assert (read.beta, read.theta, read.assumed) == (0.25, 0.75, ())
    assert (read.layout, read.runs, read.graph, read.training) == ("spikeloom", 1, "ring", {"seed": 4})
    assert_array_equal(read.edges, ring().edges)
    assert (read.taxels, read.classes) == (TAXELS, CLASSES)
    assert read.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert read_checkpoint(path, beta=0.25).beta == 0.25
    with pytest.raises(OptionError, match=r"--theta 0.5: .* was trained with 0.75; omit --theta"):
        read_checkpoint(path, theta=0.5)
    assert own() == own() != own(beta=0.3)


@pytest.mark.parametrize("new", [True, False], ids=["zip", "pre-1.6"])
def test_parameters_views_and_attributes_are_read_as_torch_does(tmp_path, new):
    state = tensors()
    whole = torch.randn(9, 40)
    module = torch.nn.Module()
    module.part = torch.nn.Linear(2, 3)
    content = torch_bytes(
        [state, module.state_dict(), whole.T[3:30:2], torch.nn.Parameter(whole[2])], new=new
    )
    read = read_torch_file(content)
    assert list(read[0]) == list(state)
    assert_array_equal(read[1]["part.weight"].array, module.part.weight.detach())
    assert_array_equal(read[2].array, whole.T[3:30:2])
    assert_array_equal(read[3].array, whole[2])
    assert not read[2].array.flags.writeable


def torch_zip(pickled: bytes) -> bytes:
    return zipped({"x/data.pkl": b"\x80\x02" + pickled + b".", "x/data/0": bytes(8)})


TENSOR = b"ctorch._utils\n_rebuild_tensor\n((X\x07\0\0\0storagectorch\nFloatStorage\nX\x01\0\0\x000X\0\0\0\0K\x02tQ%btR"
"""A tensor of two numbers; its offset, sizes and strides are missing."""

MADE_UP = {
    "beyond its storage": (TENSOR % b"K\x01K\x02\x85K\x01\x85", "reaches beyond its storage"),
    "negative stride": (TENSOR % b"K\x01K\x02\x85J\xff\xff\xff\xff\x85", "no usable sizes"),
    "truth values for sizes": (TENSOR % b"K\0\x88\x85\x88\x85", "no usable sizes"),
    "keys that take for ever": (b"}" + b")q\0" + b"h\0h\0\x86q\0" * 200 + b"Ns", "sets a key"),
    "a memo of 32 GiB": (b"Nr\xff\xff\xff\xff", "holds neither"),
    "a text of 4 GiB": (b"X\xff\xff\xff\xff", DAMAGED),
    "no end of instructions": (b"N0" * 10, DAMAGED),
    "a list inside itself": (b"]q\0h\0a", "holds neither net_list nor weights of a TactileSGNet, but list"),
    "other storages": (b"ctorch\nComplexFloatStorage\n", "calls torch.ComplexFloatStorage"),
}


@pytest.mark.parametrize("name", MADE_UP)
def test_made_up_pickles(tmp_path, name):
    pickled, words = MADE_UP[name]
    if pickled.startswith(TENSOR[:9]):
        pickled = b"}X\x0b\0\0\0conv1.fc1.w%bs" % pickled
    assert words in refusal(write(tmp_path / "x.t7", torch_zip(pickled)))


def test_a_pickle_has_an_end(tmp_path, monkeypatch):
    monkeypatch.setattr(torch_file, "MOST_INSTRUCTIONS", 50)
    assert "more than 50 instructions" in refusal(write(tmp_path / "x.t7", torch_bytes(tensors())))


@pytest.mark.parametrize("content", [own(), torch_bytes(tensors())], ids=["own", "released"])
def test_checkpoints_are_read_without_torch(tmp_path, content):
    write(tmp_path / "x.pt", content)
    program = (
        "import sys; from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint; "
        f"assert read_checkpoint({str(tmp_path / 'x.pt')!r}).classes == {CLASSES}; assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True, cwd=Path(__file__).parents[1])


def test_own_format_needs_no_pickle(tmp_path):
    write(tmp_path / "x.pt", own())
    with zipfile.ZipFile(tmp_path / "x.pt") as archive:
        manifest = json.loads(archive.read("manifest.json"))
        array = np.lib.format.read_array(io.BytesIO(archive.read("best/fc2.bias.npy")), allow_pickle=False)
    assert manifest["weights"] == ["last", "best"]
    assert_array_equal(array, weights(2)["fc2.bias"])


def test_more_than_nine_dense_stages(tmp_path):
    deep = weights()
    for i in range(3, 12):
        deep |= {f"fc{i}.weight": np.ones((3, 3), np.float32), f"fc{i}.bias": np.full(3, i, np.float32)}
    read = read_checkpoint(write(tmp_path / "x.pt", own(weights={"last": deep})))
    assert [dense.name for dense in read.dense] == [f"fc{i}" for i in range(1, 12)]


def member(content: bytes):
    """A change that puts other bytes in the place of an array."""
    return lambda _, members: members.update({"last/fc1.bias.npy": content})


ONES = npy_bytes(np.ones(5, np.float32))
LARGE = ONES.replace(b"(5,), }" + b" " * 11, b"(100000000000,), }")
ALTERED = "its content does not match its hash, so it was altered"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        *[
            (
                lambda m, _, version=version: m.update(version=version),
                f"has format version {version!r}, this program",
            )
            for version in (7, 0, None, "1\n")
        ],
        (lambda m, _: m.update(beta=0.3), ALTERED),
        (member(npy_bytes(np.zeros(5, np.float32))), ALTERED),
        (lambda _, members: members.pop("best/fc1.bias.npy"), ALTERED),
        (lambda _, members: members.update({"last/more.npy": ONES}), ALTERED),
        (member(ONES.replace(b"(5,), }", b"(9**9,)")), DAMAGED),
        (member(ONES.replace(b"(5,), } ", b"(1<<60,)")), DAMAGED),
        (member(LARGE), "holds an array"),  # announces 400 GB
        (member(b"no npy"), DAMAGED),
    ],
)
def test_altered_files(tmp_path, change, words):
    assert len(LARGE) == len(ONES)
    assert refusal(write(tmp_path / "x.pt", rebuilt(own(), change, sign=False))).startswith(words)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m, _: m.pop("taxels"), "the manifest has no usable taxels"),
        (lambda m, _: m.update(beta=1.5), "beta 1.5: allowed are 0 <= beta < 1"),
        (
            lambda m, _: m.update(graph={"name": "x", "edges": [[0, 6]]}),
            "the graph joins taxels outside 0..5",
        ),
        (lambda m, _: m.update(classes=4), "made for 6 taxels and 3 classes, the manifest says 6 taxels"),
        (
            lambda _, members: members.update(
                {"last/fc2.bias.npy": npy_bytes(np.array([1, np.nan, 2], np.float32))}
            ),
            "fc2.bias has 1 of 3 values NaN or infinite",
        ),
        (lambda _, members: members.pop("last/conv1.hops.npy"), "conv1.hops is missing"),
    ],
)
def test_signed_but_wrong(tmp_path, change, words):
    assert words in refusal(write(tmp_path / "x.pt", rebuilt(own(), change)))
