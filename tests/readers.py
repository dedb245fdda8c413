"""Every reader of a file that a user may name, good files for each, and damage of every kind; in the working folder.

`READERS` is the table; :func:`outcome` reads a damaged file. Bytes are damaged, and values: a file is taken apart, its
values are changed, and it is put together again with fitting checksums.
"""

import base64
import copy
import io
import json
import os
import random
import re
import sqlite3
import tomllib
import zipfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import commands
import made_files
import made_netx
import numpy as np
import torch
import typed
from google.protobuf import json_format
from made_chart import made_figures
from made_files import torch_bytes
from made_modules import NETS, example_of, one_step
from made_onnx import two_layers
from onnx import ModelProto, defs
from random_networks import LOIHI
from zoo import specimen

from spikeloom.compiler import archive, invariants
from spikeloom.compiler.errors import CapacityError, SpikeloomError
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.formats.counters import read_network
from spikeloom.compiler.formats.hdf5 import hdf5_bytes, tree_of
from spikeloom.compiler.formats.netx.reader import read_netx
from spikeloom.compiler.formats.nir.reader import read_nir
from spikeloom.compiler.formats.onnx.reader import read_onnx
from spikeloom.compiler.formats.own_checkpoint import content_digest
from spikeloom.compiler.ir import Network
from spikeloom.compiler.targets.base import with_tables
from spikeloom.compiler.targets.loihi1 import integers
from spikeloom.compiler.targets.truenorth.native_file import read_trained
from spikeloom.models.graphs import normalised_adjacency
from spikeloom.models.networks.networks import Architecture
from spikeloom.models.recordings.events import load_data
from spikeloom.models.sensors import read_edges, read_taxels
from spikeloom.models.training.resume import SEAL_BYTES
from spikeloom.models.training.train import train
from spikeloom.runtime.machines.backends import machine_for
from spikeloom.runtime.report.encode import encode
from spikeloom.runtime.report.sections import terminal
from spikeloom.runtime.studies.chart.work import Built
from spikeloom.runtime.studies.jobs import Job, sealed, sweep
from spikeloom.runtime.studies.robustness.stress_sections import overview, read_stress

MOST_SAID, MOST_SECONDS = 300, 5.0


@dataclass(frozen=True)
class Reader:
    """A reader: good contents, and what reads a file and uses what is in it.

    apart, together: from a content to values (dicts, lists, arrays, bytes, words, numbers) and back.
    words: what a string may become.
    sealed: checksums cover the content: what is read of damaged bytes are the values of the whole file.
    share: of the inputs of a cheap reader.
    """

    suffix: str
    good: Callable[[], Sequence[bytes]]
    read: Callable[[Path], Any]
    apart: Callable[[bytes], Any]
    together: Callable[[Any], bytes]
    words: tuple[str, ...] = ()
    sealed: bool = False
    share: float = 1.0


# -- good files --------------------------------------------------------------------------------------------------------
def written(write: Callable[[Path], Any]) -> bytes:
    """Content of the file that is written."""
    path = Path(f"written{os.getpid()}")
    write(path)
    content = path.read_bytes()
    path.unlink()
    return content


def of_zoo(name: str, file: str = "network") -> Callable[[], list[bytes]]:
    """A file of a network of the zoo."""
    return lambda: [getattr(specimen(name), file).read_bytes()]


def small_weights(seed: int = 0) -> dict[str, np.ndarray]:
    return made_files.weights(seed, features=2, hops=2, sizes=(3, 3, 2))


def unpickled(content: bytes) -> Any:
    return torch.load(io.BytesIO(content))


def torch_files(new: bool) -> list[bytes]:
    states = [made_files.state_dict(small_weights(seed), old=not new) for seed in (0, 1)]
    return [torch_bytes(made_files.released(*states), new=new), torch_bytes(states[0], new=new)]


def own() -> list[bytes]:
    sets = {"last": small_weights(), "best": small_weights(1)}
    return [made_files.checkpoint_bytes(sets, RING, beta=0.2, theta=0.5, training={})]


