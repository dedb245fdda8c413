"""Reading and writing checkpoints: every layout, and what each refusal says."""

import hashlib
import io
import json
import os
import pickle
import subprocess
import sys
import zipfile
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.formats.checkpoint import SIZE_LIMIT, read_checkpoint
from spikeloom.compiler.formats.checkpoint_file import content_digest
from spikeloom.models.graphs import Graph
from spikeloom.models.networks.checkpoint import checkpoint_bytes, save_checkpoint
from spikeloom.models.networks.networks import Architecture
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.training.protocols import Reported
from spikeloom.models.training.record import training_record
from spikeloom.models.training.train import Epoch, Trained

TAXELS, FEATURES, HOPS, SIZES, CLASSES = 6, 4, 3, (5, 7), 3
NOT_A_CHECKPOINT = "is not a checkpoint; give a file of spikeloom train or of the released layout"
DAMAGED = "is truncated or damaged"


def tensors(seed: int = 0) -> dict[str, torch.Tensor]:
    """State dict under the keys of current torch_geometric."""
    generator = torch.Generator().manual_seed(seed)
    state = {"conv1.bias": torch.rand(FEATURES, generator=generator)}
    state |= {f"conv1.lins.{k}.weight": torch.rand(FEATURES, 2, generator=generator) for k in range(HOPS + 1)}
    sizes = (TAXELS * FEATURES, *SIZES, CLASSES)
    for i, (inputs, outputs) in enumerate(pairwise(sizes), start=1):
        state[f"fc{i}.weight"] = torch.rand(outputs, inputs, generator=generator)
        state[f"fc{i}.bias"] = torch.rand(outputs, generator=generator)
    return state


