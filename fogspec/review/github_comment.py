"""Post a review on a pull request: the action's own comment is found by its first line, and updated or created.

`python -I fogspec/review/github_comment.py FILE`, with what GitHub gives an action in the environment: GITHUB_API_URL,
GITHUB_GRAPHQL_URL, GITHUB_REPOSITORY; PULL_REQUEST, PATHS and GH_TOKEN are the action's. Only the standard library is needed.

Only comments that this token wrote count, so that another author's is never overwritten, whatever it begins with. What
cannot be posted, for a pull request from a fork may not, is a warning: the text is in the job's summary, and the check is
another step.
"""

import hashlib
import json
import os
import re
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

MARK = "<!-- fogspec review -->"
TIMEOUT_S = 30.0
TRIES = 3
WAIT_S = 2.0
MOST_BYTES = 32 << 20
AGAIN = (429, 500, 502, 503, 504)
QUERY = """query($owner: String!, $name: String!, $number: Int!, $after: String) {
  repository(owner: $owner, name: $name) { pullRequest(number: $number) {
    comments(first: 100, after: $after) {
      nodes { databaseId body viewerDidAuthor } pageInfo { hasNextPage endCursor } } } } }"""


class NotPostedError(Exception):
    """GitHub did not take it; the text is why."""


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    """Follows no redirect: the token is for GitHub's API alone."""

    def redirect_request(self, *_: Any) -> None:
        """Refuse."""


OPENER = urllib.request.build_opener(_NoRedirect)


def mark_of(paths: str) -> str:
    """Return the first line of the comment on these paths: calls with different paths have different comments."""
    return MARK.replace("review", f"review {hashlib.sha256(os.fsencode(paths.strip())).hexdigest()[:12]}")


class PullRequest:
    """A pull request, through GitHub's API."""

    def __init__(self, environment: "os._Environ[str] | dict[str, str]") -> None:
        """Take addresses, number and token from the environment; raise NotPostedError for what is not there."""
        try:
            self.api, self.graphql = environment["GITHUB_API_URL"], environment["GITHUB_GRAPHQL_URL"]
            self.repository, number = environment["GITHUB_REPOSITORY"], environment["PULL_REQUEST"]
            self.token, self.mark = environment["GH_TOKEN"], mark_of(environment["PATHS"])
        except KeyError as absent:
            raise NotPostedError(f"the environment has no {absent.args[0]}") from None
        if not re.fullmatch(r"[\w.-]+/[\w.-]+", self.repository) or not re.fullmatch(r"[0-9]{1,9}", number):
            raise NotPostedError("there is no repository or pull request of this name")
        if not all(url.startswith(("https://", "http://")) for url in (self.api, self.graphql)):
            raise NotPostedError("GITHUB_API_URL and GITHUB_GRAPHQL_URL are not addresses of the web")
        self.number = int(number)

    def own(self) -> list[int]:
        """Return the numbers of the comments that this token wrote and that begin with the mark, oldest first."""
        return sorted(
            int(one["databaseId"])
            for one in self._comments()
            if one.get("viewerDidAuthor") is True and str(one.get("body", "")).lstrip().startswith(self.mark)
        )

    def post(self, text: str) -> str:
        """Update the comment, or create it; return what was done. Of two that began at once, the first one stays."""
        own, text = self.own(), text.replace(MARK, self.mark, 1)
        if own:
            self._ask("PATCH", f"{self._address}/comments/{own[0]}", {"body": text})
            done = "updated"
        else:
            self._ask("POST", f"{self._address}/{self.number}/comments", {"body": text})
            own, done = self.own(), "created"
            if len(own) > 1:
                self._ask("PATCH", f"{self._address}/comments/{own[0]}", {"body": text})
        for later in own[1:]:
            self._ask("DELETE", f"{self._address}/comments/{later}", None)
        return done

    @property
    def _address(self) -> str:
        return f"{self.api}/repos/{self.repository}/issues"

    def _comments(self) -> Iterator[dict[str, Any]]:
        owner, _, name = self.repository.partition("/")
        after = None
        while True:
            variables = {"owner": owner, "name": name, "number": self.number, "after": after}
            answer = self._ask("POST", self.graphql, {"query": QUERY, "variables": variables})
            try:
                found = answer["data"]["repository"]["pullRequest"]["comments"]
                yield from (one for one in found["nodes"] if isinstance(one, dict))
                page = found["pageInfo"]
                after, more = page["endCursor"], page["hasNextPage"]
            except (KeyError, TypeError):
                raise NotPostedError(f"the comments cannot be read: {_reason(answer)}") from None
            if more is not True:
                return

    def _ask(self, method: str, url: str, data: Any) -> Any:
        """Return the answer to a request; what GitHub could not answer just now is tried again, except a creation."""
        headers = {
            "Authorization": f"Bearer {self.token}",
            "Accept": "application/vnd.github+json",
            "Content-Type": "application/json",
            "User-Agent": "fogspec",
            "X-GitHub-Api-Version": "2022-11-28",
        }
        body = None if data is None else json.dumps(data).encode()
        creates = method == "POST" and url != self.graphql
        for left in reversed(range(1 if creates else TRIES)):
            request = urllib.request.Request(url, body, headers, method=method)  # noqa: S310 - https or http, see above
            try:
                with OPENER.open(request, timeout=TIMEOUT_S) as answer:
                    content = answer.read(MOST_BYTES)
                return json.loads(content) if content else None
            except urllib.error.HTTPError as refused:
                if refused.code not in AGAIN or not left:
                    raise NotPostedError(f"HTTP {refused.code}: {_reason(_json(refused.read(MOST_BYTES)))}") from None
            except (OSError, ValueError) as lost:
                if not left:
                    raise NotPostedError(f"no answer from {url}: {lost}") from None
            time.sleep(WAIT_S)
        raise AssertionError("the last try returns or raises")


def _json(content: bytes) -> Any:
    try:
        return json.loads(content)
    except ValueError:
        return None


def _reason(answer: Any) -> str:
    """Return GitHub's own words for a refusal."""
    if not isinstance(answer, dict):
        return "without a reason"
    errors = answer.get("errors")
    texts = [str(one.get("message")) for one in errors if isinstance(one, dict)] if isinstance(errors, list) else []
    return "; ".join([str(answer["message"])] if "message" in answer else texts)[:300] or "without a reason"


def _command(text: str) -> str:
    """Return a text as the message of a workflow command."""
    return text.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")


def main(path: str) -> int:
    """Post the file's text; return 0 also if GitHub does not take it, which is a warning."""
    text = Path(path).read_text(encoding="utf-8")
    if not text.startswith(MARK):
        print(f"::error::{_command(path)}: does not begin with {MARK}: its comment would not be found again")
        return 1
    try:
        print(f"comment {PullRequest(os.environ).post(text)}")
    except NotPostedError as why:
        print(f"::warning::the review is in the job's summary; as a comment it was not posted: {_command(str(why))}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