def npy() -> list[bytes]:
    return [archive.npy_bytes(made_files.events(samples=1)[0])]


def recording_zip() -> list[bytes]:
    names = [f"x/{split}/sample_{i}_label_{i}.npy" for split in ("test", "train") for i in (0, 1)]
    made = made_files.events(samples=4, steps=6).astype(np.float32)
    members = {name: archive.npy_bytes(one) for name, one in zip(names, made, strict=True)}
    members["x/bins.npy"] = archive.npy_bytes(np.array([0.02]))
    return [archive.zip_bytes(members), made_files.zipped(members, zipfile.ZIP_DEFLATED)]


def npz() -> list[bytes]:
    events = {
        "time_s": np.array([0.0, 0.02, 0.1]),
        "taxel": np.array([0, 2, 1]),
        "polarity": np.array([1, 0, 1]),
    }
    return [archive.zip_bytes({f"{name}.npy": archive.npy_bytes(array) for name, array in events.items()})]


def nir_files() -> list[bytes]:
    return [path.read_bytes() for path in sorted((Path(__file__).parent / "nir").glob("*.ni[r]"))]


def netx_files() -> list[bytes]:
    rng, file = np.random.default_rng(0), io.BytesIO()

    def even(*shape, **more):
        return made_netx.dense(
            made_netx.even(rng, *shape), bias=made_netx.even(rng, shape[0], most=16), **more
        )

    kernel = made_netx.even(rng, 3, 2, 2, 2, most=18)
    recurrent = even(6, 27, type=["dense_rec"], weight_rec=rng.integers(-60, 60, (6, 6)))
    image = (
        made_netx.given_input(2, 4, 4),
        made_netx.conv(kernel, (3, 3, 3), bias=[2, 4, 6]),
        made_netx.flatten(27),
    )
    made_netx.write(file, *image, recurrent, even(4, 6))
    return [file.getvalue()]


def onnx() -> list[bytes]:
    made = [two_layers(spelling) for spelling in ("product", "where", "truth", "after")]
    return [*made, *(one_step(NETS[name](), example_of(name)) for name in ("mlp", "tag", "grid", "gcn"))]


NET = Architecture(taxels=made_files.TAXELS, classes=2, hops=1, features=2, hidden=(3, 3))
RING = made_files.ring()
DATA = made_files.recorded(made_files.events(samples=2, steps=4))


def tables() -> list[bytes]:
    entry = ' = { value = 80.0, unit = "pJ", source = "board 7" }\n'
    return [f'[energy.mine]\ntitle = "Ours"\nneuron_active{entry}packet{entry}'.encode()]


def priced(path: Path) -> None:
    with_tables(LOIHI, str(path))


def lines(content: bytes) -> list[str]:
    return content.decode().split("\n")


def trains(path: Path, *, resume: bool = True) -> Any:
    """Train two epochs, or find them done."""
    propagation = normalised_adjacency(RING.edges, made_files.TAXELS)
    return train(DATA, DATA, propagation, NET, epochs=2, keep_epoch=1, state=path, resume=resume).last


def states() -> list[bytes]:
    return [written(partial(trains, resume=False))]


def stress_file() -> list[bytes]:
    made_files.recordings_folder(Path("data"))
    made_files.own_file(Path("net.pt"))
    commands.run("compile", "net.pt", "-o", "net.loom")
    words = [
        "net.loom",
        "--checkpoint",
        "net.pt",
        "--data",
        "data",
        "--only",
        "taxels_dead,longer",
        "--seeds",
        "1",
    ]
    code, _, err = commands.run("stress", *words, "-o", "stress.json")
    assert code == 0, err
    return [Path("stress.json").read_bytes()]


def stress(path: Path) -> str:
    found = json.loads(Path("stress.json").read_text())["provenance"]["netlist_sha256"]
    return terminal(overview(read_stress(str(path), "net.loom", found)))


