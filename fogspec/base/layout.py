"""Where an application's files are: beside the folder `specs/`, whatever the working directory."""

import os
from dataclasses import dataclass
from pathlib import Path

from fogspec.base.project_files import ProjectFiles


@dataclass(frozen=True, slots=True)
class Layout:
    """Paths of one application; `root` is the folder that compiled tasks' relative paths are relative to."""

    root: Path
    spec: Path
    name: str

    @classmethod
    def of(cls, spec_path: str | os.PathLike[str], name: str) -> "Layout":
        """Return the layout for a spec: the root is the parent of the folder `specs` that it is in, else the spec's own folder.

        The spec may be at any depth in it; the nearest folder of that name counts, within the repository.
        """
        spec = Path(spec_path)
        root = here = spec.parent
        for folder in (absolute := here.absolute(), *absolute.parents):
            here = _above(here)
            if folder.name == "specs":
                root = here
                break
            if os.path.lexists(folder / ".git"):
                break
        return cls(root, spec, name)

    @property
    def files(self) -> ProjectFiles:
        """Opens, writes and removes what the other properties name."""
        return ProjectFiles(self.root)

    @property
    def compiled(self) -> Path:
        """Folder of what is derived and reviewed."""
        return self.root / "compiled" / self.name

    @property
    def lock(self) -> Path:
        """The lock of all applications with this root."""
        return self.root / "fogspec.lock"

    @property
    def project(self) -> Path:
        """The settings of all applications with this root."""
        return self.root / "fogspec.yaml"

    @property
    def plan(self) -> Path:
        """The sampling plan."""
        return self.compiled / "plan.yaml"

    @property
    def tasks(self) -> Path:
        """Folder of the compiled tasks."""
        return self.compiled / "tasks"

    def task(self, sample: str) -> Path:
        """Return the compiled task of a sample."""
        return self.tasks / f"{sample}.sky.yaml"

    @property
    def agent(self) -> Path:
        """The agent, which is sent to every machine; no application can have this name."""
        return self.root / "compiled" / "agent.pyz"

    @property
    def former_agent(self) -> Path:
        """The directory that the agent's files were copied to before it was one file."""
        return self.root / "compiled" / "_agent"

    @property
    def models(self) -> Path:
        """The fitted models."""
        return self.compiled / "models.yaml"

    @property
    def menu(self) -> Path:
        """The menu of choices."""
        return self.compiled / "menu.yaml"

    @property
    def picture(self) -> Path:
        """The menu as a picture."""
        return self.compiled / "menu.svg"

    @property
    def latencies(self) -> Path:
        """The latency by vCPUs as a picture."""
        return self.compiled / "latency.svg"

    @property
    def metric_picture(self) -> Path:
        """The objective's metric by vCPUs as a picture."""
        return self.compiled / "metric.svg"

    @property
    def page(self) -> Path:
        """The report."""
        return self.compiled / "report.html"

    @property
    def manifest(self) -> Path:
        """The pinned manifest."""
        return self.compiled / "manifest.yaml"

    @property
    def deploy(self) -> Path:
        """The task that runs the cloud nodes."""
        return self.compiled / "deploy.sky.yaml"

    def fallback(self, number: int) -> Path:
        """Return the task for a fallback machine; the first has number 1."""
        return self.compiled / f"deploy.fallback-{number}.sky.yaml"

    @property
    def robot(self) -> Path:
        """The launch file of what stays on the robot."""
        return self.compiled / "robot.launch.py"

    @property
    def cloud(self) -> Path:
        """The launch file of what runs in the cloud."""
        return self.compiled / "cloud.launch.py"

    @property
    def link(self) -> Path:
        """Folder of the link's configuration and script, for both ends."""
        return self.compiled / "link"

    @property
    def results(self) -> Path:
        """What was measured."""
        return self.root / "results" / f"{self.name}.yaml"

    @property
    def timings(self) -> Path:
        """Folder of raw timings."""
        return self.root / "results" / self.name / "timings"

    @property
    def state(self) -> Path:
        """Live state, journals and locks; not in git."""
        return self.root / ".fogspec" / self.name

    @property
    def application_lock(self) -> Path:
        """Held while a bench, an apply or a down works."""
        return self.state / "lock"

    @property
    def journal(self) -> Path:
        """What a bench started."""
        return self.state / "journal.jsonl"

    @property
    def attempts(self) -> Path:
        """Folder of what belongs to samples that were measured."""
        return self.state / "attempts"

    @property
    def sent(self) -> Path:
        """Folder of the snapshots of what a bench sends to its machines."""
        return self.state / "sent"

    @property
    def live(self) -> Path:
        """What runs."""
        return self.state / "deployment.yaml"

    @property
    def last_words(self) -> Path:
        """What the nodes of the last machine printed that was started and never answered."""
        return self.state / "last-words.log"

    @property
    def events(self) -> Path:
        """What `fogspec watch` saw and did, one line of JSON each."""
        return self.state / "events.jsonl"

    @property
    def deployed(self) -> Path:
        """Folder of what belongs to machines that run."""
        return self.state / "deployed"

    def beside_manifest(self, path: Path) -> str:
        """Return a path as the manifest writes it: relative to its folder."""
        return Path(os.path.relpath(path, self.compiled)).as_posix()

    def relative(self, path: Path) -> str:
        """Return a path as written into files: relative to the root, with forward slashes."""
        return Path(os.path.relpath(path, self.root)).as_posix()


def _above(folder: Path) -> Path:
    """Return the folder above another one, as a relative path if that is one."""
    return folder / ".." if folder.name in ("", "..") and not folder.is_absolute() else folder.parent
