"""What the real `launch` would start: its own code plays a launch file, and no process is started.

Runs in a Python that has ROS 2's `launch`, `launch_ros`, `launch_xml`, `launch_yaml` and `rclpy`. Reads one question as JSON
on each line of standard input, `{"file": ..., "arguments": {...}, "packages": {name: share folder}}`, and answers with one
line of JSON: `{"started": [...]}` or `{"failed": "..."}`. Packages that are not named are taken to be installed below
`INSTALLED`; timers and event handlers are played at once, as if what they wait for had come.
"""

import json
import os
import signal
import sys
import tempfile
import types
from pathlib import Path
from typing import Any

INSTALLED = "/opt/ros/share"
SECONDS = 20
ARGUMENT_PAIRS = ("-r", "--remap", "-p", "--param", "--params-file", "--log-level", "--enclave", "-e")


def main() -> None:
    """Answer every question in a child of its own: a launch file is a program, and may do what it likes."""
    _stand_ins()
    for name, value in {"ROS_DISTRO": "jazzy", "ROS_VERSION": "2", "ROS_PYTHON_VERSION": "3"}.items():
        os.environ.setdefault(name, value)  # as where ROS 2 is sourced
    for line in sys.stdin:
        read, write = os.pipe()
        if (child := os.fork()) == 0:
            os.close(read)
            signal.alarm(SECONDS)
            answer = _answer(json.loads(line))
            with os.fdopen(write, "w") as file:
                file.write(json.dumps(answer, sort_keys=True, default=str))
            os._exit(0)
        os.close(write)
        with os.fdopen(read) as file:
            text = file.read()
        os.waitpid(child, 0)
        print(text or json.dumps({"failed": "it ended without an answer"}), flush=True)


def _answer(question: dict[str, Any]) -> dict[str, Any]:
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
    try:
        with tempfile.TemporaryDirectory() as folder:
            tempfile.tempdir = folder
            os.environ["ROS_LOG_DIR"] = folder
            os.environ["ROS_HOME"] = folder
            return {"started": _Play(question, folder).started()}
    except BaseException as problem:
        return {"failed": f"{type(problem).__name__}: {problem}"[:400]}


def _stand_ins() -> None:
    """Put what no wheel brings in its place: the message type that loads a component, and entry points."""
    try:
        import composition_interfaces.srv  # noqa: F401
    except ImportError:
        srv = types.ModuleType("composition_interfaces.srv")

        class LoadNode:
            class Request:
                def __init__(self) -> None:
                    self.package_name = self.plugin_name = self.node_name = self.node_namespace = ""
                    self.remap_rules, self.parameters, self.extra_arguments = [], [], []

        srv.LoadNode = LoadNode  # type: ignore[attr-defined]
        package = types.ModuleType("composition_interfaces")
        package.srv = srv  # type: ignore[attr-defined]
        sys.modules |= {"composition_interfaces": package, "composition_interfaces.srv": srv}
    if "importlib_metadata" not in sys.modules:
        import importlib.metadata

        sys.modules.setdefault("importlib_metadata", importlib.metadata)
    # Once, for all children.
    import launch_ros.actions  # noqa: F401
    import launch_xml  # noqa: F401
    import launch_yaml  # noqa: F401
    import rclpy  # noqa: F401


