"""Actions played in the order in which `launch` visits them, with its scopes, conditions and includes."""

import os.path
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.files import read_bounded
from fogspec.base.yaml import reader
from fogspec.spec.launch_import import nodes
from fogspec.spec.launch_import.fogros import cloud_node, description, is_cloud
from fogspec.spec.launch_import.found import (
    DEEPEST,
    MOST_BYTES,
    MOST_FILES,
    SHARE,
    LaunchImport,
    Made,
    Place,
    Unknown,
    refuse,
)
from fogspec.spec.launch_import.interpreter import Interpreter
from fogspec.spec.launch_import.library import Library
from fogspec.spec.launch_import.packages import Packages
from fogspec.spec.launch_import.parameters import flat, push
from fogspec.spec.launch_import.program import Function, Raised, Scope, key_of
from fogspec.spec.launch_import.substitutions import Context, parsed_expression

DESCRIPTIONS = {"LaunchDescription", "FogROSLaunchDescription"}
SILENT = {
    "SkyLaunchDescription",
    "PushEnvironment",
    "PopEnvironment",
    "LogInfo",
    "UnregisterEventHandler",
    "SetROSLogDir",
    "SetLaunchLogDir",
    "LogDebug",
    "LogWarning",
    "LogError",
}
PROCESSES = {"ExecuteProcess", "ExecuteLocal"}
EVENTS = (
    "on_start",
    "on_exit",
    "on_completion",
    "on_stdout",
    "on_stderr",
    "on_stdin",
    "entities",
    "on_shutdown",
    "on_matched",
)
# Variables that a sourced ROS 2 has on every machine; others are taken to be unset before the launch.
EVERYWHERE = {"PATH", "LD_LIBRARY_PATH", "PYTHONPATH", "AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH"}
Do = Callable[["Service", Made], None]


