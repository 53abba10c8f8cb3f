"""The paper's applications from the specs and recorded results of this repository, read and chosen by the code that ships."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from fogspec.base.layout import Layout
from fogspec.catalog.filters import Filtered, filter_offers
from fogspec.catalog.sources import load_catalog
from fogspec.catalog.table import Catalog
from fogspec.choice.choose import Choice, choose
from fogspec.choice.relaxed import Relaxed, relaxed_optimum
from fogspec.language.loader import load
from fogspec.language.schema import Application, Constraints
from fogspec.model.fit import Fitted, fit, targets
from fogspec.model.predict import PredictionSet, predict
from fogspec.results.io import read_results, read_results_folder
from fogspec_lab.generated import ROOT

PATH_LENGTH = "path_length"
SPECS = ("grasp-planning-recorded", "vslam-recorded", "motion-planning-recorded")
TITLES = {
    "grasp-planning-recorded": "Dex-Net",
    "vslam-recorded": "SLAM",
    "motion-planning-cubicles-recorded": "Cubicles",
    "motion-planning-apartment-recorded": "Apartment",
}


@dataclass(frozen=True, slots=True)
class Case:
    """One application with all that is said of it; `open` is the choice without limits."""

    application: Application
    admissible: Filtered
    models: Fitted
    predicted: PredictionSet
    choice: Choice
    open: Choice

    @property
    def title(self) -> str:
        """The paper's name of the application."""
        return TITLES[self.application.metadata.name]

    def with_alpha(self, alpha: float) -> tuple[Choice, Relaxed | None]:
        """Return the choice among all machines and the paper's, without limits, at another alpha."""
        spec = self.application.spec
        objective = spec.objective.model_copy(update={"alpha": alpha})
        free = spec.model_copy(update={"constraints": Constraints(), "objective": objective})
        choice = choose(self.application.model_copy(update={"spec": free}), self.predicted)
        return choice, relaxed_optimum(self.models, choice)


@lru_cache(maxsize=1)
def snapshot() -> Catalog:
    """Return the catalog that comes with fogspec, whatever this machine has besides."""
    return load_catalog("snapshot", ("aws",))


def price_usd_per_hour(instance: str, region: str) -> float:
    """Return the on-demand price of an instance type; raise LookupError if the snapshot has none."""
    offers = snapshot()
    rows = np.flatnonzero((offers.instance == instance) & (offers.region == region) & ~offers.spot)
    if not len(rows):
        raise LookupError(f"{instance} in {region} is not in the snapshot")
    return float(offers.price_usd_per_hour[rows].min())


@lru_cache(maxsize=1)
def cases() -> tuple[Case, ...]:
    """Return the paper's applications, measured by its authors, in the order of `TITLES`."""
    found = {one.application.metadata.name: one for one in _cases()}
    return tuple(found[name] for name in TITLES)


def _cases() -> Iterator[Case]:
    for spec in SPECS:
        for one in load([str(ROOT / "specs" / f"{spec}.yaml")]):
            application = one.application
            results = read_results(Layout.of(one.path, application.metadata.name))
            if results is None:
                raise LookupError(f"results/{application.metadata.name} is missing")
            catalog = snapshot()
            admissible = filter_offers(catalog, application.spec.hardware, application.spec.infra)
            models = fit(application, results)
            predicted = predict(models, admissible.offers, targets(application), catalog)
            free = application.spec.model_copy(update={"constraints": Constraints()})
            unlimited = application.model_copy(update={"spec": free})
            yield Case(
                application,
                admissible,
                models,
                predicted,
                choose(application, predicted),
                choose(unlimited, predicted),
            )


@dataclass(frozen=True, slots=True)
class OwnRun:
    """An application of this repository that measured a path length: (machine, vCPUs, seconds, length) of each sample."""

    name: str
    unit: str
    where: str
    samples: tuple[tuple[str, float, float, float], ...]


@lru_cache(maxsize=1)
def own_runs() -> tuple[OwnRun, ...]:
    """Return the committed measurements of path lengths, by name of the application; `results/` is what runs here measured."""
    found = []
    for path in sorted((ROOT / "specs").glob("*.yaml")):
        for one in load([str(path)]):
            application = one.application
            kept = ROOT / "tests" / "data" / "sweeps" / application.metadata.name
            if PATH_LENGTH not in application.spec.metrics or not kept.is_dir():
                continue
            results = read_results_folder(kept)
            samples = tuple(
                (each.machine.instance, each.machine.cpus, each.latency.mean, each.metrics[PATH_LENGTH])
                for each in results.spec.samples
                if each.state == "ok" and each.latency is not None and PATH_LENGTH in each.metrics
            )
            unit = application.spec.metrics[PATH_LENGTH].unit or ""
            places = (
                "shapes of one host" if each.machine.is_local else each.machine.infra for each in results.spec.samples
            )
            where = ", ".join(dict.fromkeys(places))
            if samples:
                found.append(OwnRun(application.metadata.name, unit, where, samples))
    return tuple(found)