FIGURES = encode(made_figures(9, 10, 1.0, 1.0))
KEPT = {
    "a": {"cores": {"sha256": "00", "cores": 1, "figures": {"100": {"train": FIGURES, "test": FIGURES}}}},
    "b": {"latency": {"refused": ["too large"]}},
}


def store(content: Any) -> bytes:
    def write(path: Path) -> None:
        with closing(sqlite3.connect(path)) as database, database:
            database.execute("CREATE TABLE results (key TEXT PRIMARY KEY, result TEXT)")
            rows = [(key, sealed(key, json.dumps(value))) for key, value in content.items()]
            database.executemany("INSERT INTO results VALUES (?, ?)", rows)

    return written(write)


def rows_of(content: bytes) -> dict[str, Any]:
    path = Path("rows.sqlite")
    path.write_bytes(content)
    with closing(sqlite3.connect(path)) as database:
        rows = database.execute("SELECT key, result FROM results").fetchall()
    return {key: json.loads(text.partition(" ")[2]) for key, text in rows}


# -- taken apart and put together --------------------------------------------------------------------------------------
def parts_of_archive(content: bytes) -> dict[str, Any]:
    members = {name: archive.read_npy(data) for name, data in archive.stored_members(content).items()}
    members = {name.removesuffix(".npy"): array for name, array in members.items()}
    return members | {"manifest": json.loads(str(members["manifest"])), "sha256": None}


def archive_of(parts: dict[str, Any]) -> bytes:
    arrays = {name: np.asarray(value) for name, value in parts.items() if name not in ("manifest", "sha256")}
    return archive.archive_bytes(
        parts["manifest"], {name: a for name, a in arrays.items() if a.dtype.kind in "biuf"}
    )


def parts_of_zip(content: bytes) -> dict[str, Any]:
    with zipfile.ZipFile(io.BytesIO(content)) as file:
        return {
            name: np.load(io.BytesIO(file.read(name))) for name in file.namelist() if name.endswith(".npy")
        }


def zip_of(parts: dict[str, Any]) -> bytes:
    return archive.zip_bytes({name: archive.npy_bytes(np.asarray(value)) for name, value in parts.items()})


def parts_of_checkpoint(content: bytes) -> dict[str, Any]:
    return parts_of_zip(content) | {"manifest": json.loads(archive.stored_members(content)["manifest.json"])}


def checkpoint_of(parts: dict[str, Any]) -> bytes:
    manifest = parts["manifest"]
    arrays = {name.removesuffix(".npy"): np.asarray(a) for name, a in parts.items() if name != "manifest"}
    if isinstance(manifest, dict):
        manifest["sha256"] = content_digest(manifest, arrays)
    members: dict[str, bytes | str] = {"manifest.json": json.dumps(manifest)}
    return archive.zip_bytes(members | {f"{name}.npy": archive.npy_bytes(a) for name, a in arrays.items()})


def hdf5_of(parts: Any) -> bytes:
    if isinstance(parts, dict):
        parts = {key: parts[key] for key in parts if key and parts[key] is not None}
    return hdf5_bytes(parts)


def message(content: bytes) -> dict[str, Any]:
    return json_format.MessageToDict(ModelProto.FromString(content), preserving_proto_field_name=True)


def message_of(parts: Any) -> bytes:
    return json_format.ParseDict(parts, ModelProto()).SerializeToString()


def npy_of(parts: dict[str, Any]) -> bytes:
    return archive.npy_bytes(np.asarray(parts["x"]))


def json_of(parts: Any) -> bytes:
    return json.dumps(parts).encode()


def cells(content: bytes) -> list[list[str]]:
    return [line.split(",") for line in content.decode().split("\n")]


def lines_of(parts: list[Any]) -> bytes:
    return "\n".join(
        ",".join(map(str, line)) if isinstance(line, list) else str(line) for line in parts
    ).encode()


def toml(content: bytes) -> dict[str, Any]:
    return tomllib.loads(content.decode())


