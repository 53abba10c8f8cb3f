"""launch's actions: what they change for later ones, and launch files that include others."""

import os
from collections.abc import Callable
from functools import partial
from typing import Any

from fogspec.importers.launch.sandboxed import guard
from fogspec.importers.launch.sandboxed.context import (
    CONTEXT,
    DISTRO,
    FOUND,
    environment,
    perform,
    reset_environment,
    said,
    truth,
)
from fogspec.importers.launch.sandboxed.made import NAMES, Action, Made, make, visit, where
from fogspec.importers.launch.sandboxed.paths import opened, real, virtual
from fogspec.importers.launch.sandboxed.values import (
    CURRENT,
    OWN,
    REFUSALS,
    Fatal,
    Place,
    Refused,
    Stop,
    Unknown,
    attempt,
    marked,
    missing,
    note,
    reason,
    whole,
)

MOST_FILES = 100
DEEPEST = 25
PLAYED: list[str] = []  # the launch files that are being played, one included by the one before
COUNT = [0]
LATER: list[Any] = []  # what events start
EVENTS = (
    "on_start", "on_exit", "on_completion", "on_stdout", "on_stderr", "on_stdin", "entities", "on_shutdown", "on_matched",
)  # fmt: skip
AFTER: list[Callable[[], None]] = []  # what is done once a Python launch file is played
Do = Callable[[Any, Any], Any]


def action(name: str, *fields: str, library: str = "launch", base: type[Made] = Action) -> Callable[[Do], Any]:
    """Return a decorator that makes an action's class of the function that plays it, which gets the action and the context."""
    return lambda function: make(library, name, *fields, base=base, execute=function)


def _nothing(self: Any, context: Any) -> None:
    """Do nothing: it shows something, or it is launch's own business."""
    self.given.left()


for _name in ("LogInfo", "LogDebug", "LogWarning", "LogError", "Log", "UnregisterEventHandler", "SetLaunchLogDir"):
    action(_name, "msg")(_nothing)
for _name in ("SetROSLogDir", "SetROSLogDirectory"):
    action(_name, "new_log_dir", library="launch_ros")(_nothing)


class LaunchDescription(Made):
    """A launch file's actions."""

    FIELDS = ("initial_entities",)

    def __init__(self, *args: Any, **words: Any) -> None:
        super().__init__(*args, **words)
        some = self.given.get("initial_entities")
        self.__dict__["entities"] = [some] if isinstance(some, Unknown) else list(some or [])

    def add_action(self, one: Any) -> None:
        """Add an action."""
        self.entities.append(one)

    add_entity = add_action

    def visit(self, context: Any) -> Any:
        """Return the actions."""
        return self.entities


NAMES["launch"]["LaunchDescription"] = LaunchDescription


@action("DeclareLaunchArgument", "name")
def _declare(self: Made, context: Any) -> None:
    name, value, given = perform(self.name), self.word("default_value"), context.launch_configurations
    if name not in given and value is None:
        given[name] = missing(name, self.place)
        return
    own = name not in given
    given[name] = text = perform(value if own else given[name])
    if marked(text):
        return
    if own and len(PLAYED) == 1:
        FOUND.defaults.setdefault(name, attempt(lambda: said(text), "a default is", self.place, ""))
    choices = self.word("choices")
    if choices and text not in choices:
        some = ", ".join(map(str, choices))
        REFUSALS.append(Fatal(f"launch does not start with {name}:={text}: it must be one of {some}", self.place))


@action("SetLaunchConfiguration", "name", "value")
def _set(self: Made, context: Any) -> None:
    context.launch_configurations[perform(self.name)] = perform(self.value)


@action("UnsetLaunchConfiguration", "name")
def _unset(self: Made, context: Any) -> None:
    context.launch_configurations.pop(perform(self.name), None)


@action("SetEnvironmentVariable", "name", "value")
def _set_environment(self: Made, context: Any) -> None:
    os.environ[perform(self.name)] = perform(self.value)


