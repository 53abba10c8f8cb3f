"""Python launch files, interpreted over their syntax tree: only what is listed here is done, and nothing of it is run.

Assignments, conditions, loops, functions and the methods of texts, lists and dictionaries have Python's own meaning. Calls of
classes of `launch`, `launch_ros` and packages like them make a `Made`. Everything else is an `Unknown`, which makes what is
made of it unknown as well.
"""

import ast
from collections.abc import Callable
from typing import Any

from fogspec.spec.launch_import.expressions import LAUNCH, Expressions
from fogspec.spec.launch_import.found import LaunchImport, Made, Place, Unknown, refuse
from fogspec.spec.launch_import.program import Call, Function, Loop, Named, Raised, Return, Scope, truth


class Interpreter(Expressions):
    """One Python launch file; `call` does what functions that are not the file's own do."""

    def __init__(self, text: str, path: str, found: LaunchImport, call: Call) -> None:
        self.found, self.path, self.call_other = found, path, call
        self.lines = text.split("\n")
        found.sources[path] = self.lines
        self.calls = self.depth = 0
        self.star = False  # whether all names of one of launch's modules are imported
        self.constructed: list[Made] = []  # what FogROS2 starts as soon as it is made
        self.module = Scope({"__name__": "launch_file"})
        try:
            self.tree = ast.parse(text, path)
        except (SyntaxError, ValueError, RecursionError, MemoryError) as wrong:
            line, column = getattr(wrong, "lineno", None) or 1, getattr(wrong, "offset", None) or 1
            raise refuse("the launch file must be Python", Place(path, line, column)) from None

    def run(self) -> None:
        """Read the module's statements."""
        self.statements(self.tree.body, self.module)

    def function(self, name: str) -> Function | None:
        """Return a function of the module."""
        value = self.module.names.get(name)
        return value if isinstance(value, Function) else None

    def statements(self, body: list[ast.stmt], scope: Scope) -> None:
        """Do statements in order."""
        for one in body:
            self.found.spend(1)
            self._statement(one, scope)

    def _statement(self, node: ast.stmt, scope: Scope) -> None:
        do = STATEMENTS.get(type(node))
        if do is not None:
            do(self, node, scope)
        elif not isinstance(node, (ast.Pass, ast.Global, ast.Nonlocal, ast.Assert, ast.Delete)):
            self.found.note(self.place(node), "this statement is not read")

    def _expression(self, node: ast.Expr, scope: Scope) -> None:
        value = self.value(node.value, scope)
        if isinstance(value, Unknown) and value.place == self.place(node.value):
            self.found.note(value.place, f"this is not read: {value.why}")

    def _assignment(self, node: ast.Assign | ast.AnnAssign, scope: Scope) -> None:
        if node.value is not None:
            value = self.value(node.value, scope)
            for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                self.assign(target, value, scope)

    def _augmented(self, node: ast.AugAssign, scope: Scope) -> None:
        combined = ast.copy_location(ast.BinOp(_as_load(node.target), node.op, node.value), node)
        self.assign(node.target, self.value(combined, scope), scope)

    def _definition(self, node: ast.FunctionDef, scope: Scope) -> None:
        scope.names[node.name] = self.defined(node, scope)

    def _class(self, node: ast.ClassDef | ast.AsyncFunctionDef, scope: Scope) -> None:
        scope.names[node.name] = Unknown(self.place(node), f"{node.name} is a class of its own")

    def _return(self, node: ast.Return, scope: Scope) -> None:
        raise Return(None if node.value is None else self.value(node.value, scope))

    def _loop(self, node: ast.Break | ast.Continue, _: Scope) -> None:
        raise Loop(isinstance(node, ast.Continue))

    def _raise(self, node: ast.Raise, _: Scope) -> None:
        raise Raised(self.place(node), "the launch file raises an error here")

    def _with(self, node: ast.With, scope: Scope) -> None:
        for item in node.items:
            value = self.value(item.context_expr, scope)
            if item.optional_vars is not None:
                self.assign(item.optional_vars, value, scope)
        self.statements(node.body, scope)

    def _import(self, node: ast.Import | ast.ImportFrom, scope: Scope) -> None:
        for one in node.names:
            if isinstance(node, ast.ImportFrom):
                self.star |= one.name == "*" and (node.module or "").partition(".")[0] in LAUNCH
                scope.names[one.asname or one.name] = Named(f"{node.module or ''}.{one.name}")
            else:
                name = one.name if one.asname else one.name.partition(".")[0]
                scope.names[one.asname or name] = Named(name)

    def _if(self, node: ast.If, scope: Scope) -> None:
        test = self.value(node.test, scope)
        if isinstance(test, Unknown):
            self.found.note(self.place(node.test), "only a launch decides this condition: taken as true")
        self.statements(node.body if truth(test) else node.orelse, scope)

    def _for(self, node: ast.For, scope: Scope) -> None:
        items = self.value(node.iter, scope)
        if isinstance(items, (Unknown, Made, Named, Function)) or not hasattr(items, "__iter__"):
            self.found.note(self.place(node.iter), "only a launch decides what this loop is over: it is left out")
            return
        for item in list(items):
            self.found.spend(1)
            self.assign(node.target, item, scope)
            try:
                self.statements(node.body, scope)
            except Loop as loop:
                if not loop.again:
                    return
        self.statements(node.orelse, scope)

    def _while(self, node: ast.While, scope: Scope) -> None:
        while True:
            self.found.spend(100)
            test = self.value(node.test, scope)
            if isinstance(test, Unknown):
                self.found.note(self.place(node.test), "only a launch decides how often this loops: it is left out")
                return
            if not truth(test):
                return
            try:
                self.statements(node.body, scope)
            except Loop as loop:
                if not loop.again:
                    return

    def _try(self, node: ast.Try, scope: Scope) -> None:
        try:
            self.statements(node.body, scope)
        except Raised:
            if not node.handlers:
                raise
            handler = node.handlers[0]
            if handler.name:
                scope.names[handler.name] = Unknown(self.place(node), "an error's text")
            self.statements(handler.body, scope)
        else:
            self.statements(node.orelse, scope)
        finally:
            self.statements(node.finalbody, scope)

    def assign(self, target: ast.expr, value: Any, scope: Scope) -> None:
        """Bind names, or set an item."""
        if isinstance(target, ast.Name):
            scope.names[target.id] = value
        elif isinstance(target, (ast.Tuple, ast.List)):
            if isinstance(value, (list, tuple)) and len(value) == len(target.elts):
                for one, item in zip(target.elts, value, strict=True):
                    self.assign(one, item, scope)
            else:
                unknown = value if isinstance(value, Unknown) else Unknown(self.place(target), "several values")
                for one in target.elts:
                    self.assign(one, unknown, scope)
        elif isinstance(target, ast.Subscript):
            try:
                self._set_item(target, value, scope)
            except (TypeError, IndexError, KeyError):
                self.found.note(self.place(target), "this assignment is not read")
        elif isinstance(target, ast.Starred):
            self.assign(target.value, value, scope)

    def _set_item(self, target: ast.Subscript, value: Any, scope: Scope) -> None:
        of, key = self.value(target.value, scope), self.value(target.slice, scope)
        if isinstance(of, Made) and of.kind == "environ":
            self.call_other(self, "os.environ.set", [key, value], {}, self.place(target))
        elif isinstance(of, Made):
            self.call_other(self, f"{of.kind}.set", [of, key, value], {}, self.place(target))
        elif isinstance(of, (dict, list)) and not isinstance(key, Unknown):
            of[key] = value
        else:
            self.found.note(self.place(target), "this assignment is not read")


