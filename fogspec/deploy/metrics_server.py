"""A small HTTP server for metrics: it answers GET /metrics with the latest text, and nothing else."""

import contextlib
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from fogspec.base.errors import InvalidInput, UsageError
from fogspec.deploy.openmetrics import CONTENT_TYPE

PATH = "/metrics"
REQUEST_S = 10.0


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    text = b"# EOF\n"


class _Handler(BaseHTTPRequestHandler):
    timeout = REQUEST_S
    server_version = "fogspec"
    sys_version = ""

    def do_GET(self) -> None:
        """Answer with the latest metrics."""
        if self.path.partition("?")[0] != PATH:
            self.send_error(404)
            return
        text = self.server.text  # type: ignore[attr-defined]
        self.send_response(200)
        self.send_header("Content-Type", CONTENT_TYPE)
        self.send_header("Content-Length", str(len(text)))
        self.end_headers()
        self.wfile.write(text)

    def log_message(self, *_words: object) -> None:
        """Say nothing: scrapes are no events."""


@contextlib.contextmanager
def serve_metrics(listen: str | None, tell: Callable[[str], None]) -> Iterator[Callable[[str], None]]:
    """Yield a function that takes the latest text, served at HOST:PORT until the end; without `listen` it takes it in vain.

    Raise UsageError for an address that is none, InvalidInput for one that cannot be listened at.
    """
    if listen is None:
        yield lambda _text: None
        return
    host, colon, port = listen.rpartition(":")
    if not colon or not host or not port.isdecimal() or int(port) > 65535:
        raise UsageError(f"--listen {listen}: is not HOST:PORT", "write --listen 127.0.0.1:9464")
    try:
        server = _Server((host.strip("[]"), int(port)), _Handler)
    except OSError as problem:
        raise InvalidInput(
            f"--listen {listen}: {problem.strerror or problem}", "choose another address or port"
        ) from None
    tell(f"http://{host}:{server.server_address[1]}{PATH}")
    thread = threading.Thread(target=server.serve_forever, name="metrics", daemon=True)
    thread.start()
    try:
        yield lambda text: setattr(server, "text", text.encode())
    finally:
        server.shutdown()
        server.server_close()