@action("AppendEnvironmentVariable", "name", "value")
def _append(self: Made, context: Any) -> None:
    name, value, glue = perform(self.name), perform(self.value), perform(self.word("separator", ":"))
    first = self.word("prepend", False)
    before = os.environ.get(name)
    if before is None:
        os.environ[name] = value
    elif first if isinstance(first, bool) else truth(first):
        os.environ[name] = value + glue + before
    else:
        os.environ[name] = before + glue + value


@action("UnsetEnvironmentVariable", "name")
def _unset_environment(self: Made, context: Any) -> None:
    name = perform(self.name)
    if os.environ.pop(name, None) is None:
        note(self.place, f"{name} is not removed from the environment: a spec has no place for it")


@action("ResetEnvironment")
def _reset_environment(self: Made, context: Any) -> None:
    from fogspec.importers.launch.sandboxed.context import BASE

    reset_environment({**BASE, "ROS_DISTRO": DISTRO[0]})


action("PushLaunchConfigurations")(lambda self, context: context.push_configurations())
action("PopLaunchConfigurations")(lambda self, context: context.pop_configurations())
action("PushEnvironment")(lambda self, context: context.push_environment())
action("PopEnvironment")(lambda self, context: context.pop_environment())


def _given(self: Made) -> dict[str, str]:
    some = self.word("launch_configurations", {})
    return {perform(key): perform(value) for key, value in some.items()}


@action("ResetLaunchConfigurations", "launch_configurations")
def _reset(self: Made, context: Any) -> None:
    some = _given(self)
    context.launch_configurations.clear()
    context.launch_configurations.update(some)


def flag(made: Made, name: str, default: bool) -> bool:
    """Return an argument that is true or false, or a text that says it."""
    value = made.word(name, default)
    return value if isinstance(value, bool) else truth(value)


@action("GroupAction", "actions")
def _group(self: Made, context: Any) -> None:
    scoped, forwarding, some = flag(self, "scoped", True), flag(self, "forwarding", True), _given(self)
    if scoped:
        context.push_configurations()
        context.push_environment()
        if not forwarding:
            context.launch_configurations.clear()
            reset_environment({})
    context.launch_configurations.update(some)
    try:
        visit(self.actions)
    finally:
        if scoped:
            context.pop_configurations()
            context.pop_environment()


@action("OpaqueFunction", "function", "args", "kwargs")
def _opaque(self: Made, context: Any) -> Any:
    try:
        return self.function(context, *self.word("args", ()), **self.word("kwargs", {}))
    except Stop as stop:
        note(stop.place, f"what this function starts is not taken over: {stop.why}")
    except Exception as problem:
        note(place_in(problem) or self.place, f"this function ends here: {reason(problem)}")
    return None


def place_in(problem: BaseException) -> Place | None:
    """Return where in a launch file an exception was raised."""
    found, trace = None, problem.__traceback__
    while trace is not None:
        path = OWN.get(trace.tb_frame.f_code.co_filename)
        found = whole(trace.tb_lineno, path) if path else found
        trace = trace.tb_next
    return found


@action("TimerAction", "period", "actions")
def _timer(self: Made, context: Any) -> Any:
    period = perform(self.period)
    delay = "later" if marked(period) else f"{period} s after the launch"
    note(self.place, f"a timer starts this {delay}: in the spec it starts with the rest")
    return self.actions


for _name in ("RosTimer", "ROSTimer"):
    NAMES["launch_ros"][_name] = NAMES["launch"]["TimerAction"]


@action("EmitEvent", "event")
def _emitted(self: Made, context: Any) -> None:
    note(self.place, "an event, such as a lifecycle transition, is not taken over: the node starts without it")
    self.given.left()


action("Shutdown", "reason")(_emitted)
action("LifecycleTransition", library="launch_ros")(_emitted)