def old_keys(state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """The same weights under the keys of old torch_geometric releases: hops side by side."""
    beside = torch.cat([state[f"conv1.lins.{k}.weight"] for k in range(HOPS + 1)], dim=1)
    dense = {key: value for key, value in state.items() if key.startswith("fc")}
    return {"conv1.lin.weight": beside, "conv1.lin.bias": state["conv1.bias"], **dense}


def released(*states: dict[str, torch.Tensor], **more: object) -> dict[str, object]:
    return {"net_list": list(states), **more}


def torch_bytes(content: object, *, new: bool = True) -> bytes:
    file = io.BytesIO()
    torch.save(content, file, _use_new_zipfile_serialization=new)
    return file.getvalue()


def write(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def refusal(path: Path, error: type[Exception] = ModelError, **options: object) -> str:
    """Message of the error, without the path that starts it; it is one line."""
    with pytest.raises(error) as caught:
        read_checkpoint(path, **options)
    message = str(caught.value)
    assert "\n" not in message
    return message.removeprefix(f"{path}: ")


def weights(scale: float = 1.0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    shapes = {
        "conv1.hops": (HOPS + 1, FEATURES, 2),
        "conv1.bias": (FEATURES,),
        "fc1.weight": (5, TAXELS * FEATURES),
        "fc1.bias": (5,),
        "fc2.weight": (CLASSES, 5),
        "fc2.bias": (CLASSES,),
    }
    return {name: np.float32(scale) * rng.random(shape, np.float32) for name, shape in shapes.items()}


def ring() -> Graph:
    edges = np.array([[i, (i + 1) % TAXELS] for i in range(TAXELS)] + [[0, 1]])
    return Graph(name="ring", coordinates=np.arange(TAXELS, dtype=float)[:, None], edges=edges)


def own(**changes: object) -> bytes:
    options = {"beta": 0.25, "theta": 0.75, "training": {"seed": 4}} | changes
    sets = options.pop("weights", {"last": weights(), "best": weights(2.0)})
    return checkpoint_bytes(sets, options.pop("graph", ring()), **options)


def rebuilt(content: bytes, change: object, *, sign: bool = True, compression: int = zipfile.ZIP_STORED) -> bytes:
    """Our own format with changed members; signed anew unless told otherwise."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    manifest = json.loads(members["manifest.json"])
    change(manifest, members)
    if sign:
        arrays = {n.removesuffix(".npy"): np.load(io.BytesIO(m)) for n, m in members.items() if n.endswith(".npy")}
        manifest["sha256"] = content_digest(manifest, arrays)
    members["manifest.json"] = json.dumps(manifest).encode()
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", compression) as archive:
        for name, member in members.items():
            archive.writestr(name, member)
    return file.getvalue()


def npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


# --- the released layout -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("new", [True, False], ids=["zip", "pre-1.6"])
@pytest.mark.parametrize("keys", [dict, old_keys], ids=["lins", "lin"])
def test_every_released_layout_gives_the_same_weights(tmp_path, keys, new):
    state = tensors()
    path = write(tmp_path / "x.t7", torch_bytes(keys(state), new=new))
    read = read_checkpoint(path)
    assert (read.layout, read.runs, read.training) == ("state_dict", 1, None)
    assert (read.taxels, read.classes, read.hops.shape) == (TAXELS, CLASSES, (HOPS + 1, FEATURES, 2))
    for k in range(HOPS + 1):
        np.testing.assert_array_equal(read.hops[k], state[f"conv1.lins.{k}.weight"])
    np.testing.assert_array_equal(read.conv_bias, state["conv1.bias"])
    assert [dense.name for dense in read.dense] == ["fc1", "fc2", "fc3"]
    for dense in read.dense:
        np.testing.assert_array_equal(dense.weight, state[f"{dense.name}.weight"])
        np.testing.assert_array_equal(dense.bias, state[f"{dense.name}.bias"])
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
    path = write(tmp_path / "x.t7", torch_bytes(released(tensors(0), tensors(1), **figures)))
    read = read_checkpoint(path, run=1)
    assert (read.layout, read.runs) == ("released", 2)
    np.testing.assert_array_equal(read.conv_bias, tensors(1)["conv1.bias"])
    assert read.training == {
        "runs": 2,
        "weights": "last epoch",
        "epochs": 2,
        "last_acc": 86.5,
        "best_acc": 91.25,
        "best_acc_note": "of the best epoch on the test split, not of these weights",
    }
    assert read_checkpoint(path).training["best_acc"] == 90.0
    assert "--run 2: the file holds runs 0 to 1" in refusal(path, run=2)
    assert "--run -1: the file holds runs 0 to 1" in refusal(path, run=-1)


def test_figures_that_are_not_as_the_released_script_wrote_them_are_left_out(tmp_path):
    odd = {"best_acc": torch.tensor([torch.nan]), "num_epochs": 5, "acc_list": [1.0]}
    path = write(tmp_path / "x.t7", torch_bytes(released(tensors(), **odd)))
    assert read_checkpoint(path).training == {"runs": 1, "weights": "last epoch", "epochs": 5}


def test_half_and_double_precision_become_float32(tmp_path):
    for kind in (torch.float64, torch.float16, torch.bfloat16):
        path = write(tmp_path / "x.t7", torch_bytes({key: value.to(kind) for key, value in tensors().items()}))
        expected = tensors()["fc2.weight"].to(kind).to(torch.float32)
        np.testing.assert_array_equal(read_checkpoint(path).dense[1].weight, expected)


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
    assert (read.training["epochs"], read.training["last_acc"], read.training["best_acc"]) == (100, 88.1944, 90.2778)


# --- refusals ------------------------------------------------------------------------------------------------------


def test_missing_file_and_folder(tmp_path):
    expected = "no such file"
    assert expected in refusal(tmp_path / "x.t7")
    assert expected in refusal(tmp_path)


@pytest.mark.parametrize(
    "content",
    [b"", b"spikeloom", np.random.default_rng(0).bytes(3000), b"\x80" + bytes(50), b"\x80\x02}q\x00."],
    ids=["empty", "text", "random", "half a pickle", "pickle of an empty dict"],
)
def test_other_files_are_no_checkpoints(tmp_path, content):
    assert refusal(write(tmp_path / "x.t7", content)) == NOT_A_CHECKPOINT


def test_other_zips_are_no_checkpoints(tmp_path):
    path = tmp_path / "x.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("test/sample_0_label_0.npy", b"")
    assert refusal(path) == NOT_A_CHECKPOINT
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("manifest.json", '{"format": "other", "files": []}')
    assert refusal(path) == NOT_A_CHECKPOINT


@pytest.mark.parametrize("share", [0.02, 0.5, 0.99])
@pytest.mark.parametrize("kind", ["torch zip", "torch pre-1.6", "own"])
def test_truncated_files(tmp_path, kind, share):
    whole = {
        "torch zip": torch_bytes(released(tensors())),
        "torch pre-1.6": torch_bytes(released(tensors()), new=False),
        "own": own(),
    }[kind]
    assert refusal(write(tmp_path / "x", whole[: int(share * len(whole))])).startswith(DAMAGED)


class _Command:
    def __reduce__(self):
        return os.system, ("touch harm",)


@pytest.mark.parametrize("form", ["zip", "pre-1.6", "plain pickle"])
def test_code_in_a_pickle_is_refused_and_not_run(tmp_path, monkeypatch, form):
    monkeypatch.chdir(tmp_path)
    content = released(tensors(), best_acc=_Command())
    data = pickle.dumps(_Command(), protocol=2) if form == "plain pickle" else torch_bytes(content, new=form == "zip")
    path = write(tmp_path / "x.t7", data)
    assert f"is a pickle that calls {os.system.__module__}.system, allowed are tensors" in refusal(path)
    assert not (tmp_path / "harm").exists()


def test_newer_pickle_protocols_are_refused(tmp_path):
    file = io.BytesIO()
    torch.save(tensors(), file, pickle_protocol=4)
    expected = "is pickled with protocol 4 or newer, which torch does not read"
    assert expected in refusal(write(tmp_path / "x.t7", file.getvalue()))
    assert expected in refusal(write(tmp_path / "x.t7", pickle.dumps(_Command(), protocol=4)))


def test_a_whole_module_is_refused(tmp_path):
    path = write(tmp_path / "x.t7", torch_bytes(torch.nn.Linear(1, 1)))
    assert "is a pickle that calls torch.nn.modules.linear.Linear, allowed" in refusal(path)


def test_other_tensors_are_no_network(tmp_path):
    start = "holds neither net_list nor weights of a TactileSGNet, but"
    path = write(tmp_path / "x.t7", torch_bytes({"epoch": 3, "model": tensors()}))
    assert f"{start} epoch, model" in refusal(path)
    assert f"{start} Tensor" in refusal(write(path, torch_bytes(torch.ones(3))))
    assert f"{start} nothing" in refusal(write(path, torch_bytes({})))
    assert f"{start} 'a\\nb'" in refusal(write(path, torch_bytes({"a\nb": 1})))
    expected = "net_list holds no run"
    assert expected in refusal(write(path, torch_bytes(released())))
    assert expected in refusal(write(path, torch_bytes({"net_list": 5})))


def test_every_fault_of_the_tensors_is_listed(tmp_path):
    state = tensors()
    del state["conv1.lins.1.weight"], state["fc2.bias"]
    state["fc3.weight"] = torch.ones(CLASSES, 8)
    state["fc1.bias"] = torch.ones(4)
    state["fc4.weight"] = torch.ones(2, CLASSES)
    state["fc1.weight"][2, :3] = torch.tensor([torch.nan, torch.inf, -torch.inf])
    assert "conv1.lins.1.weight is missing" in refusal(write(tmp_path / "x.t7", torch_bytes(released(state))))


def test_faults_of_old_keys(tmp_path):
    state = old_keys(tensors())
    state["conv1.lin.weight"] = torch.ones(FEATURES, 7)
    path = write(tmp_path / "x.t7", torch_bytes(state))
    assert "conv1.lin.weight has 7 columns, not a whole number of hops" in refusal(path)
    del state["conv1.lin.bias"]
    state["conv1.lin.weight"] = torch.ones(7)
    assert "conv1.lin.weight is (7,), wanted (features, hops * 2)" in refusal(write(path, torch_bytes(state)))


def test_without_a_convolution_both_its_tensors_are_missing(tmp_path):
    dense = {key: value for key, value in tensors().items() if key.startswith("fc")}
    assert "conv1.lins.0.weight is missing" in refusal(write(tmp_path / "x.t7", torch_bytes(dense)))


def test_taxels_must_be_whole(tmp_path):
    state = tensors() | {"fc1.weight": torch.ones(5, TAXELS * FEATURES + 1)}
    assert "fc1.weight has 25 inputs, not a whole number of taxels with 4" in refusal(
        write(tmp_path / "x.t7", torch_bytes(state))
    )


def test_entries_that_are_no_plain_numbers(tmp_path):
    state = tensors() | {
        "fc1.bias": 5,
        "fc2.bias": torch.ones(7, dtype=torch.int64),
        "fc3.bias": torch.ones(3).to_sparse(),
        "fc3.weight": torch.ones(1).expand(10**6, 10**6),
    }
    assert "fc1.bias is a int, wanted a tensor" in refusal(write(tmp_path / "x.t7", torch_bytes(state)))


def test_empty_tensors(tmp_path):
    state = tensors() | {"fc3.weight": torch.ones(0, 7), "fc3.bias": torch.ones(0)}
    assert "fc3.weight is (0, 7), wanted (outputs, 7)" in refusal(write(tmp_path / "x.t7", torch_bytes(state)))


def test_large_files_are_refused_unread(tmp_path):
    path = tmp_path / "x.t7"
    with path.open("wb") as file:
        file.truncate(SIZE_LIMIT + 1)
    assert "more than 268435456 bytes, the limit of a checkpoint" in refusal(path)


def test_zip_bombs_are_refused(tmp_path):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("x/data.pkl", bytes(10**7))
    path = write(tmp_path / "x.t7", file.getvalue())
    assert f"{path.stat().st_size} bytes claim to hold 10000000" in refusal(path)
    packed = rebuilt(own(), lambda manifest, _: manifest.update(note="a" * 9000), compression=zipfile.ZIP_DEFLATED)
    assert f"{len(packed)} bytes claim to hold" in refusal(write(path, packed))


def test_options_that_do_not_exist(tmp_path):
    path = write(tmp_path / "x.t7", torch_bytes(tensors()))
    with_path = {"error": OptionError}
    assert "--weights first: unknown" in refusal(path, weights="first", **with_path)
    for beta in (-0.1, 1.0, float("nan")):
        assert f"beta {beta:g}: allowed are 0 <= beta < 1" in refusal(path, beta=beta, **with_path)
    for theta in (0.0, float("inf")):
        assert f"theta {theta:g}: allowed are numbers above 0" in refusal(path, theta=theta, **with_path)


def test_a_state_dict_has_one_run_and_one_epoch(tmp_path):
    path = write(tmp_path / "x.t7", torch_bytes(tensors()))
    assert "--run 1: the file holds only run 0" in refusal(path, run=1)
    assert "--weights best: the file holds the last epoch only" in refusal(path, weights="best")


# --- our own format ------------------------------------------------------------------------------------------------


def test_own_format_round_trip(tmp_path):
    path = tmp_path / "x.pt"
    save_checkpoint(
        path, {"last": weights(), "best": weights(2.0)}, ring(), beta=0.25, theta=0.75, training={"seed": 4}
    )
    for which, scale in (("last", 1.0), ("best", 2.0)):
        read = read_checkpoint(path, weights=which)
        expected = weights(scale)
        np.testing.assert_array_equal(read.hops, expected["conv1.hops"])
        np.testing.assert_array_equal(read.conv_bias, expected["conv1.bias"])
        assert [dense.name for dense in read.dense] == ["fc1", "fc2"]
        for dense in read.dense:
            np.testing.assert_array_equal(dense.weight, expected[f"{dense.name}.weight"])
            np.testing.assert_array_equal(dense.bias, expected[f"{dense.name}.bias"])
    assert (read.beta, read.theta, read.assumed) == (0.25, 0.75, ())
    assert (read.layout, read.runs, read.graph, read.training) == ("spikeloom", 1, "ring", {"seed": 4})
    np.testing.assert_array_equal(read.edges, ring().edges)
    assert (read.taxels, read.classes) == (TAXELS, CLASSES)
    assert read.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert read_checkpoint(path, beta=0.5).beta == 0.5


def test_own_format_is_byte_deterministic():
    assert own() == own()
    assert own() != own(beta=0.3)


def test_own_format_needs_neither_torch_nor_pickle(tmp_path):
    write(tmp_path / "x.pt", own())
    program = (
        "import sys; from spikeloom.compiler.formats.checkpoint import read_checkpoint; "
        f"assert read_checkpoint({str(tmp_path / 'x.pt')!r}).classes == {CLASSES}; assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True, cwd=Path(__file__).parents[1])
    with zipfile.ZipFile(tmp_path / "x.pt") as archive:
        manifest = json.loads(archive.read("manifest.json"))
        array = np.lib.format.read_array(io.BytesIO(archive.read("best/fc2.bias.npy")), allow_pickle=False)
    assert manifest["weights"] == ["last", "best"]
    np.testing.assert_array_equal(array, weights(2.0)["fc2.bias"])


def test_more_than_nine_dense_stages(tmp_path):
    deep = weights()
    for i in range(3, 12):
        deep |= {f"fc{i}.weight": np.ones((3, 3), np.float32), f"fc{i}.bias": np.full(3, i, np.float32)}
    read = read_checkpoint(write(tmp_path / "x.pt", own(weights={"last": deep})))
    assert [dense.name for dense in read.dense] == [f"fc{i}" for i in range(1, 12)]


def test_requests_that_an_own_file_cannot_meet(tmp_path):
    path = write(tmp_path / "x.pt", own(weights={"last": weights()}))
    assert "--run 1: the file holds only run 0" in refusal(path, run=1)
    assert "--weights best: the file holds last" in refusal(path, weights="best")


@pytest.mark.parametrize("version", [7, 0, None, "1\n"])
def test_other_versions(tmp_path, version):
    content = rebuilt(own(), lambda manifest, _: manifest.update(version=version))
    assert f"has format version {version!r}, this program reads up to 6" in refusal(write(tmp_path / "x.pt", content))


ALTERED = "its content does not match its hash, so it was altered; copy or train it again"


@pytest.mark.parametrize(
    "change",
    [
        lambda manifest, _: manifest.update(beta=0.3),
        lambda manifest, _: manifest["graph"]["edges"].pop(),
        lambda manifest, _: manifest.pop("sha256"),
        lambda _, members: members.update({"last/fc1.bias.npy": npy(np.ones(5, np.float32))}),
        lambda _, members: members.pop("best/fc1.bias.npy"),
        lambda _, members: members.update({"last/more.npy": npy(np.ones(5, np.float32))}),
    ],
    ids=["constant", "graph", "no hash", "array", "array missing", "array added"],
)
def test_altered_files(tmp_path, change):
    assert refusal(write(tmp_path / "x.pt", rebuilt(own(), change, sign=False))) == ALTERED


def test_flipped_bits_are_found(tmp_path):
    content = bytearray(own())
    rng, found = np.random.default_rng(0), 0
    for position in rng.integers(len(content), size=200).tolist():
        content[position] ^= 1
        path = write(tmp_path / "x.pt", bytes(content))
        try:
            read = read_checkpoint(path)
        except ModelError:
            found += 1
        else:  # a date or another field of the zip that says nothing
            np.testing.assert_array_equal(read.hops, weights()["conv1.hops"])
            assert (read.beta, read.theta) == (0.25, 0.75)
        content[position] ^= 1
    assert found > 100


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda m, _: m.pop("taxels"), "has an incomplete manifest (KeyError('taxels'))"),
        (lambda m, _: m.update(beta=1.5), None),
        (lambda m, _: m.update(graph={"name": "x", "edges": [[0, 6]]}), "the graph joins taxels outside 0..5"),
        (
            lambda m, _: m.update(classes=4),
            "made for 6 taxels and 3 classes, the manifest says 6 taxels",
        ),
        (
            lambda _, members: members.update({"last/fc2.bias.npy": npy(np.array([1, np.nan, 2], np.float32))}),
            "fc2.bias has 1 of 3 values NaN or infinite",
        ),
        (lambda _, members: members.pop("last/conv1.hops.npy"), "conv1.hops is missing"),
    ],
)
def test_signed_but_wrong(tmp_path, change, expected):
    path = write(tmp_path / "x.pt", rebuilt(own(), change))
    if expected is None:
        assert "beta 1.5: allowed are 0 <= beta < 1" in refusal(path)
    else:
        assert expected in refusal(path)


@pytest.mark.parametrize(
    "member",
    [
        npy(np.ones(5)),
        npy(np.asfortranarray(np.ones((2, 3), np.float32))),
        npy(np.ones(5, np.float32))[:-4],
        npy(np.ones(5, np.float32)).replace(b"(5,), }", b"(9**9,)"),
        npy(np.ones(5, np.float32)).replace(b"(5,), } ", b"(1<<60,)"),
        b"no npy",
    ],
    ids=["float64", "fortran", "cut", "expression", "another", "other"],
)
def test_arrays_that_are_not_as_described(tmp_path, member):
    change = lambda _, members: members.update({"last/fc1.bias.npy": member})  # noqa: E731
    assert refusal(write(tmp_path / "x.pt", rebuilt(own(), change, sign=False))).startswith(DAMAGED)


def test_an_array_that_announces_more_than_it_has_takes_no_memory(tmp_path):
    plain = npy(np.ones(5, np.float32))
    member = plain.replace(b"(5,), }" + b" " * 11, b"(100000000000,), }")
    assert len(member) == len(plain)
    assert member != plain
    change = lambda _, members: members.update({"last/fc1.bias.npy": member})  # noqa: E731
    assert refusal(write(tmp_path / "x.pt", rebuilt(own(), change, sign=False))).startswith(DAMAGED)


def test_manifest_must_be_json(tmp_path):
    path = tmp_path / "x.pt"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("manifest.json", "{")
    assert refusal(path).startswith(DAMAGED)


def test_weights_that_are_not_finite_are_not_written_into_a_manifest():
    with pytest.raises(ValueError, match="Out of range float values are not JSON compliant"):
        own(training={"loss": float("nan")})


def test_an_interrupted_write_keeps_the_old_file(tmp_path):
    path = write(tmp_path / "x.pt", b"old")
    with pytest.raises(ValueError, match="JSON"):
        save_checkpoint(path, {"last": weights()}, ring(), beta=0.2, theta=0.5, training={"a": float("inf")})
    assert path.read_bytes() == b"old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["x.pt"]


def test_training_record_tells_how_to_repeat_it():
    def epoch(number: int, correct: int) -> Epoch:
        return Epoch(epoch=number, learning_rate=0.001, training_loss=0.5, test_loss=0.25, correct=correct, tested=4)

    trained = Trained(
        architecture=Architecture(taxels=TAXELS, classes=CLASSES),
        last=weights(),
        best=weights(),
        best_epoch=1,
        kept=weights(),
        history=(epoch(1, 3), epoch(2, 2)),
    )
    reported = Reported(trained=trained, validation=trained, clean_epoch=2)
    split = Recordings(
        events=np.zeros((1, TAXELS, 2, 5), np.uint8),
        labels=np.zeros(1, np.int64),
        files=("sample_0_label_0.npy",),
        split="train",
        source="x.zip",
    )
    record = training_record(reported, split, split, command="spikeloom train", seed=7).to_json()
    last = {"epoch": 2, "correct": 2, "accuracy": 0.5}
    assert record["last"] == last | {"chosen_on": "nothing"}
    assert record["best"] == {"epoch": 1, "correct": 3, "accuracy": 0.75, "chosen_on": "the test split"}
    assert record["clean"] == last | {"chosen_on": "a part of the training split"}
    assert record["validation"] == {"correct": 2, "samples": 4}
    assert (record["command"], record["seed"], record["epochs"]) == ("spikeloom train", 7, 2)
    assert json.loads(json.dumps(record, allow_nan=False)) == record
