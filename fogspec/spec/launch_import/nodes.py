"""One node, process or container of components, as the spec writes it."""

import json
import shlex
from typing import Any

from fogspec.spec.launch_import.found import Made, Place, Unknown
from fogspec.spec.launch_import.parameters import take
from fogspec.spec.launch_import.substitutions import Context

WORDS = (
    "package", "executable", "cmd", "name", "namespace", "parameters", "parameter_files", "remappings", "arguments", "prefix",
    "respawn", "respawn_delay", "env", "allow_substs", "composable_node_descriptions",
)  # fmt: skip
# How a process is shown and ended, which is no part of what runs.
QUIET = {
    "output", "output_format", "emulate_tty", "exec_name", "log_cmd", "cached_output", "sigterm_timeout", "sigkill_timeout",
    "condition", "_added", "machine", "stream_topics", "to_cloud", "launch_prefix_filter", "autostart",
}  # fmt: skip
NODE = {
    "package", "executable", "name", "namespace", "parameters", "remappings", "arguments", "ros_arguments", "additional_env",
    "prefix", "respawn", "respawn_delay", "composable_node_descriptions", "node_name", "node_executable", "node_namespace",
}  # fmt: skip
PROCESS = {"cmd", "additional_env", "prefix", "shell", "name", "respawn", "respawn_delay"}
LONGEST_COMMAND = 8 << 10


def tidy(raw: dict[str, Any]) -> dict[str, Any]:
    """Return the node with its keys in the order of the schema, without empty ones."""
    return {word: raw[word] for word in WORDS if raw.get(word) not in (None, "", [], {}, False)}


def node(context: Context, made: Made) -> dict[str, Any] | None:
    """Return a node; None if its package or executable is not known."""
    _others(context, made, NODE)
    package = _text(context, made, "package")
    executable = _text(context, made, "executable") or _text(context, made, "node_executable")
    if executable is None or (package is None and made.word("package") is not None):
        context.found.note(made.place, "a node without a known package and executable is left out")
        return None
    name = _text(context, made, "name") or _text(context, made, "node_name")
    raw: dict[str, Any] = {"package": package, "executable": executable, "name": name}
    raw["namespace"] = _namespace(context, made)
    raw["parameter_files"], raw["parameters"] = take(context, made.word("parameters"), made.place, full_name(raw))
    raw["allow_substs"] = bool(context.substituted.intersection(raw["parameter_files"]))
    raw["remappings"] = _remappings(context, made.word("remappings"), made.place)
    raw["arguments"] = words_of(context, made.word("arguments"), made.place, "arguments")
    ros = words_of(context, made.word("ros_arguments"), made.place, "ros_arguments")
    if ros:
        raw["arguments"] = [*raw["arguments"], "--ros-args", *ros, "--"]
    raw |= _started(context, made)
    components = made.word("composable_node_descriptions")
    if components is not None:
        raw["composable_node_descriptions"] = composable(context, components, made.place)
    return tidy(raw) if package is not None else _without_package(raw)


def process(context: Context, made: Made) -> dict[str, Any] | None:
    """Return a plain process; None if its command is not known."""
    _others(context, made, PROCESS)
    cmd = made.word("cmd", 0)
    argv = words_of(context, cmd if isinstance(cmd, (list, tuple)) else [cmd], made.place, "cmd")
    if not argv:
        context.found.note(made.place, "a process whose command is not known is left out")
        return None
    raw = _started(context, made)
    shell: Any = made.word("shell", default=False)
    if isinstance(shell, (Made, str, list)):
        shell = context.truth(shell, made.place) is True
    if prefix := raw.pop("prefix", None):
        argv = [*shlex.split(prefix), *argv]
    return tidy({**raw, "cmd": ["sh", "-c", " ".join(argv)] if shell is True else argv})