class EventHandler(Made):
    """What an event starts."""

    FIELDS = ("target_action",)


for _name in (
    "OnProcessStart", "OnProcessExit", "OnProcessIO", "OnExecutionComplete", "OnIncludeLaunchDescription", "OnActionEventBase",
):  # fmt: skip
    make("launch", _name, "target_action", base=EventHandler)
make("launch", "OnShutdown", "on_shutdown", base=EventHandler)
make("launch", "EventHandler", base=EventHandler)
make("launch_ros", "OnStateTransition", "target_lifecycle_node", base=EventHandler)


@action("RegisterEventHandler", "event_handler")
def _register(self: Made, context: Any) -> None:
    event = self.event_handler
    kind = type(event).__name__
    if not isinstance(event, EventHandler) or kind == "OnShutdown":
        note(self.place, "what an event starts is not taken over")
        return
    some: list[Any] = []
    for name in EVENTS:
        value = event.given.get(name)
        some += value if isinstance(value, (list, tuple)) else [] if value is None else [value]
    silent = tuple(NAMES["launch"][name] for name in ("EmitEvent", "Shutdown", "LogInfo"))
    started = [one for one in some if isinstance(one, Made) and not isinstance(one, silent)]
    if any(not isinstance(one, Made) or isinstance(one, silent[:2]) for one in some):
        note(self.place, f"what {kind} decides while the nodes run is not taken over")
    if started:
        note(self.place, f"{kind} starts this: in the spec it starts with the rest")
        LATER.extend(started)


class LaunchDescriptionSource(Made):
    """Where an included launch file is."""

    FIELDS = ("launch_description",)

    @property
    def location(self) -> Any:
        """What names the file."""
        return next((self.given[one] for one in ("launch_file_path", "location") if one in self.given), "")


NAMES["launch"]["LaunchDescriptionSource"] = LaunchDescriptionSource
for _name in ("Python", "Any", "Frontend", "XML", "YAML"):
    make("launch", f"{_name}LaunchDescriptionSource", "launch_file_path", base=LaunchDescriptionSource)


def _pairs(self: Made) -> list[tuple[str, str]]:
    """Return the arguments of an included file, which are launch configurations from now on."""
    given = self.word("launch_arguments", ())
    if isinstance(given, Unknown):
        note(given._place, f"the arguments of an included file are not taken over: {given._why}")
        return []
    pairs: list[tuple[str, str]] = []
    for pair in given.items() if isinstance(given, dict) else given:
        if not isinstance(pair, (list, tuple)) or len(pair) != 2:
            note(where(pair) or self.place, "an argument of an included file is not taken over: it is not a pair")
            continue
        pairs.append((perform(pair[0]), perform(pair[1])))
        CONTEXT.launch_configurations[pairs[-1][0]] = pairs[-1][1]
    return pairs


@action("IncludeLaunchDescription", "launch_description_source")
def _include(self: Made, context: Any) -> Any:
    source = self.launch_description_source
    inner = source.given.get("launch_description") if isinstance(source, LaunchDescriptionSource) else source
    pairs = _pairs(self)
    if isinstance(inner, LaunchDescription):
        return inner
    try:
        path = opened(perform(source.location if isinstance(source, LaunchDescriptionSource) else source))
    except Refused as refused:
        note(refused.place or self.place, f"the included launch file is not taken over: {refused.why}")
        return None
    file, package = real(path if path.startswith("/") else os.path.join(os.path.dirname(virtual(CURRENT[0])), path))
    if file is not None and os.path.isfile(file):
        FOUND.included.append(file)
        _play_included(file, self.place)
    elif package is None:
        note(self.place, f"the included file {path} is not here: what it starts is not taken over")
    else:
        _launched(self, package, os.path.basename(path), pairs)
    return None


def _play_included(path: str, place: Place) -> None:
    try:
        play(path, place)
    except Fatal as problem:
        note(place, f"the included file {os.path.basename(path)} is not read: {problem.why}")


