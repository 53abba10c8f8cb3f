"""A machine that nobody looks after, on either simulated engine."""

import os
import time
from dataclasses import dataclass
from typing import Any

from fogspec.backends.skypilot.client import Client
from fogspec.backends.skypilot.errors import CloudProblem
from tests.slurm.site import Site

ABANDONED = "fogspec-abandoned"


@dataclass
class Abandoned:
    """A compiled task that hangs, and who asks for its machine.

    The machine's lifetime is a minute. Where setting up took longer, on a slow computer, it has ended itself before it was
    there: the next one lives four times as long.
    """

    site: Site
    client: Client
    environment: dict[str, str]
    task: dict[str, Any]
    minutes: int = 1
    request: str = ""
    was_up: bool = False

    def start(self) -> None:
        """Ask for the machine, in the engine's environment, as whose worker the client's runs."""
        self.task["resources"]["autostop"]["idle_minutes"] = self.minutes
        self.task["run"] = "sleep 36000"
        before = dict(os.environ)
        try:
            os.environ.clear()
            os.environ.update(self.environment)
            self.client.ready()
        finally:
            os.environ.clear()
            os.environ.update(before)
        asked = self.client.call(
            "launch", 600, task=self.task, name=f"{ABANDONED}-{self.minutes}", root=str(self.site.project)
        )
        self.request = asked["request"]

    def up(self) -> None:
        """Wait until it was there; to be asked before a test ends the API server that knows."""
        while not self.was_up:
            try:
                name = f"{ABANDONED}-{self.minutes}"
                self.was_up = self.client.call("launched", 600, request=self.request, name=name) is not None
            except CloudProblem:
                if self.minutes >= 16:
                    raise
                self.minutes *= 4
                self.start()
            time.sleep(1)
        # A worker that a test ends would start again in the user's own environment.
        self.client.close()