def given(
    suffix: str,
    good: Callable[[], Sequence[bytes]],
    lines: str,
    beside: str,
    apart: Callable[[bytes], Any],
    together: Callable[[Any], bytes],
    words: tuple[str, ...] = (),
    *,
    share: float = 0.1,
    place: str | None = None,
) -> Reader:
    """Commands that are given a file beside those of a network of the zoo."""
    return Reader(suffix, good, typed.through(lines, beside, place), apart, together, words, share=share)


# -- readers -----------------------------------------------------------------------------------------------------------
def runs(path: Path) -> Any:
    """Read a netlist, measure its limits, run it and read it back as a network."""
    machine = machine_for(path)
    machine.legal()
    events = np.ones((1, machine.netlist.taxels, machine.netlist.polarities, 3), np.uint8)
    votes = machine.run(events).votes
    return votes.tolist(), machine.integer if hasattr(type(machine), "integer") else None


def checkpoint(path: Path) -> bytes:
    found = read_checkpoint(path)
    return b"".join(
        each.tobytes() for each in (found.hops, found.conv_bias, *(one.weight for one in found.dense))
    )


def recordings(path: Path) -> bytes:
    return load_data(path).events.tobytes()


def values(read: Callable[[Path], Any], path: Path) -> str:
    """What is read, without the hash of the file."""
    found = read(path)
    return repr([(name, getattr(found, name)) for name in found.__slots__ if name != "sha256"])


def network(read: Callable[[Path], Any], path: Path) -> str:
    """Read a network whose rules hold and whose facts are lines."""
    found = read(path)
    rules = invariants if isinstance(found.network, Network) else integers
    rules.verify(found.network)
    assert all(fact.isprintable() for fact in found.facts)
    return repr(found.facts)


def kept(path: Path) -> str:
    """What a chart's store holds."""
    points = [Job(key=key, label=key) for key in KEPT]
    return repr(sweep(points, lambda job: KEPT[job.key], path, jobs=1, label="x", kind=Mapping[str, Built]))


NIR_WORDS = (
    "Affine",
    "AvgPool2d",
    "Conv1d",
    "Conv2d",
    "CubaLIF",
    "Delay",
    "Flatten",
    "I",
    "IF",
    "Input",
    "LI",
    "LIF",
)
NIR_WORDS += (
    "Linear",
    "NIRGraph",
    "Output",
    "Scale",
    "SumPool2d",
    "Threshold",
    "a\nb",
    "\x1b[31m",
    "ä" * 200,
)
NETX_WORDS = ("conv", "dense", "dense_rec", "flatten", "input", "recurrent")
TOML_WORDS = ("[energy.x]", "[time.y]", "hops = 1", 'hop = { value = inf, unit = "pJ", source = "x" }')
TOML_WORDS += ("a.b = {}", "", "[")
CELLS = ("x", "label", "-1", "1e9", "nan", "", "#", "\x1b")
OPERATORS = tuple(sorted({schema.name for schema in defs.get_all_schemas()}))

signed = partial(Reader, apart=parts_of_archive, together=archive_of, sealed=True)
pickled = partial(Reader, read=checkpoint, apart=unpickled, words=("fc9.weight", "fc1"))
zipped = partial(
    Reader, apart=parts_of_zip, together=zip_of, words=("test/sample_5_label_2.npy", "../x"), sealed=True
)
table = partial(Reader, ".csv", apart=cells, together=lines_of, words=CELLS)
nir = partial(network, partial(read_nir, dt=1e-4, convention="exponential"))

