"""Files are written whole or not at all, wherever an interrupt strikes."""

from __future__ import annotations

import sys

import pytest

from spikeloom.compiler.files import remove_leftovers, write_atomically


def interrupted_at(line: int, write):
    """Run `write`; an interrupt strikes at that line of all that it runs (0: none). How many lines there were."""
    seen = 0

    def trace(_frame, what, _value):
        nonlocal seen
        seen += what == "line"
        if what == "line" and seen == line:
            raise KeyboardInterrupt
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        write()
    finally:
        sys.settrace(before)
    return seen


@pytest.mark.filterwarnings("ignore:Exception ignored in:pytest.PytestUnraisableExceptionWarning")
def test_an_interrupt_anywhere_leaves_nothing_half_written(tmp_path):
    path = tmp_path / "x.json"

    def write():
        with write_atomically(path) as file:
            file.write(b"new")

    lines = interrupted_at(0, write)
    assert lines > 20
    ends, struck = set(), 0
    for line in range(1, lines + 1):
        path.write_bytes(b"old")
        try:
            interrupted_at(line, write)
        except KeyboardInterrupt:
            struck += 1
        assert [file.name for file in tmp_path.iterdir()] == ["x.json"], line
        ends.add(path.read_bytes())
    assert ends == {b"old", b"new"}
    assert struck > 0.9 * lines


def test_leftovers_are_those_of_one_file(tmp_path):
    path = tmp_path / "x[1].json"
    with write_atomically(path) as file:
        (written,) = tmp_path.iterdir()
        file.write(b"new")
    for name in (written.name, written.name.replace("x[1]", "x1")):
        (tmp_path / name).write_bytes(b"half")
    remove_leftovers(path)
    assert sorted(file.name for file in tmp_path.iterdir()) == [written.name.replace("x[1]", "x1"), "x[1].json"]


def test_a_file_that_is_replaced_hands_its_permissions_on(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"old")
    path.chmod(0o600)
    with write_atomically(path) as file:
        file.write(b"new")
    assert (path.read_bytes(), path.stat().st_mode & 0o777) == (b"new", 0o600)


def test_of_a_link_the_target_is_replaced(tmp_path):
    (tmp_path / "there").mkdir()
    target, link = tmp_path / "there" / "a", tmp_path / "b"
    for content in (b"old", b"new"):
        link.unlink(missing_ok=True)
        link.symlink_to(target)
        with write_atomically(link) as file:
            file.write(content)
        assert link.is_symlink()
        assert target.read_bytes() == content
        assert [file.name for file in target.parent.iterdir()] == ["a"]