class _Play:
    def __init__(self, question: dict[str, Any], temporary: str) -> None:
        self.question, self.temporary = question, temporary
        self.packages: dict[str, str] = question.get("packages", {})
        self.found: list[dict[str, Any]] = []
        self.later: list[Any] = []
        self.loaded: list[tuple[str, list[dict[str, Any]]]] = []

    def share(self, package: str, *_: Any, **__: Any) -> str:
        return self.packages.get(str(package), f"{INSTALLED}/{package}")

    def started(self) -> list[dict[str, Any]]:
        self._patch()
        from launch import LaunchContext
        from launch.actions import IncludeLaunchDescription
        from launch.launch_description_sources import AnyLaunchDescriptionSource

        self.before = dict(os.environ)
        context = LaunchContext(argv=[])
        arguments = list(self.question.get("arguments", {}).items())
        self._visit(
            IncludeLaunchDescription(AnyLaunchDescriptionSource(self.question["file"]), launch_arguments=arguments),
            context,
            real=True,
        )
        while self.later:
            self._visit(self.later.pop(0), context)
        for name, components in self.loaded:
            container = next((one for one in self.found if one.get("full_name") == name), None)
            if container is None:
                self.found.append({"kind": "load", "container": name, "components": components})
            else:
                container.setdefault("components", []).extend(components)
        for one in self.found:
            one.pop("full_name", None)
        return self.found

    def _visit(self, entity: Any, context: Any, real: bool = False) -> None:
        self.root = entity if real else getattr(self, "root", None)
        for below in entity.visit(context) or []:
            self._visit(below, context)

    def _patch(self) -> None:
        import ament_index_python.packages as index

        index.get_package_share_directory = self.share
        index.get_package_share_path = lambda name, *_: Path(self.share(name))
        index.get_package_prefix = self.share
        import ament_index_python

        for name in ("get_package_share_directory", "get_package_share_path", "get_package_prefix"):
            setattr(ament_index_python, name, getattr(index, name))
        import launch
        import launch.frontend.parse_substitution as grammar
        import launch_xml
        import launch_yaml

        folder = Path(launch.__file__).parents[1] / "share" / "launch" / "frontend" / "grammar.lark"
        if folder.is_file():
            grammar.get_grammar_path = lambda: str(folder)
        from launch.frontend import Parser

        Parser.extensions_loaded = True
        Parser.frontend_parsers = {"xml": launch_xml.Parser, "yaml": launch_yaml.Parser}
        self._patch_substitutions()
        self._patch_actions()
        import launch_ros.actions.node as node

        node.get_extensions = lambda *_: {}
        node.os = _Installed()
        for module in ("set_parameters_from_file", "load_composable_nodes"):
            __import__(f"launch_ros.actions.{module}")
        xacro = types.ModuleType("xacro")

        class Document:
            def __init__(self, text: str) -> None:
                self.text = text

            def toxml(self, *_: Any, **__: Any) -> str:
                return self.text

            toprettyxml = toxml

        def process_file(path: Any, mappings: dict[str, Any] | None = None, **_: Any) -> Document:
            words = "".join(f" {key}:={value}" for key, value in (mappings or {}).items())
            return Document(f"$(command 'xacro {path}{words}')")

        xacro.process_file = process_file  # type: ignore[attr-defined]
        xacro.process = lambda *a, **k: process_file(*a, **k).text  # type: ignore[attr-defined]
        sys.modules["xacro"] = xacro

    def _patch_substitutions(self) -> None:
        import launch.substitutions
        import launch_ros.substitutions
        from launch.utilities import perform_substitutions

        def command(self: Any, context: Any) -> str:
            return f"$(command '{perform_substitutions(context, self.command)}')"

        launch.substitutions.Command.perform = command
        launch.substitutions.FindExecutable.perform = lambda self, context: perform_substitutions(context, self.name)
        launch_ros.substitutions.ExecutableInPackage.perform = lambda self, context: (
            f"<{perform_substitutions(context, self.package)}>/{perform_substitutions(context, self.executable)}"
        )
        if not hasattr(launch.substitutions, "PathSubstitution"):  # of later versions

            class PathSubstitution(launch.substitutions.PathJoinSubstitution):
                def __init__(self, path: Any) -> None:
                    super().__init__([path])
                    self.parts = [path]

                def __truediv__(self, other: Any) -> Any:
                    longer = launch.substitutions.PathJoinSubstitution([*self.parts, other])
                    longer.__class__ = PathSubstitution
                    longer.parts = [*self.parts, other]
                    return longer

            launch.substitutions.PathSubstitution = PathSubstitution
        launch_ros.substitutions.FindPackageShare.find = lambda _, name: self.share(name)
        launch_ros.substitutions.FindPackagePrefix.find = lambda _, name: self.share(name)

    def _patch_actions(self) -> None:
        import launch.actions
        import launch_ros.actions
        from launch.actions.execute_local import ExecuteLocal
        from launch.utilities import perform_substitutions

        play = self

        def execute(action: Any, context: Any) -> None:
            action.prepare(context)
            play.process(action, context)

        ExecuteLocal.execute = execute
        launch.actions.TimerAction.execute = lambda action, context: list(action.actions)

        def handler(action: Any, context: Any) -> None:
            if type(action.event_handler).__name__ != "OnShutdown":
                play.later.extend(one for one in action.event_handler.describe()[1] if hasattr(one, "visit"))

        launch.actions.RegisterEventHandler.execute = handler
        for name in ("EmitEvent", "UnregisterEventHandler", "Shutdown", "LogInfo"):
            if hasattr(launch.actions, name):
                getattr(launch.actions, name).execute = lambda action, context: None
        if hasattr(launch_ros.actions, "LifecycleTransition"):
            launch_ros.actions.LifecycleTransition.execute = lambda action, context: None
        launch_ros.actions.LifecycleNode.execute = lambda action, context: launch_ros.actions.Node.execute(
            action, context
        )
        real = launch.actions.IncludeLaunchDescription.execute

        def include(action: Any, context: Any) -> Any:
            source = action.launch_description_source
            play.installed(source, context)
            try:
                return real(action, context)
            except Exception:
                if os.path.exists(str(source.location)) or play.root is action:
                    raise
                words = [
                    [perform_substitutions(context, _subs(one)) for one in pair] for pair in action.launch_arguments
                ]
                env = {key: value for key, value in context.environment.items() if play.before.get(key) != value}
                play.found.append({"kind": "include", "file": str(source.location), "arguments": words, "env": env})
                return [launch.actions.SetLaunchConfiguration(key, value) for key, value in words]

        launch.actions.IncludeLaunchDescription.execute = include

        def load(action: Any, context: Any) -> None:
            from launch_ros.actions.load_composable_nodes import get_composable_node_load_request as request

            target = action._LoadComposableNodes__target_container
            name = target.node_name if hasattr(target, "node_name") else perform_substitutions(context, _subs(target))
            some = [request(one, context) for one in action._LoadComposableNodes__composable_node_descriptions]
            full = name if name.startswith("/") else f"/{name}"
            play.loaded.append((full, [_component(one) for one in some if one is not None]))

        launch_ros.actions.LoadComposableNodes.execute = load

    def installed(self, source: Any, context: Any) -> None:
        """Find a file that a package's build installs to another folder than the one it is written in."""
        from launch.utilities import perform_substitutions

        given = source._LaunchDescriptionSource__location
        if source._LaunchDescriptionSource__launch_description is not None:
            return
        path = Path(perform_substitutions(context, list(given)))
        owner = next((Path(one) for one in self.packages.values() if str(path).startswith(f"{one}/")), None)
        if path.exists() or owner is None:
            return
        found = [one for one in (*owner.glob(f"*/{path.name}"), *owner.glob(f"*/*/{path.name}")) if one.is_file()]
        if len(found) == 1:
            source._LaunchDescriptionSource__location = _subs(str(found[0]))

    def process(self, action: Any, context: Any) -> None:
        """Note one process as it would be started, with what it is told in words that do not depend on temporary files."""
        details = action.process_details
        argv, env = list(details["cmd"]), details["env"] or {}
        changed = {key: value for key, value in env.items() if self.before.get(key) != value and key != "ROS_LOG_DIR"}
        fact: dict[str, Any] = {"kind": "process", "argv": argv, "env": changed}
        if getattr(action, "shell", False):
            fact["shell"] = True
        place = next((i for i, word in enumerate(argv) if word.startswith("<") and ">/" in word), None)
        if place is not None or "--ros-args" in argv:
            fact = {"kind": "node", "env": changed, **_words(argv, place or 0, self.temporary)}
            full = getattr(action, "node_name", "")
            fact["full_name"] = full if isinstance(full, str) else ""
        self.found.append(fact)