READERS = {
    "netlist": signed(".loom", of_zoo("netx", "netlist"), runs, share=0.25),
    "netlist of crossbars": signed(".loom", of_zoo("counters-crossbars", "netlist"), runs, share=0.25),
    "network for crossbars": signed(".pt", of_zoo("native"), partial(values, read_trained)),
    "counting network": signed(".pt", of_zoo("counters"), partial(network, read_network)),
    "own checkpoint": Reader(".pt", own, checkpoint, parts_of_checkpoint, checkpoint_of, sealed=True),
    "released checkpoint": pickled(".pt", partial(torch_files, True), together=torch_bytes, sealed=True),
    "released checkpoint, older form": pickled(
        ".t7", partial(torch_files, False), together=partial(torch_bytes, new=False)
    ),
    "training state": Reader(
        ".state",
        states,
        trains,
        lambda content: unpickled(content[:-SEAL_BYTES]),
        torch_bytes,
        sealed=True,
        share=0.25,
    ),
    "ONNX": Reader(".onnx", onnx, partial(network, read_onnx), message, message_of, OPERATORS),
    "NIR": Reader(".nir", nir_files, nir, tree_of, hdf5_of, NIR_WORDS, share=0.25),
    "netx": Reader(
        ".net", netx_files, partial(network, read_netx), tree_of, hdf5_of, NETX_WORDS, share=0.25
    ),
    "recordings": zipped(".zip", recording_zip, recordings),
    "events": zipped(".npz", npz, recordings),
    "bins": Reader(".npy", npy, recordings, lambda data: {"x": archive.read_npy(data)}, npy_of),
    "event table": table(
        lambda: [b"time_s,taxel,polarity,label\n0,1,1,2\n0.5,0,0,2\n", b"0,1,1\n2,3,0"], recordings
    ),
    "taxel table": table(lambda: [b"x,y,z\n1,2,3\n4,5,6\n", b"1,2\n3,4"], read_taxels),
    "edge table": table(lambda: [b"source,target\n0,1\n1,2\n"], partial(read_edges, n=4)),
    "price tables": Reader(
        ".toml", tables, priced, lines, lambda parts: "\n".join(parts).encode(), TOML_WORDS
    ),
    "stress": Reader(".json", stress_file, stress, json.loads, json_of, share=0.1),
    "store of a chart": Reader(
        ".sqlite", lambda: [store(KEPT)], kept, rows_of, store, sealed=True, share=0.25
    ),
    # what commands make of it: signed again after each change
    "run: netlist": given(".loom", of_zoo("mlp", "netlist"), "netlist", "mlp", parts_of_archive, archive_of),
    "run: netlist of crossbars": given(
        ".loom", of_zoo("native", "netlist"), "netlist of crossbars", "native", parts_of_archive, archive_of
    ),
    "run: own checkpoint": given(
        ".pt", of_zoo("mlp"), "checkpoint", "mlp", parts_of_checkpoint, checkpoint_of
    ),
    "run: released checkpoint": given(
        ".pt", partial(torch_files, True), "released checkpoint", "mlp", unpickled, torch_bytes
    ),
    "run: counting network": given(
        ".pt", of_zoo("counters"), "counting network", "counters", parts_of_archive, archive_of
    ),
    "run: network for crossbars": given(
        ".pt", of_zoo("native"), "network for crossbars", "native", parts_of_archive, archive_of
    ),
    "run: ONNX": given(".onnx", of_zoo("onnx"), "ONNX", "onnx", message, message_of, OPERATORS),
    "run: NIR": given(
        ".nir", of_zoo("recurrent"), "NIR", "recurrent", tree_of, hdf5_of, NIR_WORDS, share=0.04
    ),
    "run: netx": given(".net", of_zoo("netx"), "netx", "netx", tree_of, hdf5_of, NETX_WORDS, share=0.04),
    "run: recordings": given(".zip", typed.recordings, "recordings", "mlp", parts_of_zip, zip_of),
    "run: events": given(".npz", typed.events, "recordings", "mlp", parts_of_zip, zip_of),
    "run: recordings of both splits": given(
        ".zip", typed.recordings, "recordings of both splits", "mlp", parts_of_zip, zip_of
    ),
    "run: options": given(".toml", typed.options, "options", "mlp", toml, typed.toml_of, share=0.04),
    "run: certificate": Reader(
        "", typed.certificate, typed.checked, parts_of_archive, archive_of, share=0.1
    ),
    "run: stress": given(".json", typed.stress, "stress", "mlp", json.loads, json_of, share=0.02),
    "run: store of smallest": given(
        ".sqlite", typed.smallest, "store of smallest", "mlp", rows_of, store, share=0.005
    ),
    "run: store of a chart": given(
        ".sqlite", typed.chart, "store of a chart", "mlp", rows_of, store, share=0.01, place="points.sqlite"
    ),
}


