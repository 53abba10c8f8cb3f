"""Pages of the reference that need the command line and the whole of docs/: `python -m tests.docs.reference [--check]`.

Fields and codes are written by `python -m tools.json_schemas`, from the same types.
"""

import importlib
import io
import json
import re
import sys
from pathlib import Path
from typing import Any

import click
from ruamel.yaml import YAML

from fogspec.base import errors
from fogspec.cli import EXAMPLES, GROUPS, VERBS, fogspec
from fogspec.deploy.conformance import STEPS
from fogspec.spec.field_docs import FieldPage, pages
from tools.generated import write_or_check
from tools.json_schemas import KINDS, model_of

ROOT = Path(__file__).resolve().parents[2]
NOTE = "<!-- Generated: do not edit. Make it again: python -m tests.docs.reference -->\n"
WHERE = {
    "Application": ("specs/NAME.yaml", "people"),
    "SamplingPlan": ("compiled/NAME/plan.yaml", "`fogspec compile`"),
    "Results": ("results/NAME.yaml", "`fogspec bench`"),
    "Models": ("compiled/NAME/models.yaml", "`fogspec compile`, once there are results"),
    "Menu": ("compiled/NAME/menu.yaml", "`fogspec compile`, once there are results"),
    "DeploymentManifest": ("compiled/NAME/manifest.yaml", "`fogspec compile`, when a machine meets the limits"),
    "Lock": ("fogspec.lock", "`fogspec lock`"),
    "LiveState": (".fogspec/NAME/deployment.yaml", "`fogspec apply`; not in git"),
    "SharedState": ("state.yaml in refs/fogspec/state/NAME-…", "`fogspec apply`, where clones share the state"),
    "Project": ("fogspec.yaml", "you; optional"),
}
EXAMPLE = "grasp-planning-recorded"
EXAMPLE_FILES = {
    "SamplingPlan": f"compiled/{EXAMPLE}/plan.yaml",
    "Results": f"results/{EXAMPLE}.yaml",
    "Models": f"compiled/{EXAMPLE}/models.yaml",
    "Menu": f"compiled/{EXAMPLE}/menu.yaml",
    "DeploymentManifest": f"compiled/{EXAMPLE}/manifest.yaml",
}
EVERYWHERE = ("quiet", "verbose")
ALL_COMMANDS = """
Every command takes, before or after its name:

- `-q`, `--quiet`: print only errors and the result: no notes, no progress, no warnings, no next command. A price that you have
  to approve is still shown.
- `-v`, `--verbose`: also print, on standard error, which files, catalog and machine library are read, with their digests, and
  how long each stage takes.
- `-h`, `--help`

Results are on standard output; errors, notes and progress on standard error. On a terminal, lines are broken at its width;
elsewhere a sentence is one line, and tables and charts are 80 columns wide. `COLUMNS` sets another width. `NO_COLOR` turns
colors off, which repeat what words say. A command that another one usually follows ends with a line `next:`, with the
options that it needs too. [JSON for programs](../explanation/numbers.md#json-for-programs) has numbers, with the unit in
the key."""
OTHER_ENDS = {
    0: "Done; nothing differs.",
    70: "A bug in fogspec: one paragraph to paste into an issue.",
    130: "The user stopped it: safe to run again.",
}


def verbs_page() -> str:
    """docs/reference/verbs.md, from the command line itself."""
    parts = [NOTE, "# Commands\n", "`fogspec COMMAND --help` prints the same.", ALL_COMMANDS]
    for title, names in GROUPS.items():
        parts.append(f"\n**{title}**\n\n| command | purpose |\n|--|--|")
        parts += [f"| [`{verb}`](#{verb}) | {VERBS[verb]} |" for verb in names]
    context = click.Context(fogspec, info_name="fogspec")
    for verb in (verb for names in GROUPS.values() for verb in names):
        command = fogspec.get_command(context, verb)
        assert command is not None
        parts += _verb(command, click.Context(command, info_name=verb, parent=context), 2)
    parts += ["\n## Exit codes\n", "| code | meaning |\n|--|--|"]
    parts += [f"| {code} | {meaning} |" for code, meaning in sorted(_exit_codes().items())]
    return "\n".join(parts) + "\n"


