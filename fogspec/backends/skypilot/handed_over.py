"""What SkyPilot gives a rented machine besides the task: credentials of its cloud, with which it ends itself.

Sources: docs.skypilot.co, "remote_identity"; Google's libraries read the login in GOOGLE_APPLICATION_CREDENTIALS, or else the
one that `gcloud auth application-default login` made; one of a person has the type `authorized_user`.
"""

import json
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from fogspec.base.clouds import OwnEnd, cloud_of
from fogspec.base.files import read_file
from fogspec.base.layout import MOST_BYTES
from fogspec.base.yaml.positions import plain
from fogspec.base.yaml.reader import decode, documents

COPIED = (None, "LOCAL_CREDENTIALS")  # of `remote_identity`


def handed_over(places: Iterable[str]) -> Iterator[str]:
    """Yield a line on the credentials that machines in these places (each an `infra`) get, and one if they may expire."""
    rows = {row.name: row for row in map(cloud_of, places) if row.on_skypilot}
    ends = (OwnEnd.AUTOSTOP, OwnEnd.POWER_OFF)
    given = sorted(name for name, row in rows.items() if row.own_end in ends and _identity(name) in COPIED)
    if given:
        yield (
            f"each machine gets your credentials for {' or '.join(given)}, with which it ends itself: "
            "its nodes, its image and the owner of its host can read them"
        )
    login = _google_login()
    if "gcp" in given and _json(login).get("type") == "authorized_user":
        yield (
            f"{login} is a person's login: where it expires, SkyPilot's autostop cannot end a machine on gcp; "
            "to mend that, put gcp: {remote_identity: SERVICE_ACCOUNT} into ~/.sky/config.yaml"
        )


def _identity(cloud: str) -> object:
    path = Path(os.environ.get("SKYPILOT_GLOBAL_CONFIG") or "~/.sky/config.yaml").expanduser()
    found, _ = documents(decode(_content(path), str(path))[0], str(path))
    section = _mapping(_mapping(plain(found[0])).get(cloud)) if found else {}
    return section.get("remote_identity")


def _google_login() -> Path:
    if named := os.environ.get("GOOGLE_APPLICATION_CREDENTIALS"):
        return Path(named)
    return Path(
        os.environ.get("CLOUDSDK_CONFIG") or "~/.config/gcloud", "application_default_credentials.json"
    ).expanduser()


def _json(path: Path) -> Mapping[str, Any]:
    try:
        return _mapping(json.loads(_content(path)))
    except ValueError:
        return {}


def _mapping(value: object) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _content(path: Path) -> bytes:
    try:
        return read_file(path, MOST_BYTES)
    except OSError:
        return b""
