"""Fixtures that find the real recordings and the released checkpoint, or skip with a reason.

The recordings may not be redistributed. Point SPIKELOOM_SHARED at a folder that holds ``data/`` and
``checkpoints/``; without it the folder ``shared`` beside the checkout is tried.
"""

import os
from collections.abc import Callable
from pathlib import Path

import commands
import pytest
import torch
from hypothesis import HealthCheck, settings
from made_files import own_file, recordings_folder

from spikeloom.models.recordings.counts import show_counts
from spikeloom.runtime import cli

SLOW = (HealthCheck.too_slow, HealthCheck.filter_too_much, HealthCheck.function_scoped_fixture)
settings.register_profile("ours", deadline=None, max_examples=25, suppress_health_check=SLOW)
settings.load_profile("ours")
SHARED = Path(os.environ.get("SPIKELOOM_SHARED", Path(__file__).resolve().parents[2] / "shared"))


def _shared(relative: str) -> Path:
    path = SHARED / relative
    if not path.exists():
        if os.environ.get("SPIKELOOM_REQUIRE_RECORDINGS"):
            pytest.fail(
                f"the released file {relative} is missing, and SPIKELOOM_REQUIRE_RECORDINGS forbids to skip"
            )
        pytest.skip(f"the released file {relative} is not on this machine (set SPIKELOOM_SHARED)")
    return path


def _released(relative: str) -> Callable[[], Path]:
    """A fixture that finds a released file."""
    return pytest.fixture(lambda: _shared(relative), scope="session")


objects_zip = _released("data/Ev-Objects.zip")
containers_zip = _released("data/Ev-Containers.zip")
released_checkpoint = _released("checkpoints/objects_manual.t7")  # trained on Objects with the manual graph
checkpoints = _released("checkpoints")
braille_net = _released("data/silicon/braille_rec_th1_6.net")  # it ran on a Loihi
power_logs = _released("data/silicon/loihi-power-logs.zip")


def pytest_configure(config: pytest.Config) -> None:
    """Let libraries start one thread where each worker has a core: those of all would wait for each other."""
    if hasattr(config, "workerinput"):
        os.environ.setdefault("OMP_NUM_THREADS", "1")
        torch.set_num_threads(int(os.environ["OMP_NUM_THREADS"]))


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that writes golden texts anew."""
    parser.addoption(
        "--update-golden", action="store_true", help="write tests/golden anew instead of comparing"
    )


@pytest.fixture
def golden(request: pytest.FixtureRequest) -> Callable[[str, str], None]:
    """Compare a text with the file of that name in ``tests/golden``; ``--update-golden`` writes it."""

    def compare(name: str, text: str) -> None:
        path = Path(__file__).parent / "golden" / name
        if request.config.getoption("--update-golden"):
            path.parent.mkdir(exist_ok=True)
            path.write_text(text, encoding="utf-8")
        assert text == path.read_text(encoding="utf-8"), f"{path} differs; --update-golden writes it anew"

    return compare


@pytest.fixture(autouse=True)
def _counts_are_said_anew() -> None:
    show_counts.cache_clear()


@pytest.fixture
def write(tmp_path) -> Callable[[str, str], Path]:
    """Write a file of text, as it is, under a name."""

    def write(name: str, text: str) -> Path:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, newline="")
        return path

    return write


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """A folder with recordings, a checkpoint and its netlist; a test file that needs another has its own."""
    folder = tmp_path_factory.mktemp("place")
    recordings_folder(folder / "data")
    own_file(folder / "net.pt")
    words = ["compile", f"{folder}/net.pt", "--weight-bits", "8", "--calibrate", f"{folder}/data", "--json"]
    assert cli.main([*words, "-o", f"{folder}/net.loom"]) == 0
    return folder


@pytest.fixture
def spikeloom(place, monkeypatch) -> Callable[..., tuple[int, str, str]]:
    """Run a command in the folder `place`; gives exit code, standard output and standard error."""
    monkeypatch.chdir(place)
    return commands.run


@pytest.fixture
def as_json(spikeloom) -> Callable[..., object]:
    """Run a command there that must succeed with ``--json``; gives the object."""
    return commands.as_json


@pytest.fixture
def refusal(spikeloom) -> Callable[..., str]:
    """Run a command there that must fail; gives its one line."""
    return commands.refusal
