"""Python launch files, read by their syntax tree: a launch file is a program, and it is never run."""

import ast
from typing import Any

from fogspec.base.diagnostics import Diagnostic, DiagnosticError, Span
from fogspec.spec.launch_import.constraints import UNREAD, is_constraint, take_constraint
from fogspec.spec.launch_import.expressions import Expressions, Unknown, keyword_of, name_of, place_of
from fogspec.spec.launch_import.found import LaunchImport, tidy_node, words

NODES = {"Node", "LifecycleNode", "CloudNode"}
CLOUD = {"SkyLaunchDescription"}
NOT_READ = {
    "IncludeLaunchDescription": "another launch file is included",
    "OpaqueFunction": "a function decides what starts",
    "ComposableNodeContainer": "a container of components is started",
    "LoadComposableNodes": "components are loaded",
    "PushRosNamespace": "a namespace is pushed",
    "SetParameter": "a parameter is set for all nodes",
    "RegisterEventHandler": "events decide what starts",
    "TimerAction": "a timer decides what starts",
}
UNUSED = {"workdir", "mode", "ami", "num_replicas", "manifest"}


def read_python(text: str, path: str) -> LaunchImport:
    """Return what the file starts; raise DiagnosticError if it is not Python."""
    try:
        tree = ast.parse(text, path)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as wrong:
        line, column = getattr(wrong, "lineno", None) or 1, getattr(wrong, "offset", None) or 1
        message = "the launch file must be Python"
        raise DiagnosticError([Diagnostic("FS801", message, Span(path, line, column))]) from None
    found = LaunchImport(path=path, lines=text.split("\n"))
    _Reader(found, tree).read()
    return found