def composable(context: Context, items: Any, place: Place) -> list[dict[str, Any]]:
    """Return the components of a container."""
    found: list[dict[str, Any]] = []
    for one in items if isinstance(items, (list, tuple)) else [items]:
        if not isinstance(one, Made) or one.kind not in ("ComposableNode", "ComposableLifecycleNode"):
            where = one.place if isinstance(one, (Made, Unknown)) else place
            context.found.note(where, "a component is not taken over: only a launch determines it")
            continue
        if applies(context, one) is False:
            continue
        package, plugin = (
            _text(context, one, "package"),
            _text(context, one, "plugin") or _text(context, one, "node_plugin"),
        )
        if package is None or plugin is None:
            context.found.note(one.place, "a component without a known package and plugin is left out")
            continue
        name = _text(context, one, "name") or _text(context, one, "node_name")
        space = _namespace(context, one)
        files, values = take(context, one.word("parameters"), one.place, full_name({"namespace": space, "name": name}))
        _, extra = take_extra(context, one)
        raw = {
            "package": package, "plugin": plugin, "name": name, "namespace": space, "parameters": values,
            "parameter_files": files, "remappings": _remappings(context, one.word("remappings"), one.place),
            "extra_arguments": extra, "allow_substs": bool(context.substituted.intersection(files)),
        }  # fmt: skip
        found.append({key: value for key, value in raw.items() if value not in (None, "", [], {}, False)})
    return found


def take_extra(context: Context, made: Made) -> tuple[list[str], dict[str, Any]]:
    """Return the extra arguments of a component: what is pushed for nodes is not among them."""
    pushed = context.configurations.pop("global_params", None)
    try:
        return take(context, made.word("extra_arguments"), made.place)
    finally:
        if pushed is not None:
            context.configurations["global_params"] = pushed


def applies(context: Context, made: Made) -> bool:
    """Whether an action's condition holds; one that only a launch decides is noted and taken as if it did."""
    condition = made.word("condition")
    if condition is None:
        return True
    value = _condition(context, condition)
    if isinstance(value, Unknown):
        context.found.note(value.place, f"a condition is taken as true: {value.why}")
        return True
    return value


def _condition(context: Context, condition: Any) -> bool | Unknown:
    if isinstance(condition, Unknown):
        return condition
    if not isinstance(condition, Made):
        return Unknown(Place(context.file, 1), "it is not a condition")
    if condition.kind in ("IfCondition", "UnlessCondition"):
        value = context.truth(condition.word("predicate_expression", 0), condition.place)
        return value if isinstance(value, Unknown) else value is (condition.kind == "IfCondition")
    if condition.kind in ("LaunchConfigurationEquals", "LaunchConfigurationNotEquals"):
        name = context.perform(condition.word("launch_configuration_name", 0), condition.place)
        expected = condition.word("expected_value", 1)
        wanted = None if expected is None else context.perform(expected, condition.place)
        here = context.configurations.get(name) if isinstance(name, str) else name
        for one in (name, wanted, here):
            if isinstance(one, Unknown):
                return one
        return (here == wanted) is (condition.kind == "LaunchConfigurationEquals")
    return Unknown(condition.place, f"only a launch decides {condition.kind}")


def words_of(context: Context, value: Any, place: Place, what: str) -> list[str]:
    """Return a list of arguments, whole or not at all: one alone would change what the others mean."""
    if value is None:
        return []
    if isinstance(value, Unknown) or not isinstance(value, (list, tuple)):
        done = context.perform(value, place)
        if isinstance(done, str):
            return [done]
        context.found.note(done.place, f"{what} are not taken over: {done.why}")
        return []
    found: list[str] = []
    for one in value:
        text = context.perform(one, place)
        if isinstance(text, Unknown):
            context.found.note(text.place, f"{what} are not taken over: {text.why}")
            return []
        found.append(text)
    return found


def split(text: str) -> list[str]:
    """Return a command line as words; a very long one is split at spaces, because shlex takes quadratic time."""
    try:
        return shlex.split(text) if len(text) <= LONGEST_COMMAND else text.split()
    except ValueError:
        return text.split()


def full_name(raw: dict[str, Any]) -> str:
    """Return a node's full name."""
    return f"{(raw.get('namespace') or '').rstrip('/')}/{raw.get('name') or ''}"


def _without_package(raw: dict[str, Any]) -> dict[str, Any]:
    """Return a node whose executable is a path as a plain process with the same arguments."""
    argv = [raw["executable"], *raw["arguments"], "--ros-args"]
    if raw["name"]:
        argv += ["-r", f"__node:={raw['name']}"]
    if raw["namespace"]:
        argv += ["-r", f"__ns:={raw['namespace']}"]
    for path in raw["parameter_files"]:
        argv += ["--params-file", path]
    for key, value in raw["parameters"].items():
        argv += ["-p", f"{key}:={json.dumps(value, ensure_ascii=False)}"]
    for source, target in raw["remappings"].items():
        argv += ["-r", f"{source}:={target}"]
    kept = {key: raw.get(key) for key in ("respawn", "respawn_delay", "env")}
    return tidy({"cmd": [*shlex.split(raw.get("prefix") or ""), *argv], **kept})