class Service:
    """Plays launch files into a LaunchImport."""

    def __init__(self, found: LaunchImport, packages: Packages, arguments: dict[str, str]) -> None:
        self.found, self.packages = found, packages
        self.context = Context(found, packages, found.path, self.evaluate)
        self.context.configurations |= arguments
        self.arguments = dict(arguments)
        self.files: list[str] = []
        self.read_files = self.depth = 0
        self.containers: dict[str, dict[str, Any]] = {}
        self.waiting: list[tuple[str, list[dict[str, Any]], Place]] = []
        self.interpreter: Interpreter | None = None

    def play(self, path: str) -> None:
        """Play the launch file; raise DiagnosticError if it cannot be read at all."""
        self._file(path, Place(path, 1))
        for name, components, place in self.waiting:
            self._load(name, components, place, last=True)

    def evaluate(self, text: str, place: Place) -> Any:
        """Return the value of a Python expression, as far as the interpreter reads it."""
        tree = parsed_expression(text)
        if tree is None:
            return Unknown(place, f"'{text[:60]}' is not a Python expression")
        interpreter = Interpreter("", place.path, LaunchImport(path=place.path), Library(self.context))
        interpreter.found.work = self.found.work
        value = interpreter.value(tree, Scope({}))
        self.found.work = interpreter.found.work
        known = isinstance(value, (str, int, float, bool, list, tuple)) or value is None
        return value if known else Unknown(place, f"only a launch determines '{text[:60]}'")

    # Files

    def _file(self, path: str, place: Place) -> None:
        real = os.path.realpath(path)
        if real in self.files:
            self.found.note(place, "launch files include each other in a circle: this one is not followed")
            return
        if self.read_files >= MOST_FILES or len(self.files) >= DEEPEST // 2:
            self.found.note(place, f"more than {MOST_FILES} launch files are included: this one is not followed")
            return
        self.read_files += 1
        try:
            content = read_bounded(path, MOST_BYTES)
        except OSError as problem:
            raise refuse(f"the launch file cannot be read: {problem.strerror}", Place(path, 1)) from None
        text, wrong = reader.decode(content, path)
        if wrong:
            raise DiagnosticError(wrong)
        self.found.spend(len(text))
        self.found.sources[path] = text.split("\n")
        before, self.context.file = self.context.file, path
        self.files.append(real)
        try:
            self._play_text(text, path)
        finally:
            self.files.pop()
            self.context.file = before

    def _play_text(self, text: str, path: str) -> None:
        if path.endswith(".py"):
            self._python(text, path)
            return
        if path.endswith((".yaml", ".yml")):
            from fogspec.spec.launch_import.yaml import read_yaml

            self.visit(read_yaml(text, path))
            return
        from fogspec.spec.launch_import.xml import read_xml

        self.visit(read_xml(text, path))

    def _python(self, text: str, path: str) -> None:
        interpreter = Interpreter(text, path, self.found, Library(self.context))
        whole = Path(os.path.abspath(path))
        interpreter.module.names["__file__"] = self.packages.shared(whole) or whole.as_posix()
        outer, self.interpreter = self.interpreter, interpreter
        try:
            interpreter.run()
            start = interpreter.function("generate_launch_description")
            if start is None:
                raise refuse("the launch file must define generate_launch_description()", Place(path, 1))
            self.visit(interpreter.call(start, [], {}, Place(path, getattr(start.node, "lineno", 1))))
            for made in interpreter.constructed:
                description(self, made)
        except Raised as raised:
            self.found.note(raised.place, f"the launch file ends here: {raised.why}")
        except RecursionError:
            raise refuse("the launch file is nested too deep", Place(path, 1)) from None
        finally:
            self.interpreter = outer

    # Actions

    def visit(self, entity: Any) -> None:
        """Play an action, or a list of them."""
        self.found.spend(5)
        self.depth += 1
        try:
            if self.depth > 4 * DEEPEST:
                raise refuse("the launch file is nested too deep", Place(self.context.file, 1))
            if isinstance(entity, (list, tuple)):
                for one in entity:
                    self.visit(one)
            elif isinstance(entity, Unknown):
                self.found.note(entity.place, f"what this starts is not taken over: {entity.why}")
            elif isinstance(entity, Made) and nodes.applies(self.context, entity):
                do = ACTIONS.get(entity.kind)
                if do is not None:
                    do(self, entity)
                elif entity.kind not in SILENT:
                    self.found.note(entity.place, f"{entity.kind} is not taken over")
        finally:
            self.depth -= 1

    def text(self, made: Made, name: str, position: int | None = None) -> str | None:
        """Return an argument of an action as text; note and return None if only a launch determines it."""
        value = made.word(name, position)
        text = self.context.perform("" if value is None else value, made.place)
        if isinstance(text, Unknown):
            self.found.note(text.place, f"{made.kind} is not taken over: {text.why}")
            return None
        return text

    def description(self, made: Made) -> None:
        """Play a launch description."""
        self.visit(made.word("initial_entities", 0, []))
        self.visit(made.words.get("_added", []))

    def declare(self, made: Made) -> None:
        """Declare a launch argument: its default is taken unless it is given."""
        name = self.text(made, "name", 0)
        if name is None or name in self.context.configurations:
            return
        default = made.word("default_value", 1)
        if default is None:
            missing = Unknown(made.place, f"the launch argument {name} has no default: give it as {name}:=VALUE")
            self.context.configurations[name] = missing
            return
        value = self.context.perform(default, made.place)
        self.context.configurations[name] = value
        if isinstance(value, str) and len(self.files) == 1:
            self.found.defaults.setdefault(name, value)

    def set_configuration(self, made: Made) -> None:
        """Set a launch configuration."""
        name = self.context.perform(made.word("name", 0), made.place)
        value = made.word("value", 1)
        if isinstance(name, str):
            self.context.configurations[name] = self.context.perform(
                str(value) if isinstance(value, bool) else value, made.place
            )

    def unset_configuration(self, made: Made) -> None:
        """Remove a launch configuration."""
        self.context.configurations.pop(self.text(made, "name", 0) or "", None)

    def set_environment(self, made: Made) -> None:
        """Set an environment variable."""
        name = self.text(made, "name", 0)
        if name is not None:
            self.context.environment[name] = self.context.perform(made.word("value", 1), made.place)

    def append_environment(self, made: Made) -> None:
        """Append to an environment variable."""
        name, value = self.text(made, "name", 0), self.context.perform(made.word("value", 1), made.place)
        glue = made.word("separator", default=":")
        first = made.word("prepend", default=False)
        if isinstance(first, (Made, str, list)):
            first = self.context.truth(first, made.place)
        before = self.context.environment.get(name or "")
        if name is None or isinstance(value, Unknown) or isinstance(before, Unknown) or not isinstance(glue, str):
            self.found.note(made.place, "an environment variable is not taken over: only a launch determines it")
        elif before is None and name not in EVERYWHERE:
            self.context.environment[name] = value
        elif before is None:
            kept = f"$(env {name})"
            self.context.environment[name] = f"{value}{glue}{kept}" if first is True else f"{kept}{glue}{value}"
        else:
            self.context.environment[name] = f"{value}{glue}{before}" if first is True else f"{before}{glue}{value}"

    def unset_environment(self, made: Made) -> None:
        """Remove an environment variable."""
        name = self.text(made, "name", 0)
        if name and self.context.environment.pop(name, None) is None:
            self.found.note(made.place, f"{name} is not removed from the environment: a spec has no place for it")

    def group(self, made: Made) -> None:
        """Play a group in its scope."""
        scoped, forwarding = (self.flag(made, name) for name in ("scoped", "forwarding"))
        sets = [(key, value) for key, value in (made.word("launch_configurations") or {}).items()]
        done = [
            (self.context.perform(key_of(key), made.place), self.context.perform(value, made.place))
            for key, value in sets
        ]
        if scoped:
            self.context.push(forwarding)
        for key, value in done:
            if isinstance(key, str):
                self.context.configurations[key] = value
        try:
            self.visit(made.word("actions", 0, []))
        finally:
            if scoped:
                self.context.pop()

    def flag(self, made: Made, name: str) -> bool:
        """Return an argument that is true unless it says otherwise."""
        value = made.word(name, default=True)
        if isinstance(value, (Made, str, list)):
            value = self.context.truth(value, made.place)
        return value is not False

    def opaque(self, made: Made) -> None:
        """Call a function of the launch file, and play what it returns."""
        function = made.word("function", 0)
        if not isinstance(function, Function) or self.interpreter is None:
            self.found.note(made.place, "what this function starts is not taken over: it is not in this file")
            return
        arguments = made.word("args", 1) or []
        words = made.word("kwargs", 2) or {}
        context = Made("LaunchContext", [], {}, made.place)
        given = [context, *(arguments if isinstance(arguments, (list, tuple)) else [arguments])]
        try:
            self.visit(self.interpreter.call(function, given, words if isinstance(words, dict) else {}, made.place))
        except Raised as raised:
            self.found.note(raised.place, f"this function ends here: {raised.why}")

    def include(self, made: Made) -> None:
        """Play another launch file where it is here, or have `ros2 launch` start it."""
        source = made.word("launch_description_source", 0)
        if isinstance(source, Made) and source.kind == "LaunchDescriptionSource":
            source = source.word("launch_description", 0)
        if isinstance(source, Made) and source.kind in DESCRIPTIONS:
            self.visit(source)
            return
        path = self.context.perform(source, made.place)
        given = made.word("launch_arguments", 1)
        pairs = self._arguments(given, made.place)
        if isinstance(path, Unknown):
            self.found.note(path.place, f"the included launch file is not taken over: {path.why}")
            return
        for key, value in pairs:
            self.context.configurations[key] = value
        file = self._found(path)
        if file is not None:
            self.found.included.append(file)
            try:
                self._file(file, made.place)
            except DiagnosticError as problem:
                first = problem.diagnostics[0]
                if self.found.work > 0 and "too large" in first.message:
                    raise
                self.found.note(made.place, f"the included file {os.path.basename(file)} is not read: {first.message}")
            return
        self._launched(path, pairs, made.place)

    def _arguments(self, given: Any, place: Place) -> list[tuple[str, Any]]:
        if isinstance(given, Unknown):
            self.found.note(given.place, f"the arguments of an included file are not taken over: {given.why}")
            return []
        pairs = given.items() if isinstance(given, dict) else given if isinstance(given, (list, tuple)) else []
        found: list[tuple[str, Any]] = []
        for one in pairs:
            if not isinstance(one, (list, tuple)) or len(one) != 2:
                where = one.place if isinstance(one, (Made, Unknown)) else place
                self.found.note(where, "an argument of an included file is not taken over: it is not a pair")
                continue
            name = self.context.perform(key_of(one[0]), place)
            if isinstance(name, str):
                value = one[1]
                found.append((name, self.context.perform(str(value) if isinstance(value, bool) else value, place)))
                self.context.configurations[name] = found[-1][1]
        return found

    def _found(self, path: str) -> str | None:
        if path.startswith("$(find-pkg-share "):
            file = self.packages.file(path)
            return None if file is None else str(file)
        if path.startswith("$"):
            return None
        whole = path if os.path.isabs(path) else os.path.join(os.path.dirname(self.context.file), path)
        return whole if os.path.isfile(whole) else None

    def _launched(self, path: str, pairs: list[tuple[str, Any]], place: Place) -> None:
        """Start a launch file that is not here by `ros2 launch`, which finds it on the machine."""
        match = SHARE.match(path)
        if match is None:
            self.found.note(place, f"the included file {path} is not here: what it starts is not taken over")
            return
        argv = ["ros2", "launch", match[1], os.path.basename(path)]
        for name, value in pairs:
            if isinstance(value, Unknown):
                self.found.note(
                    value.place, f"the argument {name} of {os.path.basename(path)} is not taken over: {value.why}"
                )
            else:
                argv.append(f"{name}:={value}")
        for key, what in (
            ("ros_namespace", "the namespace around this included file is"),
            ("ros_remaps", "the remappings around this included file are"),
            ("global_params", "the parameters around this included file are"),
        ):
            if self.context.configurations.get(key):
                self.found.note(place, f"{what} not taken over: the file is not here, and "
                                       "`ros2 launch` starts it; --package-path says where its package is")  # fmt: skip
        env = {key: value for key, value in self.context.environment.items() if isinstance(value, str)}
        self.take(nodes.tidy({"cmd": argv, "env": env}), place)

    def take(self, node: dict[str, Any] | None, place: Place, cloud: bool = False) -> None:
        """Keep what starts."""
        if node is not None:
            self.found.origins[id(node)] = place
            (self.found.cloud if cloud else self.found.robot).append(node)
            if node.get("name"):
                self.containers.setdefault(nodes.full_name(node), node)

    def node(self, made: Made) -> None:
        """Start a node."""
        cloud = is_cloud(made)
        if cloud:
            cloud_node(self.context, made)
        self.take(nodes.node(self.context, made), made.place, cloud)

    def process(self, made: Made) -> None:
        """Start a process."""
        self.take(nodes.process(self.context, made), made.place, is_cloud(made))

    def load(self, made: Made) -> None:
        """Load components into a container."""
        components = nodes.composable(self.context, made.word("composable_node_descriptions", 0, []), made.place)
        target = made.word("target_container", 1)
        if isinstance(target, Made) and target.kind in CONTAINERS:
            name = self.context.perform(target.word("name"), target.place)
            space = self.context.perform(target.word("namespace", default=""), target.place)
            pushed = self.context.configurations.get("ros_namespace")
            if isinstance(name, str) and isinstance(space, str):
                self._load(f"{(nodes.joined(pushed, space) or '').rstrip('/')}/{name}", components, made.place)
                return
            name = Unknown(made.place, "the container's name is not known")
        else:
            name = self.context.perform(target, made.place)
        if isinstance(name, Unknown):
            self.found.note(name.place, f"components are not taken over: {name.why}")
            return
        self._load(name if name.startswith("/") else f"/{name}", components, made.place)

    def _load(self, name: str, components: list[dict[str, Any]], place: Place, last: bool = False) -> None:
        container = self.containers.get(name)
        if container is None and not last:
            self.waiting.append((name, components, place))
        elif container is None or "package" not in container:
            self.found.note(
                place, f"components are not taken over: this launch file does not start their container {name}"
            )
        elif components:
            container.setdefault("composable_node_descriptions", []).extend(components)

    def push_namespace(self, made: Made) -> None:
        """Push a namespace for all nodes of the scope."""
        space = self.text(made, "namespace", 0)
        before = self.context.configurations.get("ros_namespace")
        if space is not None:
            self.context.configurations["ros_namespace"] = nodes.joined(
                before if isinstance(before, str) else None, space
            )

    def set_remap(self, made: Made) -> None:
        """Set a remapping for all nodes of the scope."""
        source, target = self.text(made, "src", 0), self.text(made, "dst", 1)
        if source is not None and target is not None:
            self.context.configurations.setdefault("ros_remaps", []).append((source, target))

    def set_parameter(self, made: Made) -> None:
        """Set a parameter for all nodes of the scope."""
        name = self.text(made, "name", 0)
        if name is not None:
            for full, value in flat(self.context, {name: made.word("value", 1)}, made.place):
                push(self.context, full, value, made.place)

    def set_sim_time(self, made: Made) -> None:
        """Set use_sim_time for all nodes of the scope."""
        value = made.word("value", 0)
        if isinstance(value, (Made, list)):
            value = self.context.truth(value, made.place)
        push(self.context, "use_sim_time", value, made.place)

    def set_parameters(self, made: Made) -> None:
        """Set the parameters of a file for all nodes of the scope."""
        path = made.word("filename", 0)
        self.context.configurations.setdefault("global_params", []).append(path)

    def timer(self, made: Made) -> None:
        """Start what a timer starts, and say so."""
        period = self.context.perform(made.word("period", 0), made.place)
        delay = f"{period} s after the launch" if isinstance(period, str) else "later"
        self.found.note(made.place, f"a timer starts this {delay}: in the spec it starts with the rest")
        self.visit(made.word("actions", 1, []))

    def handler(self, made: Made) -> None:
        """Start what an event starts, and say so."""
        event = made.word("event_handler", 0)
        if not isinstance(event, Made) or event.kind == "OnShutdown":
            self.found.note(made.place, "what an event starts is not taken over")
            return
        actions: list[Any] = []
        for name in EVENTS:
            value = event.word(name)
            actions += value if isinstance(value, (list, tuple)) else [] if value is None else [value]
        started = [
            one for one in actions if isinstance(one, Made) and one.kind not in SILENT and one.kind != "EmitEvent"
        ]
        if any(not isinstance(one, Made) or one.kind in ("EmitEvent", "Shutdown") for one in actions):
            self.found.note(made.place, f"what {event.kind} decides while the nodes run is not taken over")
        started = [one for one in started if one.kind != "Shutdown"]
        if started:
            self.found.note(made.place, f"{event.kind} starts this: in the spec it starts with the rest")
            self.visit(started)

    def emitted(self, made: Made) -> None:
        """Say that an event is not taken over."""
        self.found.note(
            made.place, "an event, such as a lifecycle transition, is not taken over: the node starts without it"
        )