class _Installed:
    """`os` for launch_ros' Node, where files of packages that are not here count as files."""

    class path:
        @staticmethod
        def isfile(name: str) -> bool:
            return os.path.isfile(name) or not str(name).startswith(tempfile.gettempdir())

        def __getattr__(self, name: str) -> Any:
            return getattr(os.path, name)

        abspath = staticmethod(os.path.abspath)
        join = staticmethod(os.path.join)
        basename = staticmethod(os.path.basename)

    def __getattr__(self, name: str) -> Any:
        return getattr(os, name)


def _subs(value: Any) -> Any:
    from launch.utilities import normalize_to_list_of_substitutions

    return normalize_to_list_of_substitutions(value)


def _component(request: Any) -> dict[str, Any]:
    from rclpy.parameter import parameter_value_to_python

    def values(some: Any) -> dict[str, Any]:
        return {one.name: _plain(parameter_value_to_python(one.value)) for one in some}

    return {
        "package": request.package_name,
        "plugin": request.plugin_name,
        "name": request.node_name,
        "namespace": request.node_namespace,
        "remappings": list(request.remap_rules),
        "parameters": values(request.parameters),
        "extra_arguments": values(request.extra_arguments),
    }


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, (tuple, list)) or hasattr(value, "tolist") else value


def _words(argv: list[str], place: int, temporary: str) -> dict[str, Any]:
    """Return a node's command by its parts: program, arguments, name, namespace, remappings, parameters in effect."""
    import yaml

    fact: dict[str, Any] = {"executable": argv[place], "prefix": argv[:place], "arguments": [], "remappings": []}
    sequence: list[list[Any]] = []
    others: list[str] = []
    inside, words = False, iter(argv[place + 1 :])
    for word in words:
        if word == "--ros-args":
            inside = True
        elif inside and word == "--":
            inside = False
        elif not inside:
            fact["arguments"].append(word)
        elif word not in ARGUMENT_PAIRS:
            others.append(word)
        else:
            value = next(words, "")
            if word in ("-r", "--remap"):
                key, _, new = value.partition(":=")
                if key in ("__node", "__ns"):
                    fact[{"__node": "name", "__ns": "namespace"}[key]] = new
                else:
                    fact["remappings"].append([key, new])
            elif word in ("-p", "--param"):
                key, _, text = value.partition(":=")
                sequence.append(["values", {key: _plain(yaml.full_load(text))}])
            elif word == "--params-file":
                sequence.append(_parameters(value, temporary))
            else:
                others += [word, value]
    return {**fact, "sequence": sequence, "ros_arguments": others}


def _parameters(path: str, temporary: str) -> list[Any]:
    """Return a parameter file by its name, or by its content where launch or the spec has written it."""
    import yaml

    if not path.startswith(temporary) and not os.path.dirname(path).endswith("scored.params"):
        return ["file", _file(path)]
    content = yaml.full_load(Path(path).read_text("utf-8")) or {}
    if os.path.basename(path).startswith("launch_params_") and len(content) == 1:
        # launch_ros writes a dictionary of parameters to a file of one node.
        ((_, below),) = content.items()
        if isinstance(below, dict) and set(below) == {"ros__parameters"}:
            return ["values", {key: _plain(one) for key, one in _flat(below["ros__parameters"])}]
    return ["file", json.dumps(content, sort_keys=True, default=str)]


def _flat(values: Any, prefix: str = "") -> list[tuple[str, Any]]:
    found: list[tuple[str, Any]] = []
    for key, value in (values or {}).items():
        found += _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else [(f"{prefix}{key}", value)]
    return found


def _file(path: str) -> str:
    return os.path.normpath(path)


if __name__ == "__main__":
    main()