def _launched(self: Made, package: str, file: str, pairs: list[tuple[str, str]]) -> None:
    """Start a launch file that is not here by `ros2 launch`, which finds it on the machine."""
    argv = ["ros2", "launch", package, file]
    for name, value in pairs:
        text = attempt(partial(said, value), f"the argument {name} of {file} is", self.place)
        argv += [] if text is None else [f"{name}:={text}"]
    for key, what in (("ros_namespace", "namespace"), ("ros_remaps", "remappings"), ("global_params", "parameters")):
        if CONTEXT.launch_configurations.get(key):
            are = "is" if what == "namespace" else "are"
            note(self.place, f"the {what} around this included file {are} not taken over: the file is not here, and "
                             "`ros2 launch` starts it; --package-path says where its package is")  # fmt: skip
    env = environment(self.place)
    FOUND.robot.append({"cmd": argv, "place": self.place, **({"env": env} if env else {})})


def play(path: str, place: Place) -> None:
    """Play a launch file: Python, XML or YAML; raise Fatal if it is not one."""
    if path in PLAYED or len(PLAYED) >= DEEPEST:
        note(place, "launch files include each other in a circle: this one is not followed")
        return
    COUNT[0] += 1
    if COUNT[0] > MOST_FILES:
        note(place, f"more than {MOST_FILES} launch files are included: this one is not followed")
        return
    before, CURRENT[0] = CURRENT[0], path
    PLAYED.append(path)
    try:
        with open(path, encoding="utf-8-sig") as file:
            source = file.read()
        if path.endswith(".py"):
            _python(source, path)
        else:
            from fogspec.importers.launch.sandboxed.frontend import entities

            visit(entities(source, path))
    except UnicodeDecodeError:
        raise Fatal("the launch file must be UTF-8 text", whole(1)) from None
    except RecursionError:
        raise Fatal("the launch file is nested too deep", whole(1)) from None
    finally:
        PLAYED.pop()
        CURRENT[0] = before


def _python(source: str, path: str) -> None:
    name = virtual(path)
    OWN[name] = path
    names = guard.Names({"__file__": name, "__name__": os.path.basename(path).partition(".")[0]})
    try:
        guard.run(source, name, names)
        start = names.get("generate_launch_description")
        if start is None:
            raise Fatal("the launch file must define generate_launch_description()", whole(1))
        visit(start())
    except (SyntaxError, ValueError, MemoryError) as wrong:
        if not isinstance(wrong, SyntaxError) and place_in(wrong):
            _ended(wrong)
        else:
            message = getattr(wrong, "msg", None) or str(wrong) or "it is nested too deep"
            place = path, getattr(wrong, "lineno", 1) or 1, getattr(wrong, "offset", 1) or 1, 1
            raise Fatal(f"the launch file cannot be read as Python: {message}", place) from None
    except Stop as stop:
        note(stop.place, f"the launch file ends here: {stop.why}")
    except (Fatal, RecursionError):
        raise
    except Exception as problem:
        _ended(problem)
    for do in AFTER:
        do()


def _ended(problem: Exception) -> None:
    note(place_in(problem) or whole(1), f"the launch file ends here: {reason(problem)}")


def as_module(path: Any) -> Any:
    """Return a launch file as a module: launch's `load_python_launch_file_as_module`."""
    name = opened(path)
    at = real(name)[0]
    if at is None:
        raise Stop(f"{os.path.basename(name)} is not here")
    module = type(os)("launch_file")
    OWN[name] = at
    module.__file__ = name
    with open(name, encoding="utf-8") as file:
        guard.run(file.read(), name, module.__dict__)
    return module


NAMES["launch"]["LaunchContext"] = type(CONTEXT)
NAMES["launch"]["LaunchService"] = lambda *_, **__: Unknown("it is of a running launch")