CONTAINERS = {"ComposableNodeContainer", "ComposableNodeContainerExtended"}
ACTIONS: dict[str, Do] = {
    **dict.fromkeys(DESCRIPTIONS, Service.description),
    **dict.fromkeys(("Node", "LifecycleNode", "CloudNode"), Service.node),
    **dict.fromkeys(PROCESSES, Service.process),
    **dict.fromkeys(CONTAINERS, Service.node),
    **dict.fromkeys(("PushRosNamespace", "PushROSNamespace"), Service.push_namespace),
    **dict.fromkeys(("TimerAction", "RosTimer", "ROSTimer"), Service.timer),
    **dict.fromkeys(("EmitEvent", "LifecycleTransition", "Shutdown"), Service.emitted),
    "LoadComposableNodes": Service.load,
    "DeclareLaunchArgument": Service.declare,
    "SetLaunchConfiguration": Service.set_configuration,
    "UnsetLaunchConfiguration": Service.unset_configuration,
    "SetEnvironmentVariable": Service.set_environment,
    "AppendEnvironmentVariable": Service.append_environment,
    "UnsetEnvironmentVariable": Service.unset_environment,
    "PushLaunchConfigurations": lambda service, _: service.context.push(),
    "PopLaunchConfigurations": lambda service, _: service.context.pop(),
    "GroupAction": Service.group,
    "IncludeLaunchDescription": Service.include,
    "OpaqueFunction": Service.opaque,
    "RegisterEventHandler": Service.handler,
    "SetRemap": Service.set_remap,
    "SetParameter": Service.set_parameter,
    "SetParametersFromFile": Service.set_parameters,
    "SetUseSimTime": Service.set_sim_time,
}  # fmt: skip
