"""The link on the computer that applies: the robot's public half for the task, the cloud's for the robot.

Everything is done by the script that runs at both ends (`templates/link.sh.j2`), in the folder of this user's links:
`~/.fogspec/links/NAME/robot`, or under FOGSPEC_LINKS. Where this computer is not the robot, that folder holds public
halves only: `public` is copied here from the robot, `peer` and `address` to it.
"""

import os
import subprocess
from pathlib import Path

from fogspec.base.errors import CloudError, InvalidInput, Refused
from fogspec.base.layout import Layout
from fogspec.compile.launch_files import link_script
from fogspec.compile.links import link_of
from fogspec.compile.tasks import LINK_PEER
from fogspec.spec.schema import Application

PATIENCE_S = 60.0


def folder_of(name: str) -> Path:
    """Where the robot's end of an application's link keeps its keys and public halves."""
    links = os.environ.get("FOGSPEC_LINKS")
    return (Path(links) if links else Path.home() / ".fogspec" / "links") / name / "robot"


def make_keys(application: Application, layout: Layout) -> str:
    """Make the robot's private key where there is none, and return its public half.

    Raises InvalidInput without a link in the spec, CloudError when a program is missing.
    """
    if link_of(application).protocol is None:
        raise InvalidInput(
            f"{layout.spec}: spec.connectivity.link is none, which needs no keys", "write zenoh or wireguard"
        )
    return _run(application, layout, "keys").strip()


def environment(application: Application, layout: Layout) -> dict[str, str]:
    """What the deployment's task is given at launch; nothing without a link. Raises Refused before `fogspec keys`."""
    if link_of(application).protocol is None:
        return {}
    public = folder_of(application.metadata.name) / "public"
    if not public.is_file():
        raise Refused(
            f"{application.metadata.name}: the robot has no key for its link yet: {public} is missing",
            f"on the robot: fogspec keys {layout.spec}",
            "on another computer: copy that file, the public half, from the robot to the same place here",
        )
    return {LINK_PEER: public.read_text("ascii", "replace").strip()}


def join(application: Application, layout: Layout, address: str, public: str) -> list[Path]:
    """Take the cloud's public half and address; returns the files to copy where this computer is not the robot.

    Raises InvalidInput for what is no public half of the cloud's end, or no address.
    """
    if link_of(application).protocol is None:
        return []
    _run(application, layout, "peer", said=public.strip() + "\n")
    _run(application, layout, "address", address)
    return [folder_of(application.metadata.name) / name for name in ("peer", "address")]


def leave(application: Application, layout: Layout) -> None:
    """Forget the cloud's end; the robot's own key stays. Idempotent."""
    if link_of(application).protocol is not None:
        _run(application, layout, "leave")


def link_error(application: Application, layout: Layout) -> str | None:
    """Why the cloud's end does not answer from here; None when it does, when there is no link, or when only the robot
    could tell: WireGuard says nothing to who is not in the tunnel.
    """
    if link_of(application).protocol != "tcp":
        return None
    try:
        _run(application, layout, "check")
    except (CloudError, InvalidInput) as problem:
        return problem.message
    return None


def _run(application: Application, layout: Layout, *words: str, said: str = "") -> str:
    script = link_script(application, layout)
    try:
        run = subprocess.run(
            ["bash", "-c", script, "link.sh", "robot", *words],
            input=said, capture_output=True, text=True, timeout=PATIENCE_S, check=False,
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired) as problem:
        raise CloudError(f"the link's script did not end: {problem}") from None
    if run.returncode != 0:
        lines = [line.removeprefix("link: ") for line in run.stderr.splitlines()] or ["the link's script failed"]
        raise InvalidInput(f"{application.metadata.name}: {lines[0]}", *lines[1:4])
    return run.stdout
