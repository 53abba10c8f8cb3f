"""A language server over its standard streams, spoken to as an editor does."""

import json
import queue
import subprocess
import threading
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
SERVER = HERE / "node_modules" / "yaml-language-server" / "bin" / "yaml-language-server"
PATIENCE_S = 600.0


class Server:
    """yaml-language-server, without access to any schema store."""

    def __init__(self) -> None:
        self.process = subprocess.Popen(["node", str(SERVER), "--stdio"], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self.inbox: queue.Queue[dict[str, Any]] = queue.Queue()
        self.later: list[dict[str, Any]] = []
        self.number = 0
        threading.Thread(target=self._listen, daemon=True).start()
        self.ask("initialize", {"processId": None, "rootUri": None, "capabilities": {
            "textDocument": {"completion": {"completionItem": {"documentationFormat": ["markdown"], "snippetSupport": True}}},
            "workspace": {"configuration": True},
        }})  # fmt: skip
        self.tell("initialized", {})

    def __enter__(self) -> "Server":
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()

    def mistakes(self, path: Path, text: str) -> list[dict[str, Any]]:
        """What is underlined when the text is opened as this file."""
        self.tell(
            "textDocument/didOpen",
            {"textDocument": {"uri": path.as_uri(), "languageId": "yaml", "version": 1, "text": text}},
        )
        found = self._await(
            lambda one: one.get("method") == "textDocument/publishDiagnostics" and one["params"]["uri"] == path.as_uri()
        )["params"]["diagnostics"]
        assert isinstance(found, list)
        return found

    def at(self, what: str, path: Path, line: int, character: int) -> Any:
        """`hover` or `completion` at a place, both from 0."""
        place = {"textDocument": {"uri": path.as_uri()}, "position": {"line": line, "character": character}}
        return self.ask(f"textDocument/{what}", place)

    def ask(self, method: str, parameters: Any) -> Any:
        """The answer to a request."""
        self.number += 1
        number = self.number
        self._send({"id": number, "method": method, "params": parameters})
        return self._await(lambda one: one.get("id") == number and "method" not in one).get("result")

    def tell(self, method: str, parameters: Any) -> None:
        """A notification, which has no answer."""
        self._send({"method": method, "params": parameters})

    def _send(self, message: dict[str, Any]) -> None:
        assert self.process.stdin is not None
        body = json.dumps({"jsonrpc": "2.0", **message}).encode()
        self.process.stdin.write(b"Content-Length: %d\r\n\r\n" % len(body) + body)
        self.process.stdin.flush()

    def _listen(self) -> None:
        stream = self.process.stdout
        assert stream is not None
        while line := stream.readline():
            if line.lower().startswith(b"content-length:"):
                length = int(line.split(b":")[1])
                while stream.readline().strip():
                    pass
                self.inbox.put(json.loads(stream.read(length)))

    def _await(self, wanted: Any) -> dict[str, Any]:
        for one in self.later:
            if wanted(one):
                self.later.remove(one)
                return one
        while True:
            one = self.inbox.get(timeout=PATIENCE_S)
            if one.get("method") == "workspace/configuration":
                settings = {"validate": True, "hover": True, "completion": True, "schemaStore": {"enable": False}}
                answer = [settings if item.get("section") == "yaml" else None for item in one["params"]["items"]]
                self._send({"id": one["id"], "result": answer})
            elif "method" in one and "id" in one:
                self._send({"id": one["id"], "result": None})
            elif wanted(one):
                return one
            else:
                self.later.append(one)