class _Reader:
    def __init__(self, found: LaunchImport, tree: ast.AST) -> None:
        self.found = found
        self.told = Expressions(tree, found)
        self.taken: set[ast.Call] = set()
        calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
        self.calls = sorted(calls, key=lambda one: (one.lineno, one.col_offset))

    def read(self) -> None:
        for call in self.calls:
            if name_of(call) in CLOUD:
                self._description(call)
        for call in self.calls:
            name = name_of(call)
            if call in self.taken:
                continue
            if name in NODES:
                self._take(call, cloud=name == "CloudNode" or self._flag(call, "to_cloud"))
            elif name == "ExecuteProcess":
                self._process(call)
            elif name in NOT_READ:
                self._note(call, f"{NOT_READ[name]}: not taken over")

    def _description(self, call: ast.Call) -> None:
        """Import the paper's SkyLaunchDescription: its nodes go to the cloud, its constraint into the spec."""
        for name, value in [("nodes", one) for one in call.args[:1]] + [(k.arg, k.value) for k in call.keywords]:
            if name == "nodes":
                for item in self._items(value):
                    self._take(item, cloud=True)
            elif name in ("constraint", "constraints"):
                self._constraints(value)
            elif name is not None and (name == "accelerators" or is_constraint(name)):
                self._constraint(name, value)
            elif name == "additional_setup_commands":
                self.found.setup += [str(one) for one in self._or_note(value, name) or []]
            elif name in ("containers", "additional_run_commands"):
                for line in self._or_note(value, name) or []:
                    self.found.cloud.append({"cmd": ["bash", "-c", str(line)]})
            elif name not in UNUSED:
                self._note(value, f"{name} of SkyLaunchDescription is not taken over")

    def _items(self, value: ast.expr) -> list[ast.Call]:
        """Return the calls in a list, also if each is a name."""
        value = self.told.follow(value)
        if not isinstance(value, (ast.List, ast.Tuple)):
            self._note(value, "the list of nodes cannot be read")
            return []
        items = [self.told.follow(item) for item in value.elts]
        for item in items:
            if not isinstance(item, ast.Call):
                self._note(item, "a node cannot be read")
        return [item for item in items if isinstance(item, ast.Call)]

    def _constraints(self, value: ast.expr) -> None:
        value = self.told.follow(value)
        pairs: list[tuple[ast.expr | None, ast.expr]] = []
        if isinstance(value, ast.Dict):
            pairs = list(zip(value.keys, value.values, strict=True))
        elif isinstance(value, ast.Call) and name_of(value) == "dict":
            pairs = [(ast.Constant(k.arg), k.value) for k in value.keywords]
        else:
            self._note(
                value, "the constraints cannot be read: latency and cost are left empty, write them into the spec"
            )
            self.found.constraints |= {"latency": None, "cost": None}
        for key, one in pairs:
            if isinstance(key, ast.Name):
                self._constraint(key.id, one)
            else:
                text = key.value if isinstance(key, ast.Constant) and isinstance(key.value, str) else ""
                self._constraint(text, one)

    def _constraint(self, name: str, value: ast.expr) -> None:
        """Import one constraint, or leave its field empty and report it where it is written."""
        try:
            taken = self.told.value(value)
        except Unknown:
            taken = UNREAD
        if report := take_constraint(self.found, name, taken):
            self._note(value, report)

    def _take(self, call: ast.Call, cloud: bool) -> None:
        self.taken.add(call)
        if name_of(call) == "ExecuteProcess":
            self._process(call, cloud)
            return
        raw: dict[str, Any] = {}
        for keyword in call.keywords:
            name = str(keyword.arg)
            if name in ("package", "executable", "name", "namespace"):
                raw[name] = self._or_note(keyword.value, name)
            elif name == "arguments":
                raw[name] = [str(one) for one in self._each(keyword.value, name)]
            elif name == "ros_arguments":
                raw["arguments"] = [*raw.get("arguments", []), "--ros-args", *map(str, self._each(keyword.value, name))]
            elif name == "parameters":
                self._parameters(keyword.value, raw)
            elif name == "remappings":
                pairs = self._each(keyword.value, name)
                raw[name] = {str(pair[0]): str(pair[1]) for pair in pairs if isinstance(pair, list) and len(pair) == 2}
            elif name in ("additional_env", "env"):
                taken = self._or_note(keyword.value, name)
                raw["env"] = {str(k): str(v) for k, v in taken.items()} if isinstance(taken, dict) else {}
            elif name == "condition":
                self._note(keyword.value, "a condition decides whether this node starts: taken as if it does")
        if raw.get("package") is None or raw.get("executable") is None:
            self._note(call, "a node without a readable package and executable is left out")
            return
        (self.found.cloud if cloud else self.found.robot).append(tidy_node(raw))

    def _process(self, call: ast.Call, cloud: bool = False) -> None:
        self.taken.add(call)
        value = keyword_of(call, "cmd")
        argv = self._or_note(value, "cmd") if value is not None else None
        if argv:
            flat = words(argv) if isinstance(argv, str) else [str(one) for one in argv]
            (self.found.cloud if cloud else self.found.robot).append({"cmd": flat})

    def _parameters(self, value: ast.expr, raw: dict[str, Any]) -> None:
        value = self.told.follow(value)
        for item in value.elts if isinstance(value, (ast.List, ast.Tuple)) else [value]:
            taken = self._or_note(item, "parameters")
            if isinstance(taken, dict):
                raw.setdefault("parameters", {}).update({str(key): one for key, one in taken.items()})
            elif isinstance(taken, str):
                raw.setdefault("parameter_files", []).append(taken)

    def _each(self, value: ast.expr, what: str) -> list[Any]:
        value = self.told.follow(value)
        if isinstance(value, (ast.List, ast.Tuple)):
            return [one for item in value.elts if (one := self._or_note(item, what)) is not None]
        taken = self._or_note(value, what)
        return taken if isinstance(taken, list) else []

    def _or_note(self, value: ast.expr, what: str) -> Any:
        try:
            return self.told.value(value)
        except Unknown as unknown:
            self._note(unknown.node, f"{what} is only known when the file runs: not taken over")
            return None

    def _note(self, node: ast.expr, message: str) -> None:
        line, column, width = place_of(node, self.found)
        self.found.note(line, message, column, width)

    def _flag(self, call: ast.Call, name: str) -> bool:
        value = keyword_of(call, name)
        return isinstance(value, ast.Constant) and value.value is True