def _verb(command: click.Command, context: click.Context, level: int) -> list[str]:
    title = context.command_path.removeprefix("fogspec ")
    usage = " ".join([context.command_path, *command.collect_usage_pieces(context)])
    parts = [f"\n{'#' * level} {title}\n", f"```text\n{usage}\n```\n", _paragraphs(command.help or "")]
    options = [one for one in command.params if isinstance(one, click.Option) and one.name not in EVERYWHERE]
    rows = [one.get_help_record(context) for one in options]
    if rows:
        parts.append("\n| option | meaning |\n|--|--|")
    parts += [f"| `{row[0].replace('|', chr(92) + '|')}` | {_cell(row[1])} |" for row in rows if row]
    if title in EXAMPLES:
        parts.append(f"\nExample: `{EXAMPLES[title]}`")
    if isinstance(command, click.Group):
        for name in command.list_commands(context):
            inner = command.get_command(context, name)
            assert inner is not None
            parts += _verb(inner, click.Context(inner, info_name=name, parent=context), level + 1)
    return parts


def _exit_codes() -> dict[int, str]:
    kinds = [kind for kind in vars(errors).values() if isinstance(kind, type) and kind is not errors.FogspecError]
    found: dict[int, str] = {}
    for kind in kinds:
        found[kind.exit_code] = " ".join([*found.get(kind.exit_code, "").split(), *(kind.__doc__ or "").split()])
    return OTHER_ENDS | found


def files_page() -> str:
    """docs/reference/files.md, from the types of the files."""
    parts = [NOTE, "# Files\n"]
    parts.append("Each file below is YAML 1.2 with a JSON Schema in `schemas/`. Files that fogspec writes name in their first "
                 "line the command that regenerates them.\n")  # fmt: skip
    parts.append("| kind | where | written by | schema |\n|--|--|--|--|")
    for kind in KINDS:
        where, by = WHERE[kind]
        parts.append(f"| [{kind}](#{kind.lower()}) | `{where}` | {by} | `schemas/{kind}.json` |")
    parts.append(
        "\nOther files: `environments/ENVIRONMENT.yaml` is an overlay, for which `compiled/NAME@ENVIRONMENT/` has menu and "
        "manifest; `compiled/NAME/*.svg` are charts, `report.html` the page of `fogspec report`, `*.launch.py` and "
        "`link/` what both sides start; `compiled/agent.pyz` runs on every machine; `compiled/NAME/tasks/*.sky.yaml` and "
        "`deploy.sky.yaml` are SkyPilot tasks, as `sky launch` reads them; `.fogspec/` is live state and stays out of git."
    )
    for kind in KINDS:
        parts.append(f"\n## {kind}\n")
        if kind == "Application":
            parts.append("Its fields have [a page of their own](fields.md).")
            continue
        parts += [f"{_paragraphs(model_of(kind).__doc__ or '')}\n", "| field | type |\n|--|--|"]
        parts += [_row(page) for page in pages(model_of(kind))]
        if kind in EXAMPLE_FILES:
            parts.append(
                f"\nFrom `{EXAMPLE_FILES[kind]}`, lists and digests shortened:\n\n```text\n{_excerpt(kind)}```"
            )
    return "\n".join(parts) + "\n"


def _excerpt(kind: str) -> str:
    """Return a committed file of this kind, with the first entries of its lists and of its maps of digests."""
    yaml, out = YAML(typ="safe", pure=True), io.StringIO()
    yaml.default_flow_style, yaml.width, yaml.sort_base_mapping_type_on_output = False, 200, False
    yaml.dump(_shortened(yaml.load((ROOT / EXAMPLE_FILES[kind]).read_text("utf-8"))), out)
    return out.getvalue()