@cache
def goods(name: str) -> tuple[bytes, ...]:
    """Good contents for a reader."""
    return tuple(READERS[name].good())


@cache
def apart(name: str, index: int) -> Any:
    """One of them, taken apart."""
    return READERS[name].apart(goods(name)[index])


# -- damage ------------------------------------------------------------------------------------------------------------
NUMBERS = (
    -(2**63),
    -(2**31),
    -100,
    -2,
    -1,
    0,
    1,
    2,
    3,
    4,
    7,
    100,
    2**20,
    2**31,
    2**40,
    2**62,
    2**63 - 1,
    10**30,
)
REALS = (1e-300, 1e300, float("nan"), float("inf"), 0.5, -0.5, 1.0)


def changed_bytes(content: bytes, rng: random.Random) -> bytes:
    """A few bytes cut, changed, doubled or moved."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 5))):
        place = rng.randrange(len(data)) if data else 0
        length = rng.choice((1, 1, 2, 8, 100))
        match rng.randrange(10):
            case 0:
                del data[place:]
            case 9 if sizes := list(re.finditer(rb"[0-9]+", data[:20_000])):
                declared = rng.choice(sizes)
                huge = str(rng.choice(NUMBERS[6:])).encode()
                data[slice(*declared.span())] = huge
            case 1:
                del data[place : place + length]
            case 2:
                data[place : place + length] = rng.randbytes(length)
            case 3:
                data[place:place] = data[place : place + length]
            case 4:
                data[place:place] = rng.randbytes(length)
            case _ if data:
                data[place] ^= 1 << rng.randrange(8)
    return bytes(data)


def places(value: Any) -> list[tuple[Any, Any]]:
    """Every container in a value, with each of its keys."""
    found = [(value, key) for key in (value if isinstance(value, dict) else range(len(value)))]
    for holder, key in found:
        inner = holder[key]
        if isinstance(inner, dict | list):
            found += [(inner, each) for each in (inner if isinstance(inner, dict) else range(len(inner)))]
    return found


def strange(old: Any, rng: random.Random, words: Sequence[str]) -> Any:
    """Something else in the place of a value."""
    if isinstance(old, torch.Tensor):
        return torch.tensor(np.asarray(strange(old.numpy(), rng, words), np.float32))
    if isinstance(old, np.ndarray):
        numbers = old.astype(np.float64 if old.dtype.kind == "f" or rng.random() < 0.2 else old.dtype)
        with np.errstate(all="ignore"):
            if numbers.size:
                one = rng.choice(REALS if numbers.dtype.kind == "f" and rng.random() < 0.5 else NUMBERS[:-1])
                numbers.flat[rng.randrange(numbers.size)] = np.array(one).astype(numbers.dtype)
        cut = old.ravel()[: rng.randrange(old.size + 1)]
        return rng.choice(
            [numbers, numbers, numbers, cut, old[None], old.T.copy(), np.zeros(0), numbers.astype("f4")]
        )
    if isinstance(old, bytes):
        return changed_bytes(old, rng)
    if isinstance(old, str) and rng.random() < 0.7:
        text = base64.b64encode(rng.randbytes(rng.choice((0, 4, 8)))).decode()
        return rng.choice(
            [*(words or ("", "a", "x" * 400)), text, "<img src=x onerror=alert(1)>", "7", "1e999"]
        )
    if isinstance(old, int | float) and rng.random() < 0.7:
        return rng.choice(NUMBERS if isinstance(old, int) else REALS)
    odd = [
        None,
        True,
        "",
        "a\nb\x1b[31m",
        "x" * 5000,
        [],
        {},
        [[1, "b"]],
        {"a": 1},
        [0] * 100_000,
        nested(200),
    ]
    return rng.choice([*odd, *NUMBERS, *REALS])


def nested(depth: int) -> list[Any]:
    """A list in a list, and so on."""
    inner: list[Any] = []
    for _ in range(depth):
        inner = [inner]
    return inner


def changed_values(value: Any, rng: random.Random, words: Sequence[str]) -> Any:
    """A few values removed, doubled, exchanged or replaced, wherever they are."""
    value = copy.deepcopy(value)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        if not (every := places(value)):
            break
        holder, key = rng.choice(every)
        other, place = rng.choice(every)
        match rng.randrange(6):
            case 0:
                del holder[key]
            case 1 if isinstance(holder, list):
                holder.insert(rng.randrange(len(holder) + 1), copy.deepcopy(holder[key]))
            case 1:
                holder[rng.choice(("x", "1", *map(str, holder), *words[:9]))] = copy.deepcopy(holder[key])
            case 2:
                holder[key] = copy.deepcopy(other[place])
            case _:
                holder[key] = strange(holder[key], rng, words)
    return value


def changed_member(content: bytes, rng: random.Random) -> bytes:
    """One member of a zip changed, and the sums of the zip made right again; or one that declares another size."""
    with zipfile.ZipFile(io.BytesIO(content)) as file:
        members: dict[str, bytes | str] = {name: file.read(name) for name in file.namelist()}
        central = file.start_dir
    if rng.random() < 0.2:
        data = bytearray(content)
        data[central + 20 : central + 28] = (
            rng.choice((0, 2**20, 2**31, 2**32 - 2)).to_bytes(4, "little") * 2
        )
        return bytes(data)
    name = rng.choice(list(members))
    return archive.zip_bytes(members | {name: changed_bytes(bytes(members[name]), rng)})


def damaged(name: str, seed: int) -> tuple[bytes, int | None]:
    """A damaged file for a seed; and if only bytes are, of which good one."""
    rng, reader = random.Random(f"{name} {seed}"), READERS[name]
    index = rng.randrange(len(goods(name)))
    content, only_bytes = goods(name)[index], rng.random() < 0.4
    if not only_bytes:
        try:
            content = reader.together(changed_values(apart(name, index), rng, reader.words))
        except Exception:  # values that the format cannot hold at all
            only_bytes = True
    if only_bytes and content[:2] == b"PK" and rng.random() < 0.5:
        return changed_member(content, rng), None
    if only_bytes or rng.random() < 0.1:
        content = rng.randbytes(rng.randrange(300)) if rng.random() < 0.02 else changed_bytes(content, rng)
    return content, index if only_bytes else None


@cache
def meant(name: str, index: int) -> Any:
    """What a good file says."""
    path = Path(f"good{READERS[name].suffix}")
    path.write_bytes(goods(name)[index])
    return READERS[name].read(path)


def outcome(name: str, content: bytes, whole: int | None, *, again: bool = True) -> str:
    """How reading a content ends: ``read``, ``refused``, or what went wrong; a kernel may compile once."""
    reader, path, begun = READERS[name], Path(f"x{READERS[name].suffix}"), sum(os.times()[:4])
    path.write_bytes(content)
    try:
        with np.errstate(all="ignore"):
            found = reader.read(path)
    except CapacityError:
        said = "refused"
    except SpikeloomError as error:
        text = str(error)
        good = path.name in text and len(text) <= MOST_SAID and text.isprintable()
        said = "refused" if good else f"said in {len(text)} letters: {text[:400]!r}"
    except Exception as error:
        said = f"{type(error).__name__}: {str(error)[:200]!r}"
    else:
        right = not reader.sealed or whole is None or repr(found) == repr(meant(name, whole))
        said = "read" if right else "read as something else"
    spent = sum(os.times()[:4]) - begun  # of processors, those of children too
    if spent > MOST_SECONDS and again:
        return outcome(name, content, whole, again=False)
    return said if spent < MOST_SECONDS else f"took {spent:.1f} s"
