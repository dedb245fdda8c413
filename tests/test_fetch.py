"""Downloads: the released file under its name or nothing, whatever a server does."""

import hashlib
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from spikeloom.compiler.errors import DataError
from spikeloom.models.recordings import fetch
from spikeloom.models.recordings.fetch import DATA_SETS, DataSet, data_folder, fetch_data, find_data

pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # requests keeps a socket

CONTENT = b"recordings" * 1000


@pytest.fixture
def server(monkeypatch, tmp_path):
    """Answers each request with the next status and body of its script, the last one for ever."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            running.requests += 1
            status, body, announced = running.script.pop(0) if len(running.script) > 1 else running.script[0]
            self.send_response(status)
            self.send_header("Content-Length", str(announced))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *words) -> None:
            pass

    monkeypatch.setenv("no_proxy", "127.0.0.1")
    monkeypatch.setenv("SPIKELOOM_DATA", str(tmp_path / "data"))
    monkeypatch.setattr("time.sleep", lambda _: None)
    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as running:
        running.script, running.requests = [(200, CONTENT, len(CONTENT))], 0
        thread = threading.Thread(target=running.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        url = f"http://127.0.0.1:{running.server_address[1]}/x.zip"
        sha256 = hashlib.sha256(CONTENT).hexdigest()
        data = DataSet(file="Ev-Objects.zip", url=url, size=len(CONTENT), sha256=sha256)
        monkeypatch.setitem(fetch.DATA_SETS, "objects", data)
        yield running
        running.shutdown()
        thread.join()


def test_fetches_once_and_is_found(server, tmp_path):
    path = tmp_path / "data" / "Ev-Objects.zip"
    with pytest.raises(DataError, match=r"objects: not on this machine .*run 'spikeloom data fetch objects'"):
        find_data("objects")
    fetched = fetch_data("objects")
    assert (fetched.path, fetched.new, path.read_bytes()) == (path, True, CONTENT)
    assert (find_data("objects"), fetch_data("objects").new, server.requests) == (path, False, 1)
    other = fetch_data("objects", folder=tmp_path / "a" / "b", url=DATA_SETS["objects"].url + "?mirror")
    assert (other.path, other.path.read_bytes()) == (tmp_path / "a" / "b" / "Ev-Objects.zip", CONTENT)


def test_tries_again(server):
    server.script = [(503, b"later", 5), (200, CONTENT[:99], len(CONTENT)), (200, CONTENT, len(CONTENT))]
    assert fetch_data("objects").path.read_bytes() == CONTENT
    assert server.requests == 3


@pytest.mark.parametrize(
    ("status", "body", "words"),
    [
        (404, b"nope", ["cannot be fetched", "404"]),
        (200, b"<html>please log in</html>", ["serves another file", "sha256"]),
        (200, bytes(len(CONTENT)), ["serves another file"]),
    ],
)
def test_other_content_is_never_kept(server, tmp_path, status, body, words):
    server.script = [(status, body, len(body))]
    with pytest.raises(DataError) as caught:
        fetch_data("objects")
    assert all(word in str(caught.value) for word in [DATA_SETS["objects"].url, "--url", *words])
    assert server.requests == 1 + fetch.RETRIES
    assert list((tmp_path / "data").iterdir()) == []


def test_a_stranger_under_the_final_name_is_left_alone(server, tmp_path):
    path = tmp_path / "data" / "Ev-Objects.zip"
    path.parent.mkdir()
    path.write_bytes(b"my own")
    for action, words in ((fetch_data, "exists and is not the released file"), (find_data, "not the released file")):
        with pytest.raises(DataError, match=words):
            action("objects")
    assert path.read_bytes() == b"my own"


def test_the_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("SPIKELOOM_DATA", raising=False)
    for cache in (None, "relative/paths/do/not/count"):
        monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
        if cache:
            monkeypatch.setenv("XDG_CACHE_HOME", cache)
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
