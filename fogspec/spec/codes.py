"""Stable codes of diagnostics: what each means, why it is so, what is wrong and what is right.

A code is never given a second meaning. FS1xx: the text as YAML; FS2xx: quantities; FS3xx: single fields; FS4xx: catalogs
and data; FS5xx: rules between fields; FS6xx: policies; FS7xx: generated files; FS8xx: launch files; FS9xx: this version's
limits.
"""

from typing import NamedTuple


class Code(NamedTuple):
    """A diagnostic's page: `wrong` and `right` are lines of a spec."""

    title: str
    why: str
    wrong: str = ""
    right: str = ""


TEXT = {
    "FS101": Code(
        "the file cannot be read",
        "A file that is named must be there, be readable, and be named once.",
    ),
    "FS102": Code(
        "the file must be in UTF-8",
        "YAML files are exchanged as UTF-8, with or without a byte order mark. Other encodings are not guessed.",
    ),
    "FS103": Code(
        "a control character is not text",
        "Control characters, line separators other than a line feed, and characters that turn the direction "
        "of reading hide what a file says. A tab may stand inside a text; CR LF is read as a line feed.",
    ),
    "FS104": Code(
        "the text must be YAML",
        "fogspec reads YAML 1.2. Quotes and brackets must be closed, and a text with ': ' or ' #' in it needs quotes.",
        'package: "fogros2_examples',
        "package: fogros2_examples",
    ),
    "FS105": Code(
        "indentation must be spaces",
        "YAML forbids tabs in indentation, because editors show them in different widths.",
        "spec:\n<tab>probe: {callback: plan}",
        "spec:\n  probe: {callback: plan}",
    ),
    "FS106": Code(
        "a key is set twice",
        "Most YAML readers silently keep the last of two equal keys; one of them is a mistake.",
        "alpha: 0.7\nalpha: 0.3",
        "alpha: 0.7",
    ),
    "FS107": Code(
        "an alias must be bounded and complete",
        "An alias (*name) repeats what an anchor (&name) marked before. A few lines of aliases of aliases "
        "would make a document of any size, so each use counts: 100000 values a file at most.",
        "cloud: &nodes [*nodes]",
        "cloud: &nodes [{package: a, executable: b}]\nrobot: *nodes",
    ),
    "FS108": Code(
        "merge keys are not part of YAML 1.2",
        "'<<' was an extension of YAML 1.1. Shared parts belong into an overlay.",
        "stop: {<<: *usual, requests: 100}",
        "stop: {requests: 100, duration: 5min}",
    ),
    "FS109": Code(
        "tags are not part of the language",
        "A tag such as !!str or !include asks a reader to make something else of a value. A spec is plain data.",
        "name: !!str 5",
        "name: '5'",
    ),
    "FS110": Code(
        "a word or number must mean the same to every reader",
        "fogspec reads YAML 1.2, ROS 2 and SkyPilot read YAML 1.1, where yes, no, on and off are true or "
        "false, 010 is 8, 5:00 is 300 and 1_000 is 1000. Such a scalar is refused unless it is in quotes. "
        "1e-3 is a number, null and ~ are null.",
        "spot: no",
        "spot: false",
    ),
    "FS111": Code(
        "a number must be finite and of usual size",
        "Not-a-number and infinity have no place in a spec, a whole number fits into 64 bits, and a number "
        "has at most 40 characters.",
        "alpha: .nan",
        "alpha: 0.5",
    ),
    "FS112": Code(
        "the file is too large or too deep",
        "A spec has at most 1 MiB and is nested at most 64 deep, so that reading any file ends soon. Data "
        "belong into files of their own.",
    ),
    "FS113": Code(
        "a key must be a text",
        "A key is a plain word or a text in quotes.",
        "{a: b}: 1",
        "ab: 1",
    ),
    "FS114": Code(
        "the file must have a document",
        "An empty file is more likely a mistake than a wish.",
        "# nothing here",
        "apiVersion: fogspec.dev/v1alpha1\nkind: Application\n...",
    ),
    "FS115": Code(
        "a key must have a value",
        "A key with nothing behind it is usually a line that was not finished, or whose lines below are not "
        "indented. Where a field may be switched off, write null.",
        "constraints:\n",
        "constraints:\n  latency: 2s",
    ),
    "FS116": Code(
        "a line must be indented under its key",
        "The line stands at the level of the key that it belongs to, and that key has nothing behind it.",
        "metadata:\nname: arm",
        "metadata:\n  name: arm",
    ),
}

