"""A stand-in for GitHub's API on loopback: comments of pull requests, as the action's token may read and write them."""

import contextlib
import json
import re
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

LONGEST = 65_536
PAGE = 2


@dataclass
class Comment:
    """A comment of the pull request; `author` is the token that wrote it."""

    id: int
    author: str
    body: str


@dataclass
class GitHub:
    """What it holds, what it was asked, and how it misbehaves.

    `refused` are tokens that may only read; the first `failing` requests are answered with 502; after the next listing,
    `meanwhile` is called, as if another job of the same pull request did something. Its repositories are private: `fetched`
    are the requests to them, each answered with 401.
    """

    comments: list[Comment] = field(default_factory=list)
    asked: list[tuple[str, str, Any]] = field(default_factory=list)
    refused: tuple[str, ...] = ()
    failing: int = 0
    address: str = ""
    meanwhile: Any = None
    fetched: list[str] = field(default_factory=list)

    def environment(self, token: str = "bot") -> dict[str, str]:
        """What GitHub gives a job of this repository."""
        return {
            "GITHUB_API_URL": f"{self.address}/api",
            "GITHUB_GRAPHQL_URL": f"{self.address}/api/graphql",
            "GITHUB_REPOSITORY": "team/robots",
            "GH_TOKEN": token,
        }

    @property
    def writes(self) -> list[tuple[str, str]]:
        """Method and path of the requests that change something."""
        return [(method, path) for method, path, _ in self.asked if not path.endswith("/graphql")]

    def add(self, author: str, body: str) -> Comment:
        """Put a comment there."""
        self.comments.append(Comment(max((one.id for one in self.comments), default=100) + 1, author, body))
        return self.comments[-1]

    def answer(self, method: str, path: str, token: str, data: Any) -> tuple[int, Any]:
        """Return status and body of the answer."""
        self.asked.append((method, path, data))
        if self.failing:
            self.failing -= 1
            return 502, {"message": "Server Error"}
        if (method, path) == ("POST", "/api/graphql"):
            return 200, self._listed(token, data["variables"])
        if token in self.refused:
            return 403, {"message": "Resource not accessible by integration"}
        if method in ("POST", "PATCH") and len(data["body"]) > LONGEST:
            return 422, {"message": "Validation Failed: body is too long (maximum is 65536 characters)"}
        if (method, path) == ("POST", "/api/repos/team/robots/issues/7/comments"):
            return 201, {"id": self.add(token, data["body"]).id}
        found = re.fullmatch(r"/api/repos/team/robots/issues/comments/(\d+)", path)
        one = next((one for one in self.comments if found and one.id == int(found[1])), None)
        if one is None or method not in ("PATCH", "DELETE"):
            return 404, {"message": "Not Found"}
        if method == "DELETE":
            self.comments.remove(one)
            return 204, None
        one.body = data["body"]
        return 200, {"id": one.id}

    def _listed(self, token: str, variables: dict[str, Any]) -> Any:
        if (variables["owner"], variables["name"], variables["number"]) != ("team", "robots", 7):
            return {"data": {"repository": None}, "errors": [{"message": "Could not resolve to a Repository"}]}
        first = int(variables["after"] or 0)
        nodes = [
            {"databaseId": one.id, "body": one.body, "viewerDidAuthor": one.author == token}
            for one in self.comments[first : first + PAGE]
        ]
        page = {"hasNextPage": first + PAGE < len(self.comments), "endCursor": str(first + PAGE)}
        if not page["hasNextPage"] and self.meanwhile is not None:
            self.meanwhile, then = None, self.meanwhile
            then()
        return {"data": {"repository": {"pullRequest": {"comments": {"nodes": nodes, "pageInfo": page}}}}}


@contextlib.contextmanager
def serving() -> Iterator[GitHub]:
    """Serve one on a free port of loopback."""
    github = GitHub()

    class Handler(BaseHTTPRequestHandler):
        def _do(self) -> None:
            content = self.rfile.read(int(self.headers.get("Content-Length") or 0))
            if ".git/" in self.path:
                github.fetched.append(self.path)
                self.send_response(401)
                self.send_header("WWW-Authenticate", 'Basic realm="GitHub"')
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            token = (self.headers.get("Authorization") or "").removeprefix("Bearer ")
            status, data = github.answer(self.command, self.path, token, json.loads(content) if content else None)
            answer = b"" if data is None else json.dumps(data).encode()
            self.send_response(status)
            self.send_header("Content-Length", str(len(answer)))
            self.end_headers()
            self.wfile.write(answer)

        do_GET = do_POST = do_PATCH = do_DELETE = _do

        def log_message(self, *_: Any) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        github.address = f"http://127.0.0.1:{server.server_port}"
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield github
        finally:
            server.shutdown()
            thread.join()
