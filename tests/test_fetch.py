import hashlib
import socket
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.models.recordings import fetch
from spikeloom.models.recordings.fetch import DATA_SETS, DataSet, data_folder, fetch_data, find_data

CONTENT = np.random.default_rng(0).bytes(200_000)
OTHER = bytes(len(CONTENT))
SIZE = len(CONTENT)
HALF = SIZE // 2
SHA = hashlib.sha256(CONTENT).hexdigest()
STALL_S = 0.4


class Server(ThreadingHTTPServer):
    """Answers each request with the next act of its script, the last one for ever."""

    daemon_threads = True
    block_on_close = False

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.script = [serve()]
        self.asked: list[str | None] = []
        self.over = threading.Event()

    def handle_error(self, request, client_address) -> None:
        """A client that hangs up is what these tests are about."""


class Handler(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        self.server.asked.append(self.headers["Range"])
        script = self.server.script
        act = script.pop(0) if len(script) > 1 else script[0]
        act(self)

    def answer(self, status: int, headers: dict[str, object], body: bytes = b"") -> None:
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, str(value))
        self.end_headers()
        self.wfile.write(body)
        self.wfile.flush()

    def start(self) -> int:
        asked = self.headers["Range"]
        return 0 if asked is None else int(asked.removeprefix("bytes=").removesuffix("-"))

    def log_message(self, *words) -> None:
        pass


def head(handler, start, size=SIZE):
    headers = {"Content-Length": size - start}
    if handler.headers["Range"] is None:
        return 200, headers
    return 206, headers | {"Content-Range": f"bytes {start}-{size - 1}/{size}"}


def serve(content=CONTENT, stop=None, stall=False, ranges=True):
    """All is well, or breaks off at byte `stop`, or goes silent there."""

    def act(handler) -> None:
        start = handler.start() if ranges else 0
        status, headers = head(handler, start, len(content)) if ranges else (200, {"Content-Length": len(content)})
        handler.answer(status, headers, content[start:stop])
        if stall:
            handler.server.over.wait(20)

    return act


def reply(status, headers, body=b""):
    return lambda handler: handler.answer(status, headers, body)


