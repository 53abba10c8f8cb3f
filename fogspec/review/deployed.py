"""Read what a manifest deploys from its plain values, so that one of another version of fogspec can be compared too."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

from fogspec.base import units
from fogspec.base.clouds import beside_what, cloud_of
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.layout import Layout
from fogspec.base.redaction import redacted
from fogspec.language.loader import SourceFile
from fogspec.language.lockfile import is_pinned


class Figure(NamedTuple):
    """A figure of a manifest: its name for people, its place in the manifest, and its format."""

    name: str
    path: tuple[str, ...]
    show: Callable[[float, int], str]


PRICE = Figure("machine", ("spec", "price"), units.shown_price)
MONTH = Figure("per month", ("expected", "cost", "month"), lambda usd, _: units.shown_month(usd))
REQUEST = Figure("requests", ("expected", "cost", "predicted"), units.shown_cost)
LATENCY = Figure("latency", ("expected", "latency", "predicted"), units.shown_duration)
FIGURES = (PRICE, MONTH, REQUEST, LATENCY)


@dataclass(frozen=True, slots=True)
class Deployed:
    """A manifest in plain values, without secrets; `damage` is the reason why it cannot be read."""

    values: Mapping[str, Any]
    damage: str | None = None

    @classmethod
    def of(cls, file: SourceFile | None) -> "Deployed | None":
        """Return the manifest in a file; None without one."""
        if file is None:
            return None
        try:
            found = file.plain()
        except DiagnosticError as problems:
            return cls({}, problems.diagnostics[0].message)
        if not isinstance(found, dict) or not isinstance(found.get("spec"), dict):
            return cls({}, "it is not a manifest")
        return cls(redacted(found))

    @classmethod
    def at(cls, layout: Layout) -> "Deployed | None":
        """Read the manifest on disk; None without one."""
        files = layout.files
        return cls.of(SourceFile.read(layout.manifest, files)) if files.is_file(layout.manifest) else None

    def get(self, *path: str) -> Any:
        """Return the value at a path; None if there is none."""
        value: Any = self.values
        for step in path:
            value = value.get(step) if isinstance(value, Mapping) else None
        return value

    def part(self, *path: str) -> Mapping[str, Any]:
        """Return the mapping at a path; an empty one if there is none."""
        found = self.get(*path)
        return found if isinstance(found, Mapping) else {}

    def listed(self, *path: str) -> list[Any]:
        """Return the list at a path; an empty one if there is none."""
        found = self.get(*path)
        return found if isinstance(found, list) else []

    def number(self, figure: Figure) -> float | None:
        """Return a figure in base units, USD or seconds; None if the manifest does not have it."""
        return number(self.get(*figure.path))

    def shown(self, figure: Figure) -> str:
        """Return a figure for people."""
        value = self.number(figure)
        return "unknown" if value is None else figure.show(value, 3)

    @property
    def month_usd(self) -> float:
        """The cost of the machine in USD per month; 0 if it is not known."""
        return self.number(MONTH) or 0.0

    @property
    def place(self) -> str:
        """The machine in a few words, such as `a.large in aws/r1`."""
        if self.damage is not None:
            return "damaged"
        spot = " spot" if self.get("spec", "spot") is True else ""
        return f"{self.get('spec', 'instance')} in {self.get('spec', 'infra')}{spot}"

    @property
    def unpinned_image(self) -> str | None:
        """The image if it is not pinned by digest, and the machine runs containers: `apply` refuses it."""
        image = self.get("spec", "image")
        if image is None or is_pinned(str(image)):
            return None
        cloud = cloud_of(str(self.get("spec", "infra")))
        return str(image) if cloud.on_skypilot and cloud.containers else None

    @property
    def warnings(self) -> list[Mapping[str, Any]]:
        """The warnings of the choice, by code and values."""
        return [one for one in self.listed("warnings") if isinstance(one, Mapping)]

    @property
    def carried(self) -> list[tuple[str, str, bool]]:
        """The changes that its samples outlive: which, a text by which its file has it, and whether that was measured."""
        found = list[tuple[str, str, bool]]()
        for one in self.listed("evidence", "carried"):
            own = Deployed(one if isinstance(one, Mapping) else {})
            if confirmed := own.part("confirmed"):
                what = "; ".join(map(str, own.listed("confirmed", "changes")))
                found.append((what, str(confirmed.get("sample")), True))
            waivers = [waiver for waiver in own.listed("waivers") if isinstance(waiver, Mapping)]
            found += [(str(waiver.get("change")), str(waiver.get("reason")), False) for waiver in waivers]
        return found

    @property
    def facts(self) -> list[str]:
        """The machine with its price, and the latency and cost that are expected, for people."""
        if self.damage is not None:
            return []
        latency = self.part("expected", "latency")
        image = self.get("spec", "image") or "none"
        what = (
            beside_what(str(self.get("spec", "infra")), str(self.get("spec", "instance"))) if self.number(PRICE) else ""
        )
        counted = f" with {what}" if what else ""
        found = [f"runs on {self.place}, {self.shown(PRICE)}, {self.shown(MONTH)}{counted}; image {image}"]
        ends = [end for one in self.listed("expected", "latency", "interval") if (end := number(one)) is not None]
        within = f" [{', '.join(map(units.shown_duration, ends))}]" if ends else ""
        limit, sure = number(latency.get("limit")), _fraction(latency.get("probability_met"))
        met = "" if limit is None else f", limit {units.shown_duration(limit)}"
        if sure is not None:
            met += f", met with probability {'above 0.999' if sure > 0.999 else f'{sure:.3g}'}"
        expected = f"expected {latency.get('statistic')} latency {self.shown(LATENCY)}{within}{met}"
        return [*found, f"{expected}; {self.shown(REQUEST)}", *self._baseline]

    @property
    def _baseline(self) -> list[str]:
        """The sentence about the machine that would be taken without a benchmark; none without one."""
        figures = [self.number(one) for one in (LATENCY, REQUEST)]
        figures += [number(self.get("expected", "baseline", name)) for name in ("latency", "cost")]
        latency, cost, other_latency, other_cost = figures
        if not latency or cost is None or not other_latency or other_cost is None:
            return []
        other = str(self.get("expected", "baseline", "instance"))
        return [units.against(latency, cost, other, other_latency, other_cost)]

    def as_dict(self) -> dict[str, Any] | None:
        """Return what it deploys for JSON, money in USD and durations in seconds; None if it is damaged."""
        if self.damage is not None:
            return None
        latency, request_usd = self.part("expected", "latency"), self.number(REQUEST)
        return {
            **{key: self.get("spec", key) for key in ("infra", "instance")},
            "spot": self.get("spec", "spot") is True,
            "image": self.get("spec", "image"),
            "price_usd_per_hour": self.number(PRICE),
            "usd_per_month": self.number(MONTH),
            "usd_per_1000_requests": None if request_usd is None else round(1000 * request_usd, 12),
            "latency": {
                "statistic": latency.get("statistic"),
                "predicted_s": self.number(LATENCY),
                "interval_s": [number(one) for one in self.listed("expected", "latency", "interval")] or None,
                "limit_s": number(latency.get("limit")),
                "probability_met": _fraction(latency.get("probability_met")),
            },
        }


def number(value: Any) -> float | None:
    """Return a duration, price, cost or sum in base units; None for anything else."""
    return _number(str(value))


@lru_cache(maxsize=4096)
def _number(text: str) -> float | None:
    text = text.removesuffix("/month").replace(",", "")
    for parse in (
        units.parse_duration_s,
        units.parse_price_usd_per_hour,
        units.parse_cost_usd_per_request,
        units.parse_money_usd,
    ):
        try:
            return parse(text)
        except units.UnitError:
            continue
    return None


def figure_rows(before: Deployed | None, after: Deployed | None) -> list[tuple[str, str, str, str]]:
    """Return the figures that differ: name, before, after, and the relative change."""
    found = list[tuple[str, str, str, str]]()
    if before is None or after is None:
        return found
    for one in FIGURES:
        was, now = before.number(one), after.number(one)
        if was is not None and now is not None and was != now:
            found.append((one.name, *units.shown_apart(was, now, one.show), share(was, now)))
    return found


def share(before: float | None, after: float | None) -> str:
    """Return the relative change, such as `-75%`; empty where there is none."""
    return "" if not before or after is None or before == after else f"{(after - before) / before:+.0%}"


def _fraction(value: Any) -> float | None:
    return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else None
