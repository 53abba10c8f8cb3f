"""What a Python expression's value is, as far as that can be told without running anything."""

import ast
from collections import Counter
from typing import Any

from fogspec.spec.launch_import.found import DEEPEST, LaunchImport


class Unknown(Exception):
    """An expression whose value only running the file would tell."""

    def __init__(self, node: ast.expr) -> None:
        super().__init__(type(node).__name__)
        self.node = node


class Expressions:
    """The names of a file that are bound once, and the defaults of its launch arguments."""

    def __init__(self, tree: ast.AST, found: LaunchImport) -> None:
        self.found = found
        self.depth = 0
        self.names: dict[str, ast.expr] = {}
        self.defaults: dict[str, ast.expr] = {}
        bound = Counter(
            node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
        )
        for node in ast.walk(tree):
            if isinstance(node, ast.Assign) and len(node.targets) == 1 and isinstance(node.targets[0], ast.Name):
                if bound[node.targets[0].id] == 1:
                    self.names[node.targets[0].id] = node.value
            elif isinstance(node, ast.Call) and name_of(node) == "DeclareLaunchArgument":
                default = keyword_of(node, "default_value")
                if default is not None and node.args and isinstance(node.args[0], ast.Constant):
                    self.defaults[str(node.args[0].value)] = default

    def value(self, node: ast.expr) -> Any:
        """Return the value of an expression that can be evaluated without running anything."""
        self.depth += 1
        try:
            if self.depth > DEEPEST:
                raise Unknown(node)
            value = self._told(self.follow(node))
            self.found.spend(len(value) if isinstance(value, (str, list, dict)) else 0)
            return value
        finally:
            self.depth -= 1

    def _told(self, node: ast.expr) -> Any:
        if isinstance(node, ast.Constant) and isinstance(node.value, (str, int, float, bool)):
            return node.value
        if isinstance(node, (ast.List, ast.Tuple)):
            return [self.value(item) for item in node.elts]
        if isinstance(node, ast.Dict) and all(key is not None for key in node.keys):
            return {self.value(k): self.value(v) for k, v in zip(node.keys, node.values, strict=True) if k is not None}
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
            value = self.value(node.operand)
            if isinstance(value, (int, float)):
                return -value
        if isinstance(node, ast.JoinedStr):
            return "".join(
                str(self.value(one.value)) if isinstance(one, ast.FormattedValue) else str(self.value(one))
                for one in node.values
            )
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
            left, right = self.value(node.left), self.value(node.right)
            if isinstance(left, str) and isinstance(right, str):
                return left + right
        if isinstance(node, ast.Call):
            return self._called(node)
        raise Unknown(node)

    def _called(self, call: ast.Call) -> Any:
        name, first = name_of(call), call.args[0] if call.args else None
        if name == "LaunchConfiguration" and isinstance(first, ast.Constant) and str(first.value) in self.defaults:
            line, column, width = place_of(call, self.found)
            self.found.note(line, f"launch argument {first.value!s}: its default is taken", column, width)
            return self.value(self.defaults[str(first.value)])
        if name in ("ParameterValue", "TextSubstitution"):
            inner = first if first is not None else keyword_of(call, "text") or keyword_of(call, "value")
            if inner is not None:
                return self.value(inner)
        if name == "join" and call.args:
            return "/".join(str(self.value(one)) for one in call.args)
        raise Unknown(call)

    def follow(self, node: ast.expr) -> ast.expr:
        """Return what a name is bound to, followed a few steps."""
        for _ in range(10):
            if not (isinstance(node, ast.Name) and node.id in self.names):
                break
            node = self.names[node.id]
        return node


def name_of(call: ast.Call) -> str:
    """Return the last name of the callee."""
    return (
        call.func.attr
        if isinstance(call.func, ast.Attribute)
        else call.func.id
        if isinstance(call.func, ast.Name)
        else ""
    )


def keyword_of(call: ast.Call, name: str) -> ast.expr | None:
    """Return a keyword argument."""
    return next((one.value for one in call.keywords if one.arg == name), None)


def place_of(node: ast.expr, found: LaunchImport) -> tuple[int, int, int]:
    """Return line, column and width of an expression's first line, in characters; Python counts bytes."""
    line = found.lines[node.lineno - 1] if node.lineno <= len(found.lines) else ""
    found.spend(len(line))
    start = len(line.encode()[: node.col_offset].decode("utf-8", "ignore"))
    if node.end_lineno == node.lineno and node.end_col_offset is not None:
        end = len(line.encode()[: node.end_col_offset].decode("utf-8", "ignore"))
    else:
        end = len(line)
    return node.lineno, start + 1, max(1, end - start)