@pytest.fixture
def server(monkeypatch, tmp_path):
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    monkeypatch.setenv("SPIKELOOM_DATA", str(tmp_path / "data"))
    with Server() as running:
        url = f"http://127.0.0.1:{running.server_address[1]}/Ev-Objects.zip"
        made = DataSet(file="Ev-Objects.zip", url=url, size=len(CONTENT), sha256=SHA)
        monkeypatch.setitem(fetch.DATA_SETS, "objects", made)
        thread = threading.Thread(target=running.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield running
        running.over.set()
        running.shutdown()
        thread.join()


@pytest.fixture
def files(tmp_path):
    """Final file and the one that grows."""
    return tmp_path / "data" / "Ev-Objects.zip", tmp_path / "data" / "Ev-Objects.zip.part"


def fails(**options) -> str:
    with pytest.raises((DataError, OptionError)) as caught:
        fetch_data("objects", stall_s=STALL_S, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value).replace(DATA_SETS["objects"].url, "URL")


def test_fetches_once_and_is_found(server, files):
    path, part = files
    seen = []
    fetched = fetch_data("objects", progress=lambda have, size: seen.append((have, size)))
    assert (fetched.path, fetched.new) == (path, True)
    assert path.read_bytes() == CONTENT
    assert not part.exists()
    assert seen[-1] == (len(CONTENT), len(CONTENT))
    assert [have for have, _ in seen] == sorted({have for have, _ in seen})
    assert find_data("objects") == path
    again = fetch_data("objects")
    assert (again.path, again.new) == (path, False)
    assert server.asked == [None]


def test_another_folder_and_another_address(server, tmp_path):
    url = DATA_SETS["objects"].url.replace("Ev-Objects", "mirror")
    fetched = fetch_data("objects", folder=tmp_path / "a" / "b", url=url)
    assert fetched.path == tmp_path / "a" / "b" / "Ev-Objects.zip"
    assert fetched.path.read_bytes() == CONTENT


def test_a_file_without_a_length_is_fine(server, files):
    server.script = [reply(200, {}, CONTENT)]
    fetch_data("objects")
    assert files[0].read_bytes() == CONTENT


def test_goes_on_after_each_break(server, files):
    server.script = [serve(stop=1000), serve(stop=HALF), serve()]
    fetch_data("objects")
    assert server.asked == [None, "bytes=1000-", f"bytes={HALF}-"]
    assert files[0].read_bytes() == CONTENT


def test_goes_on_after_a_stall(server, files):
    server.script = [serve(stop=HALF, stall=True), serve()]
    fetch_data("objects", stall_s=STALL_S)
    assert server.asked == [None, f"bytes={HALF}-"]
    assert files[0].read_bytes() == CONTENT


def test_a_later_run_goes_on_where_an_earlier_one_stopped(server, files):
    path, part = files
    server.script = [serve(stop=HALF), serve(stop=HALF), serve()]
    assert fails() == (
        f"URL: the connection ended after {HALF} of 200000 bytes; run the command again to go on from there"
    )
    assert part.read_bytes() == CONTENT[:HALF]
    assert not path.exists()
    fetch_data("objects")
    assert path.read_bytes() == CONTENT
    assert server.asked[-1] == f"bytes={HALF}-"


def test_silence_ends(server, files):
    server.script = [serve(stop=0, stall=True)]
    assert fails() == "URL: the connection stalled after 0 of 200000 bytes; run the command again to go on from there"
    assert not files[0].exists()


def test_silence_instead_of_an_answer_ends(server):
    server.script = [lambda handler: handler.server.over.wait(20)]
    assert fails() == "URL: the connection stalled after 0 of 200000 bytes; run the command again to go on from there"


def test_a_drip_is_a_stall(server, files):
    def drip(handler) -> None:
        start = handler.start()
        handler.answer(*head(handler, start))
        for index in range(start, len(CONTENT)):
            handler.wfile.write(CONTENT[index : index + 1])
            if handler.server.over.wait(STALL_S / 8):
                return

    server.script = [drip]
    assert fails().startswith("URL: the connection stalled after ")
    assert len(server.asked) == fetch.MAX_ATTEMPTS
    arrived = files[1].read_bytes()
    assert 0 < len(arrived) < 200
    assert CONTENT.startswith(arrived)


def test_endless_breaks_end(server):
    server.script = [serve(stop=1000 * k) for k in range(1, 30)]
    assert fails() == "URL: the connection ended after 5000 of 200000 bytes; run the command again to go on from there"
    assert len(server.asked) == fetch.MAX_ATTEMPTS


def test_a_server_that_ignores_the_range_starts_over(server, files):
    server.script = [serve(stop=HALF), serve(ranges=False)]
    fetch_data("objects")
    assert server.asked == [None, f"bytes={HALF}-"]
    assert files[0].read_bytes() == CONTENT


def test_another_range_than_asked_starts_over(server, files):
    wrong = {"Content-Range": f"bytes 0-{HALF - 1}/{len(CONTENT)}", "Content-Length": HALF}
    server.script = [serve(stop=HALF), reply(206, wrong, CONTENT[:HALF]), serve()]
    fetch_data("objects")
    assert server.asked == [None, f"bytes={HALF}-", None]
    assert files[0].read_bytes() == CONTENT


def test_an_unasked_range_is_refused(server, files):
    server.script = [reply(206, {"Content-Range": "bytes 5-9/10", "Content-Length": 5}, b"12345")]
    assert fails() == "URL: sends a part of the file unasked; give another address with --url"
    assert not files[0].exists()


def test_a_range_that_the_server_cannot_serve_starts_over(server, files):
    server.script = [serve(stop=HALF), reply(416, {"Content-Length": 0}), serve()]
    fetch_data("objects")
    assert server.asked == [None, f"bytes={HALF}-", None]
    assert files[0].read_bytes() == CONTENT


def test_other_content_is_never_kept(server, files):
    path, part = files
    server.script = [serve(OTHER)]
    found = hashlib.sha256(OTHER).hexdigest()
    expected = f"URL: serves another file (sha256 {found}), the released one has {SHA}; give its address with --url"
    assert fails() == expected
    assert not path.exists()
    assert not part.exists()


@pytest.mark.parametrize("size", [HALF, len(CONTENT), len(CONTENT) + 7])
def test_a_foreign_beginning_is_dropped(server, files, size):
    path, part = files
    part.parent.mkdir()
    part.write_bytes((OTHER + OTHER)[:size])
    fetch_data("objects")
    assert path.read_bytes() == CONTENT
    assert server.asked == ([f"bytes={HALF}-", None] if size == HALF else [None])


def test_a_complete_part_needs_no_server(server, files):
    path, part = files
    part.parent.mkdir()
    part.write_bytes(CONTENT)
    assert fetch_data("objects").path == path
    assert server.asked == []


@pytest.mark.parametrize("announced", [len(CONTENT) - 1, len(CONTENT) + 1, 10**15])
def test_another_length_is_refused_before_it_is_read(server, files, announced):
    server.script = [reply(200, {"Content-Length": announced})]
    assert fails() == (f"URL: announces {announced} bytes, 200000 are expected; give the address of the released file")
    assert not files[0].exists()


def test_more_than_the_file_is_not_read(server, files):
    """Without a length a server may send for ever."""

    def endless(handler) -> None:
        handler.answer(200, {}, OTHER)
        while not handler.server.over.wait(0):
            handler.wfile.write(OTHER)

    server.script = [endless]
    assert fails().startswith("URL: serves another file (sha256 ")
    assert not files[0].exists()


@pytest.mark.parametrize(("status", "words"), [(404, "Not Found"), (403, "Forbidden"), (503, "Service Unavailable")])
def test_refusals(server, files, status, words):
    server.script = [reply(status, {"Content-Length": 4}, b"nope")]
    assert fails() == f"URL: the server answers {status} {words}; try later, or give another address with --url"
    assert not files[0].exists()


def test_a_login_page_is_refused(server, files):
    server.script = [reply(200, {"Content-Type": "text/html"}, b"<html>please log in</html>")]
    assert fails() == "URL: the connection ended after 26 of 200000 bytes; run the command again to go on from there"
    assert not files[0].exists()


def test_a_server_that_hangs_up(server):
    server.script = [lambda handler: handler.connection.shutdown(socket.SHUT_RDWR)]
    assert fails() == (
        "URL: the connection failed (Remote end closed connection without response) after 0 of 200000 bytes; "
        "run the command again to go on from there"
    )


def test_a_server_that_does_not_speak_http(server):
    server.script = [lambda handler: handler.wfile.write(b"SSH-2.0-\x1b[31mx\r\n")]
    assert fails() == (
        "URL: the connection failed (SSH-2.0- [31mx) after 0 of 200000 bytes; run the command again to go on from there"
    )


def test_nobody_there(server):
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{unused.getsockname()[1]}/x.zip"
        assert fails(url=url) == (
            f"{url}: the connection failed (Connection refused) after 0 of 200000 bytes; "
            "run the command again to go on from there"
        )


@pytest.mark.parametrize("url", ["file:///etc/passwd", "ftp://example.org/x", "Ev-Objects.zip", "http://", "http:///x"])
def test_only_web_addresses(server, url):
    assert fails(url=url) == f"--url {url}: not a web address; give one that starts with http:// or https://"


def test_a_stranger_under_the_final_name_is_left_alone(server, files):
    path, _ = files
    path.parent.mkdir()
    path.write_bytes(b"my own")
    assert fails() == f"{path}: exists and is not the released file; move it away, or give another --dir"
    assert path.read_bytes() == b"my own"
    with pytest.raises(DataError) as caught:
        find_data("objects")
    assert str(caught.value) == f"{path}: not the released file; remove it and run 'spikeloom data fetch objects'"


def test_what_is_not_there_is_named(server, files):
    with pytest.raises(DataError) as caught:
        find_data("objects")
    assert str(caught.value) == (
        f"objects: not on this machine (no {files[0]}); run 'spikeloom data fetch objects', "
        "or write ./objects for a folder of that name"
    )


@pytest.mark.parametrize("action", [find_data, fetch_data])
def test_unknown_names(action):
    with pytest.raises(OptionError) as caught:
        action("cats")
    assert str(caught.value) == "cats: no such data set; allowed: objects, containers"


def test_the_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("SPIKELOOM_DATA", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    assert data_folder() == tmp_path / ".cache" / "spikeloom"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative/paths/do/not/count")
    assert data_folder() == tmp_path / ".cache" / "spikeloom"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert data_folder() == tmp_path / "cache" / "spikeloom"
    monkeypatch.setenv("SPIKELOOM_DATA", "here")
    assert data_folder() == Path("here")


@pytest.mark.recordings
@pytest.mark.parametrize(("name", "fixture"), [("objects", "objects_zip"), ("containers", "containers_zip")])
def test_the_released_files_are_these(name, fixture, request):
    path = request.getfixturevalue(fixture)
    data = DATA_SETS[name]
    assert (path.name, path.stat().st_size) == (data.file, data.size)
    assert hashlib.sha256(path.read_bytes()).hexdigest() == data.sha256
    assert data.url == f"https://raw.githubusercontent.com/clear-nus/TactileSGNet/master/{data.file}"
