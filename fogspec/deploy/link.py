"""The link on the computer that applies: the robot's public half for the task, the cloud's for the robot.

Everything is done by the script that runs at both ends (`templates/link.sh.j2`), in the folder of this user's links:
`~/.fogspec/links/NAME/robot`, or under FOGSPEC_LINKS. Where this computer is not the robot, that folder holds public
halves only: `public` is copied here from the robot, `peer` and `address` to it.
"""

import os
import subprocess
from pathlib import Path

from fogspec.base import child
from fogspec.base.errors import CloudError, InvalidInput, Refused
from fogspec.base.layout import Layout
from fogspec.base.text import shell_command
from fogspec.compile.launch_files import link_script
from fogspec.compile.links import link_of
from fogspec.compile.tasks import LINK_PEER
from fogspec.language.schema import Application

TIMEOUT_S = 60.0


def folder_of(name: str) -> Path:
    """Return the directory in which the robot's end of a link keeps its keys and public halves."""
    links = os.environ.get("FOGSPEC_LINKS")
    return (Path(links) if links else Path.home() / ".fogspec" / "links") / name / "robot"


def environment(application: Application, layout: Layout) -> dict[str, str]:
    """Return the variables that the task gets at launch; none without a link. Raise Refused before the robot has a key."""
    if link_of(application).protocol is None:
        return {}
    public = folder_of(application.name) / "public"
    if not public.is_file():
        raise Refused(
            f"{application.name}: the robot has no key for its link yet: {public} is missing",
            f"on the robot: {shell_command('bash', layout.link / 'link.sh', 'robot', 'keys')}",
            "on another computer: copy that file, the public half, from the robot to the same place here",
        )
    return {LINK_PEER: public.read_text("ascii", "replace").strip()}


def join(application: Application, layout: Layout, address: str, public: str) -> list[Path]:
    """Take the cloud's public half and address; return the files to copy if this computer is not the robot.

    Raise InvalidInput for an invalid public half or address.
    """
    if link_of(application).protocol is None:
        return []
    _run(application, layout, "peer", stdin=public.strip() + "\n")
    _run(application, layout, "address", address)
    return [folder_of(application.name) / name for name in ("peer", "address")]


def leave(application: Application, layout: Layout) -> None:
    """Forget the cloud's end; the robot's own key stays. Idempotent."""
    if link_of(application).protocol is not None:
        _run(application, layout, "leave")


def link_error(application: Application, layout: Layout) -> str | None:
    """Return why the cloud's end does not answer from here.

    None if it does, without a link, or if only the robot can tell: WireGuard does not answer from outside the tunnel.
    """
    if link_of(application).protocol != "tcp":
        return None
    try:
        _run(application, layout, "check")
    except (CloudError, InvalidInput) as problem:
        return problem.message
    return None


def _run(application: Application, layout: Layout, *words: str, stdin: str = "") -> str:
    script, variables = link_script(application, layout), child.environment()
    variables.pop("BASH_ENV", None)  # it may be a file of the working folder
    try:
        run = subprocess.run(
            [child.program("bash"), "-c", script, "link.sh", "robot", *words],
            input=stdin,
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
            check=False,
            cwd=child.ELSEWHERE,
            env=variables,
        )
    except (OSError, subprocess.TimeoutExpired) as problem:
        raise CloudError(f"the link's script did not end: {problem}") from None
    if run.returncode != 0:
        lines = [line.removeprefix("link: ") for line in run.stderr.splitlines()] or ["the link's script failed"]
        raise InvalidInput(f"{application.name}: {lines[0]}", *lines[1:4])
    return run.stdout