QUANTITIES = {
    "FS201": Code(
        "a rate or price must say per what",
        "0.01 could be per request, per hour or per thousand requests: 100 times apart is easily written.",
        "cost: $0.001",
        "cost: $0.001/request",
    ),
    "FS202": Code(
        "a quantity must have its unit",
        "A bare number leaves open whether 2 are seconds or minutes, GiB or GB, dollars or cents.",
        "latency: 2",
        "latency: 2s",
    ),
    "FS203": Code(
        "a unit must be one that the language knows",
        "Durations: ns, us, ms, s, min, h. Memory: MiB, GiB, TiB (powers of 1024), MB, GB, TB (powers of "
        "1000). M and m are too easily taken for something else.",
        "duration: 5m",
        "duration: 5min",
    ),
    "FS204": Code(
        "a quantity must be a number and its unit",
        "Numbers are not negative, finite, and use a decimal point.",
        "latency: fast",
        "latency: 50ms",
    ),
    "FS205": Code(
        "a range goes from the smaller to the larger value",
        "2..64, 2.. (at least), ..64 (at most), or 4 (exactly).",
        "cpus: 64..2",
        "cpus: 2..64",
    ),
    "FS206": Code(
        "a number must be within its limits",
        "The message says which limits; `fogspec explain FIELD` says what they mean.",
        "alpha: 1.5",
        "alpha: 1",
    ),
}

FIELDS = {
    "FS301": Code(
        "a key must be a field of the language",
        "A misspelt key would be ignored otherwise, and a limit that is ignored costs money. Keys of your own "
        "start with x- and are ignored.",
        "latancy: 2s",
        "latency: 2s",
    ),
    "FS302": Code(
        "a field is missing",
        "A few fields have no sensible default.",
        "kind: Application",
        "kind: Application\nmetadata: {name: arm}",
    ),
    "FS303": Code(
        "a value must be of its field's kind",
        "A text is no number and no list of one, even where it looks like it.",
        "infra: aws",
        "infra: [aws]",
    ),
    "FS304": Code(
        "a value must be one of those that are known",
        "The message lists them.",
        "sampler: gird",
        "sampler: grid",
    ),
    "FS305": Code(
        "a name must be made of the characters that all its users accept",
        "metadata.name becomes part of names of clusters, files and cloud labels (RFC 1123); names of "
        "metrics, callbacks and secrets become identifiers.",
        "name: Grasp_planning",
        "name: grasp-planning",
    ),
    "FS306": Code(
        "a list must have an entry",
        "An empty list here would leave nothing to do.",
        "infra: []",
        "infra: [aws]",
    ),
    "FS307": Code(
        "apiVersion and kind say what the document is",
        "fogspec reads `kind: Application` of apiVersion fogspec.dev/v1alpha1.",
        "kind: Deployment",
        "kind: Application",
    ),
    "FS308": Code(
        "a key was renamed",
        "The key had another name in an earlier version. Its value keeps its meaning: only the name changes.",
        "stop: {steps: 100, after: 5min}",
        "stop: {requests: 100, duration: 5min}",
    ),
}

DATA = {
    "FS401": Code(
        "a table must have its columns and sound values",
        "A catalog is a CSV file in SkyPilot's columns. A price that is missing is no offer, and never $0; a "
        "price that is no number is a mistake.",
    ),
    "FS402": Code(
        "a suite of measurements must be whole and sound",
        "machines.csv, latencies.csv and problems.jsonl belong together: every machine and workload that is named is "
        "there, and latencies are positive and finite.",
    ),
}

POLICIES = {
    "FS601": Code(
        "a document must meet the team's policies",
        "A JSON Schema in policies/, or one named by --policy, is broken. It sees the document that `fogspec config` prints, "
        "with quantities as numbers in base units. Where the spec does not set the value, the line around it is shown.",
    ),
    "FS602": Code(
        "a policy must be a JSON Schema of its own",
        "A policy is a JSON file in JSON Schema 2020-12, about Application or DeploymentManifest, and names fields that "
        "such a document has. A `$ref` stays within the file: nothing is fetched.",
    ),
}

GENERATED = {
    "FS701": Code(
        "a generated file must be as it was written",
        "Its first line has the command that makes it again.",
    ),
}

LAUNCHES = {
    "FS801": Code(
        "the launch file cannot be read",
        "`init --from-launch` reads Python by its syntax tree, XML without DOCTYPE and entities, and YAML with a list under "
        "'launch:'. It never runs a launch file.",
    ),
    "FS802": Code(
        "a part of the launch file was not taken over",
        "A launch file is a program. What only running it would tell, and what a spec has no place for, is said and left out; "
        "check it by hand.",
    ),
}
