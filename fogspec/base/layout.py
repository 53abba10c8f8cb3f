"""Where an application's files are: beside the folder `specs/`, whatever the working directory."""

import os
from dataclasses import dataclass
from pathlib import Path

from fogspec.base.project_files import ProjectFiles

DEFAULT_ENVIRONMENT = "default"
MOST_BYTES = 64 << 20  # of one of its files
PROJECT = "fogspec.yaml"  # the settings of all applications
ENVIRONMENTS = "environments"  # the folder of their overlays
LOCK = ".lock"  # how the name of a lock ends
SCRIPTS = "scripts"  # the folder of what machines run


@dataclass(frozen=True, slots=True)
class Layout:
    """Paths of one application; `root` is the folder that compiled tasks' relative paths are relative to.

    `name` is the application's, in an environment with `@` and the environment's behind it. What is measured serves all
    environments of an application: plan, tasks and results are the same paths in each.
    """

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

    @classmethod
    def named(cls, root: Path, name: str) -> "Layout":
        """Return the layout of an application by its name, where its spec would be by that name: it may be gone."""
        application = name.partition("@")[0]
        places = [root / "specs" / application / f"{application}.yaml", root / "specs" / f"{application}.yaml"]
        return cls(root, next((place for place in places if os.path.lexists(place)), places[-1]), name)

    @property
    def application(self) -> str:
        """The name of the application without that of the environment."""
        return self.name.partition("@")[0]

    @property
    def environment(self) -> str:
        """The name of the environment."""
        return self.name.partition("@")[2] or DEFAULT_ENVIRONMENT

    @property
    def overlay(self) -> Path | None:
        """The file of the environment; None for the default one, which is the spec itself."""
        own = self.environment != DEFAULT_ENVIRONMENT
        return self.root / ENVIRONMENTS / f"{self.environment}.yaml" if own else None

    @property
    def argument(self) -> str | Path:
        """What names the application on a command line: its spec, or its name in an environment."""
        return self.spec if self.overlay is None else self.name

    @property
    def measured(self) -> "Layout":
        """The layout of the application that is measured: of its default environment."""
        return Layout(self.root, self.spec, self.application)

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
        """The lock, beside the spec: one of the application, for all of its environments."""
        return self.spec.parent / f"{self.application}{LOCK}"

    @property
    def beside_spec(self) -> ProjectFiles:
        """Opens and writes the lock: where the spec is, the user chose, also a link."""
        return ProjectFiles(self.spec.parent)

    @property
    def project(self) -> Path:
        """The settings of all applications with this root."""
        return self.root / PROJECT

    @property
    def planned(self) -> Path:
        """Folder of the plan."""
        return self.root / "compiled" / self.application

    @property
    def plan(self) -> Path:
        """The sampling plan."""
        return self.planned / "plan.yaml"

    @property
    def tasks(self) -> Path:
        """Folder of the compiled tasks."""
        return self.planned / "tasks"

    def task(self, sample: str) -> Path:
        """Return the compiled task of a sample."""
        return self.tasks / f"{sample}.sky.yaml"

    @property
    def setup_script(self) -> Path:
        """The script that sets up ROS 2 and the workspace on every machine."""
        return self.planned / SCRIPTS / "setup.sh"

    @property
    def measure_script(self) -> Path:
        """The script that measures a sample."""
        return self.planned / SCRIPTS / "measure.sh"

    @property
    def deploy_script(self) -> Path:
        """The script that runs the cloud nodes."""
        return self.compiled / SCRIPTS / "deploy.sh"

    @property
    def agent(self) -> Path:
        """The agent, which is sent to every machine; no application can have this name."""
        return self.root / "compiled" / "agent.pyz"

    @property
    def models(self) -> Path:
        """What the results predict: samples, curves, and distributions."""
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
        """Folder of what was measured: a file for each sample."""
        return self.root / "results" / self.application

    @property
    def timings(self) -> Path:
        """Folder of raw timings."""
        return self.results / "timings"

    def packages(self, digest: str) -> Path:
        """Return the list of packages with this digest."""
        return self.timings.parent / f"packages-{digest.removeprefix('sha256:')[:12]}.txt"

    @property
    def state(self) -> Path:
        """Live state, journals and locks; not in git."""
        return self.root / ".fogspec" / self.name

    @property
    def metrics(self) -> Path:
        """What the last round of `fogspec watch` saw of all applications, for node_exporter's textfile collector."""
        return self.root / ".fogspec" / "metrics.prom"

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
