"""The wheel holds everything: it installs without links, and runs without the checkout."""

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("compiler", "models", "runtime")
ALONE = ("test_checkpoint.py", "test_cost.py", "test_data_commands.py", "test_doctor.py", "test_report.py")
"""Tests that need no repository."""


def done(*words, **options):
    ran = subprocess.run(list(map(str, words)), capture_output=True, text=True, check=False, **options)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return ran.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """Built from a tree without links, as git leaves one on Windows, and without what earlier builds left."""
    tree = tmp_path_factory.mktemp("tree")
    for room in ROOMS:
        shutil.copytree(ROOT / room, tree / room, ignore=shutil.ignore_patterns("__pycache__"))
    (tree / "src" / "spikeloom").mkdir(parents=True)
    for file in (ROOT / "src" / "spikeloom").glob("*.py"):
        shutil.copy(file, tree / "src" / "spikeloom")
    for name in ("pyproject.toml", "setup.py", "README.md"):
        shutil.copy(ROOT / name, tree)
    done(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", tree / "dist", tree)
    (file,) = (tree / "dist").iterdir()
    return file


@pytest.fixture(scope="module")
def python(wheel, tmp_path_factory) -> Path:
    """Python of a fresh environment with the wheel, and with what it depends on from this environment."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder)
    paths = {"base": str(folder), "platbase": str(folder)}
    site = Path(sysconfig.get_path("purelib", "venv", paths))
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib"), "utf-8")
    binary = Path(sysconfig.get_path("scripts", "venv", paths)) / Path(sys.executable).name
    done(sys.executable, "-m", "pip", "--python", binary, "install", "--quiet", "--no-deps", wheel)
    return binary


@pytest.fixture
def environment(tmp_path):
    """Variables without a way back to the checkout."""
    known = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    return {"env": known, "cwd": tmp_path}


@pytest.mark.slow
def test_every_file_is_in_the_wheel(wheel):
    tracked = [file for room in ROOMS for file in (ROOT / room).rglob("*") if file.is_file()]
    wanted = {f"spikeloom/{f.relative_to(ROOT).as_posix()}" for f in tracked if "__pycache__" not in f.parts}
    wanted |= {"spikeloom/__init__.py", "spikeloom/__main__.py"}
    names = zipfile.ZipFile(wheel).namelist()
    assert {name for name in names if ".dist-info/" not in name} == wanted


@pytest.mark.slow
def test_the_demo_runs_without_the_checkout(python, environment):
    where = done(python, "-c", "import spikeloom.models; print(spikeloom.models.__file__)", **environment)
    assert Path(where.strip()).is_relative_to(python.parents[1])
    assert "verdict: " in done(python.with_name("spikeloom"), "demo", **environment)
    assert "nothing is wrong" in done(python.with_name("spikeloom"), "doctor", **environment)


@pytest.mark.slow
def test_tests_that_need_no_repository_pass(python, environment, tmp_path):
    shutil.copytree(ROOT / "tests", tmp_path / "tests", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    files = [tmp_path / "tests" / name for name in ALONE]
    said = done(python, "-m", "pytest", "-q", "-o", "pythonpath=", *files, **environment)
    assert " passed" in said