def _text(context: Context, made: Made, name: str) -> str | None:
    value = made.word(name)
    if value is None:
        return None
    text = context.perform(value, made.place)
    if isinstance(text, Unknown):
        context.found.note(text.place, f"{name} is not taken over: {text.why}")
        return None
    return text


def _namespace(context: Context, made: Made) -> str | None:
    """Return the namespace as launch_ros puts it together of what is pushed and what the node says."""
    name = "namespace" if "namespace" in made.words else "node_namespace"
    own = _text(context, made, name)
    pushed = context.configurations.get("ros_namespace")
    full = joined(pushed if isinstance(pushed, str) else None, own)
    return None if full in (None, "/") else full


def joined(pushed: str | None, own: str | None) -> str | None:
    """Return a namespace below the pushed one, absolute."""
    if pushed is None and own is None:
        return None
    both = pushed if own is None else own if not pushed or own.startswith("/") else f"{pushed.rstrip('/')}/{own}"
    return "/" + str(both).strip("/")


def _remappings(context: Context, items: Any, place: Place) -> dict[str, str]:
    found: dict[str, str] = dict(context.configurations.get("ros_remaps", []))
    if isinstance(items, Unknown):
        context.found.note(items.place, f"remappings are not taken over: {items.why}")
        return found
    for one in items if isinstance(items, (list, tuple)) else []:
        if not isinstance(one, (list, tuple)) or len(one) != 2:
            where = one.place if isinstance(one, (Unknown, Made)) else place
            context.found.note(where, "a remapping is not taken over: it is not a pair of names")
            continue
        source, target = (context.perform(side, place) for side in one)
        for side in (source, target):
            if isinstance(side, Unknown):
                context.found.note(side.place, f"a remapping is not taken over: {side.why}")
                break
        else:
            # The first rule for a name is the one that has an effect.
            found.setdefault(str(source), str(target))
    return found


def _started(context: Context, made: Made) -> dict[str, Any]:
    """Return how a process is started: environment, prefix, and whether it is started again."""
    env = {key: value for key, value in context.environment.items() if isinstance(value, str)}
    for key, value in context.environment.items():
        if isinstance(value, Unknown):
            context.found.note(value.place, f"the environment variable {key} is not taken over: {value.why}")
    own = made.word("additional_env")
    for key, value in own.items() if isinstance(own, dict) else ():
        name, text = context.perform(key, made.place), context.perform(value, made.place)
        if isinstance(name, Unknown) or isinstance(text, Unknown):
            context.found.note(
                made.place, f"the environment variable {key} is not taken over: only a launch determines it"
            )
        else:
            env[name] = text
    if isinstance(own, Unknown):
        context.found.note(own.place, f"the environment is not taken over: {own.why}")
    raw: dict[str, Any] = {"env": env, "prefix": _text(context, made, "prefix")}
    respawn: Any = made.word("respawn", default=False)
    if isinstance(respawn, (Made, str, list, tuple)):
        respawn = context.truth(respawn, made.place)
    if isinstance(respawn, Unknown):
        context.found.note(respawn.place, f"respawn is not taken over: {respawn.why}")
    elif respawn:
        raw["respawn"] = True
        delay = made.word("respawn_delay")
        if isinstance(delay, (Made, str, list, tuple)):
            text = context.perform(delay, made.place)
            try:
                delay = float(text) if isinstance(text, str) else None
            except ValueError:
                delay = None
        if isinstance(delay, (int, float)) and delay > 0:
            raw["respawn_delay"] = f"{delay:g}s"
    return raw


def _others(context: Context, made: Made, known: set[str]) -> None:
    for word in sorted(made.words.keys() - known - QUIET):
        value = made.words[word]
        if value is None or value is False or value == []:
            continue
        where = value.place if isinstance(value, (Made, Unknown)) else made.place
        context.found.note(where, f"{word} is not taken over: a spec has no place for it")
