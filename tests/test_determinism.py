"""The same bytes whatever the process: threads, order of hashes, locale, time zone, docstrings and assertions."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from made_files import events, recordings_folder

COMMANDS = (
    "train --system mlp --data data --taxels 6 --features 2 --hidden 8 --epochs 2 -o net.pt",
    "compile net.pt --calibrate data -o net.loom",
    "train --system counters --data data --parts 2 --weight-bits 4 -o counters.pt",
    "compile counters.pt --target truenorth -o counters.loom",
    "finetune net.pt --data data --weight-bits 4 --epochs 1 -o tuned.pt",
    "export net.loom --to onnx -o net.onnx",
    "report net.loom --checkpoint net.pt --data data -o net.html",
    "certify net.loom --data data --limit 2 --jobs 1 --certificate certificate -o certify.json",
)

PROCESSES = {
    "one thread": {
        "OMP_NUM_THREADS": "1",
        "NUMBA_NUM_THREADS": "1",
        "PYTHONHASHSEED": "0",
        "LC_ALL": "C",
        "TZ": "UTC",
    },
    "two threads": {
        "OMP_NUM_THREADS": "2",
        "NUMBA_NUM_THREADS": "2",
        "PYTHONHASHSEED": "4242",
        "LC_ALL": "C.UTF-8",
        "TZ": "Pacific/Kiritimati",
        "PYTHONOPTIMIZE": "2",
    },
    "a decimal comma": {"PYTHONHASHSEED": "7", "LC_ALL": "de_DE.UTF-8", "TZ": "America/St_Johns"},
}
"""Environments; a locale that is not installed is that of C."""

ALL = """
import locale, sys
try:
    locale.setlocale(locale.LC_ALL, "")
except locale.Error:
    pass
from spikeloom.runtime.cli import main
for line in sys.stdin:
    if main(line.split()):
        sys.exit(line)
"""


def written(
    folder: Path, environment: dict[str, str], commands: tuple[str, ...] = COMMANDS
) -> dict[str, bytes]:
    """Files that all commands write in a process of this environment."""
    folder.mkdir()
    recordings_folder(folder / "data", train=events(1, samples=12), test=events(2, samples=6))
    done = subprocess.run(
        [sys.executable, "-c", ALL],
        cwd=folder,
        env={name: value for name, value in os.environ.items() if not name.startswith(("LC_", "LANG"))}
        | {"PYTHONPATH": os.pathsep.join(sys.path)}
        | environment,
        input="\n".join(commands),
        text=True,
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-500:]
    return {file.name: file.read_bytes() for file in sorted(folder.iterdir()) if file.is_file()}


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    return written(tmp_path_factory.mktemp("determinism") / "x", PROCESSES["one thread"])


@pytest.mark.parametrize("process", [name for name in PROCESSES if name != "one thread"])
def test_files_are_the_same_in_every_process(process, expected, tmp_path):
    found = written(tmp_path / "x", PROCESSES[process])
    assert {"net.pt", "net.loom", "counters.loom", "tuned.pt", "net.onnx", "net.html", "certificate"} <= set(
        found
    )
    assert [name for name in expected if found.get(name) != expected[name]] == []


def test_large_products_are_the_same_on_one_thread_and_on_two(tmp_path):
    command = "finetune pretrained:objects --weight-bits 4 --epochs 1 --data synthetic -o net.pt"
    one, two = (
        written(tmp_path / name, PROCESSES[name], (command,)) for name in ("one thread", "two threads")
    )
    assert one["net.pt"] == two["net.pt"]
