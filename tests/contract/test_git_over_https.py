"""Live state in a repository behind HTTPS and a token, as `actions/checkout` leaves it in the clone: git's own http-backend."""

import base64
import http.server
import os
import ssl
import subprocess
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from fogspec.deploy.git_store import GitStore
from fogspec.deploy.stores import Overtaken, StoreUnavailable
from tests.support.repositories import git

TOKEN = "swordfish-swordfish"
HEADER = f"AUTHORIZATION: basic {base64.b64encode(f'x-access-token:{TOKEN}'.encode()).decode()}"


@dataclass
class Remote:
    """A repository at a URL; the methods of the requests that came with the token, and how many came without."""

    url: str
    clone: Path
    can_write: bool = True
    allowed: list[str] = field(default_factory=list)
    refused: int = 0

    def store(self) -> GitStore:
        return GitStore(self.url, self.clone, self.clone)

    def log_in(self, header: str = HEADER) -> None:
        git("config", f"http.{self.url.partition('/robots')[0]}/.extraheader", header, folder=self.clone)


@pytest.fixture
def remote(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Remote]:
    key, cert = tmp_path / "key.pem", tmp_path / "cert.pem"
    words = ["-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=localhost"]
    subprocess.run(
        ["openssl", "req", *words, "-addext", "subjectAltName=DNS:localhost", "-keyout", key, "-out", cert],
        check=True, capture_output=True,
    )  # fmt: skip
    monkeypatch.setenv("GIT_SSL_CAINFO", str(cert))
    bare, clone = tmp_path / "served" / "robots.git", tmp_path / "clone"
    git("init", "-q", "--bare", str(bare), folder=tmp_path)
    git("config", "http.receivepack", "true", folder=bare)
    git("init", "-q", str(clone), folder=tmp_path)
    made = Remote("", clone)

    class Backend(http.server.BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, *_: object) -> None:
            pass

        def do_GET(self) -> None:
            path, _, query = self.path.partition("?")
            if self.headers.get("Authorization") != HEADER.partition(": ")[2]:
                made.refused += 1
                self.send_response(401)
                self.send_header("WWW-Authenticate", 'Basic realm="robots"')
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            made.allowed.append(self.command)
            if "git-receive-pack" in self.path and not made.can_write:
                self.send_error(403)
                return
            body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
            environment = {
                **os.environ, "GIT_PROJECT_ROOT": str(bare.parent), "GIT_HTTP_EXPORT_ALL": "1", "PATH_INFO": path,
                "QUERY_STRING": query, "REQUEST_METHOD": self.command, "REMOTE_USER": "ci",
                "CONTENT_TYPE": self.headers.get("Content-Type", ""), "CONTENT_LENGTH": str(len(body)),
                "HTTP_CONTENT_ENCODING": self.headers.get("Content-Encoding", ""),
                "GIT_PROTOCOL": self.headers.get("Git-Protocol", ""),
            }  # fmt: skip
            done = subprocess.run(["git", "http-backend"], input=body, env=environment, capture_output=True, check=True)
            head, _, content = done.stdout.partition(b"\r\n\r\n")
            lines = dict(line.split(": ", 1) for line in head.decode().splitlines())
            self.send_response(int(lines.pop("Status", "200 OK").split()[0]))
            for name, value in lines.items():
                self.send_header(name, value)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        do_POST = do_GET

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Backend)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(cert, key)
    server.socket = context.wrap_socket(server.socket, server_side=True)
    made.url = f"https://localhost:{server.server_address[1]}/robots.git"
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield made
    server.shutdown()
    server.server_close()


def test_the_token_of_the_clone_logs_in_to_read_and_to_write(remote: Remote) -> None:
    remote.log_in()
    store = remote.store()
    assert store.read_all() == {}
    first = store.write("tiny-x", b"a: 1\n", None, "first")
    assert remote.store().read("tiny-x").content == b"a: 1\n"
    with pytest.raises(Overtaken):
        remote.store().write("tiny-x", b"a: 2\n", None, "second")
    assert store.write("tiny-x", None, first, "last") is None
    assert remote.store().read_all() == {}
    assert {"GET", "POST"} == set(remote.allowed)


@pytest.mark.parametrize("header", [None, "AUTHORIZATION: basic d3Jvbmc6d3Jvbmc="])
def test_without_the_right_token_nothing_is_read_and_nothing_asks(remote: Remote, header: str | None) -> None:
    if header is not None:
        remote.log_in(header)
    with pytest.raises(StoreUnavailable, match=r"no contact: fatal: (could not read Username|Authentication failed)"):
        remote.store().read_all()
    assert remote.allowed == []
    assert remote.refused


def test_with_a_token_that_may_only_read_a_write_is_refused(remote: Remote) -> None:
    remote.log_in()
    remote.can_write = False
    with pytest.raises(StoreUnavailable, match=r"403") as refused:
        remote.store().write("tiny-x", b"a: 1\n", None, "first")
    assert TOKEN not in str(refused.value)
    assert HEADER.rpartition(" ")[2] not in str(refused.value)
    assert remote.store().read_all() == {}


def test_an_unknown_certificate_is_refused(remote: Remote, monkeypatch: pytest.MonkeyPatch) -> None:
    remote.log_in()
    monkeypatch.delenv("GIT_SSL_CAINFO")
    with pytest.raises(StoreUnavailable, match="certificate"):
        remote.store().read_all()
    assert remote.allowed == []