def _shortened(value: Any) -> Any:
    if isinstance(value, list):
        return [_shortened(one) for one in value[:1]]
    if isinstance(value, dict):
        digests = len(value) > 3 and all(re.fullmatch(r"(sha256:)?[0-9a-f]{12,64}", str(one)) for one in value.values())
        return {name: _shortened(one) for name, one in list(value.items())[: 2 if digests else None]}
    return value


def _row(page: FieldPage) -> str:
    meaning = f"; {page.meaning}" if page.meaning else ""
    return f"| `{page.path}` | {_cell(page.type + meaning)} |"


ENGINES = {
    "local": "this host",
    "slurm": "SkyPilot on Slurm",
    "aws-moto": "SkyPilot on AWS's API (simulated EC2)",
    "kubernetes": "Kubernetes",
    "aws": "AWS",
    "gcp": "Google Cloud",
    "azure": "Azure",
}
EXERCISED = re.compile(r"(<!-- conformance -->\n).*?(<!-- /conformance -->\n)", re.DOTALL)
MARKS = {"ok": "ok", "failed": "**failed**", "not run": "-"}


def support_page() -> str:
    """docs/reference/support.md, with what `fogspec conformance` exercised, from the reports in tests/data/conformance."""
    folder = ROOT / "tests" / "data" / "conformance"
    found = {name: _report(folder / f"{name}.json") for name in ENGINES}
    ran = {name: report for name, report in found.items() if report is not None}
    rows = [f"| | {' | '.join(ENGINES[name] for name in ran)} |", f"|--|{'--|' * len(ran)}"]
    rows.append(f"| date | {' | '.join(one['began'] for one in ran.values())} |")
    rows.append(f"| versions | {' | '.join(_versions(one['versions']) for one in ran.values())} |")
    for step, meaning in STEPS.items():
        states = [
            next((one["state"] for one in report["steps"] if one["name"] == step), "not run") for report in ran.values()
        ]
        rows.append(f"| {meaning} | {' | '.join(MARKS[state] for state in states)} |")
    never = ", ".join(title for name, title in ENGINES.items() if name not in ran)
    beside = "no virtual machine of a cloud, no quota of an account, no GPU"
    text = "\n".join([*rows, "", f"**Never exercised by it**: {never}; {beside}.\n"])
    page = (ROOT / "docs" / "reference" / "support.md").read_text("utf-8")
    return EXERCISED.sub(lambda block: f"{block[1]}{text}{block[2]}", page)


def _report(path: Path) -> dict[str, Any] | None:
    return json.loads(path.read_text("utf-8")) if path.exists() else None


def _versions(versions: dict[str, str]) -> str:
    return ", ".join(f"{name} {version}" for name, version in versions.items())


def decisions_page() -> str:
    """docs/adr/README.md: an index of the decisions."""
    intro = "Architecture decision records: one page per decision, with its context and consequences.\n"
    parts = [NOTE, "# Decisions\n", intro, "| decision | status |\n|--|--|"]
    for path in sorted((ROOT / "docs" / "adr").glob("[0-9]*.md")):
        if path.name.startswith("0000"):
            continue
        text = path.read_text("utf-8")
        title = text.splitlines()[0].removeprefix("# ")
        status = re.search(r"^Status: (.*?)[.;\n]", text, re.MULTILINE)
        parts.append(f"| [{title}]({path.name}) | {status[1] if status else ''} |")
    return "\n".join(parts) + "\n"


def _cell(text: Any) -> str:
    return re.sub(r"\s+", " ", str(text)).replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")


def _paragraphs(text: str) -> str:
    return "\n\n".join(" ".join(part.split()) for part in text.strip().split("\n\n"))


def generated() -> dict[Path, str]:
    """Each page with its text."""
    importlib.import_module("fogspec.cli")
    reference = ROOT / "docs" / "reference"
    return {
        reference / "verbs.md": verbs_page(),
        reference / "files.md": files_page(),
        reference / "support.md": support_page(),
        ROOT / "docs" / "adr" / "README.md": decisions_page(),
    }


if __name__ == "__main__":
    sys.exit(write_or_check(generated(), sys.argv[1:], "python -m tests.docs.reference"))