STATEMENTS: dict[type[ast.stmt], Callable[[Interpreter, Any, Scope], None]] = {
    ast.Expr: Interpreter._expression,
    ast.Assign: Interpreter._assignment,
    ast.AnnAssign: Interpreter._assignment,
    ast.AugAssign: Interpreter._augmented,
    ast.FunctionDef: Interpreter._definition,
    ast.ClassDef: Interpreter._class,
    ast.AsyncFunctionDef: Interpreter._class,
    ast.Import: Interpreter._import,
    ast.ImportFrom: Interpreter._import,
    ast.If: Interpreter._if,
    ast.Return: Interpreter._return,
    ast.For: Interpreter._for,
    ast.While: Interpreter._while,
    ast.Break: Interpreter._loop,
    ast.Continue: Interpreter._loop,
    ast.Try: Interpreter._try,
    ast.With: Interpreter._with,
    ast.Raise: Interpreter._raise,
}


def _as_load(node: ast.expr) -> ast.expr:
    if isinstance(node, ast.Name):
        return ast.copy_location(ast.Name(node.id, ast.Load()), node)
    if isinstance(node, ast.Attribute):
        return ast.copy_location(ast.Attribute(node.value, node.attr, ast.Load()), node)
    if isinstance(node, ast.Subscript):
        return ast.copy_location(ast.Subscript(node.value, node.slice, ast.Load()), node)
    return node
