"""Launch files as they run here: a statement that meets what is not known does not end the file.

What the statement would have set becomes unknown, and the next one runs.
"""

import ast
import builtins
import importlib
from collections.abc import Callable
from typing import Any

from fogspec.importers.launch.constraints import is_constraint, may_be_constraint
from fogspec.importers.launch.sandboxed import paths
from fogspec.importers.launch.sandboxed.made import NAMES
from fogspec.importers.launch.sandboxed.values import OWN, Place, Stop, Unknown, is_caused, note, reason, text

WITHOUT = (
    ast.Global, ast.Nonlocal, ast.Pass, ast.Break, ast.Continue, ast.Raise, ast.Try, ast.TryStar, ast.AsyncFunctionDef,
)  # fmt: skip
BLOCKS = (ast.If, ast.For, ast.While, ast.With, ast.Match)
OUTER = (ast.NamedExpr, ast.Await, ast.Yield, ast.YieldFrom)
COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
INNER = (ast.Lambda, ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, *COMPREHENSIONS)
SAME: dict[type[ast.cmpop], str] = {ast.Eq: "eq", ast.NotEq: "ne", ast.In: "in", ast.NotIn: "not in"}

PLACES: dict[tuple[str, int], dict[str, Place]] = {}  # by file and line of a call: where its keywords are written


def run(source: str, name: str, names: dict[str, Any]) -> None:
    """Run a module's text; raise SyntaxError or ValueError if it is not Python."""
    tree = Guard(OWN[name]).visit(ast.parse(source, name))
    names |= {"__source__": source, "__after__": after, "__text__": text, "__part__": part, "__same__": paths.compared}
    exec(compile(ast.fix_missing_locations(tree), name, "exec"), names)  # noqa: S102


def after(problem: BaseException, kind: str) -> Unknown:
    """Return what a statement sets that met what is not known; note what it would have done. Other exceptions go on."""
    if not is_caused(problem):
        raise problem
    place = problem.place if isinstance(problem, Stop) else None
    if kind != "sets":
        note(place, f"what this {kind} is not taken over: {reason(problem)}")
    return Unknown(reason(problem), place)


class Names(dict[str, Any]):
    """The names of a launch file; one of the paper's form, which imports nothing, finds the classes that it names."""

    def __missing__(self, name: str) -> Any:
        if "SkyLaunchDescription" not in self.get("__source__", "") or hasattr(builtins, name):
            raise KeyError(name)
        for library in NAMES.values():
            if name in library:
                return library[name]
        if name == "fogros2":
            return importlib.import_module(name)
        if is_constraint(name) or may_be_constraint(name):
            return name
        raise KeyError(name)


def part(function: Callable[[], Any], is_name_read: bool) -> Any:
    """Return what a part of a call gives; unknown if it meets what is not known, so that the other parts are kept."""
    try:
        return function()
    except Stop as stop:
        return Unknown(stop.why, stop.place)
    except Exception as problem:
        if is_name_read and isinstance(problem, NameError):
            return Unknown(str(problem))
        if not is_caused(problem):
            raise
        return Unknown(reason(problem))


class Guard(ast.NodeTransformer):
    """Puts each statement into a `try`, and marks texts that are put together of what is not known."""

    def __init__(self, path: str) -> None:
        self.path, self.in_class = path, False

    def visit_ClassDef(self, node: ast.ClassDef | ast.FunctionDef) -> ast.AST:
        """Visit a class or a function: what a class's body evaluates sees names that a function in it would not see."""
        before, self.in_class = self.in_class, isinstance(node, ast.ClassDef)
        try:
            return self.generic_visit(node)
        finally:
            self.in_class = before

    visit_FunctionDef = visit_ClassDef

    def generic_visit(self, node: ast.AST) -> ast.AST:
        """Guard the statements of each block."""
        super().generic_visit(node)
        for field in ("body", "orelse", "finalbody"):
            block = getattr(node, field, None)
            if isinstance(block, list) and not isinstance(node, ast.Match):
                setattr(node, field, [self._guarded(one, i) for i, one in enumerate(block)])
        return node

    def visit_JoinedStr(self, node: ast.JoinedStr) -> ast.AST:
        """Mark an f-string that holds something unknown, so that it does not compare as if it were known."""
        super().generic_visit(node)
        return _call("__text__", node, at=node)

    def visit_FormattedValue(self, node: ast.FormattedValue) -> ast.AST:
        """Visit the value alone: a format of an f-string is an f-string of its own."""
        node.value = self.visit(node.value)
        return node

    def visit_Call(self, node: ast.Call) -> ast.AST:
        """Mark what methods of texts return, and keep the other parts of a call where one meets what is not known."""
        super().generic_visit(node)
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if isinstance(node.func, ast.Attribute) and name in ("join", "format", "replace", "format_map"):
            return _call("__text__", node, at=node)
        if name[:1].isupper() and not self.in_class:
            is_sky = name == "SkyLaunchDescription"
            if is_sky:
                some = {one.arg or "": (self.path, one.lineno, one.col_offset + 1, 1) for one in node.keywords}
                PLACES[self.path, node.lineno] = some
            node.args = [self._parts(one, is_sky) for one in node.args]
            for keyword in node.keywords:
                keyword.value = self._parts(keyword.value, is_sky) if keyword.arg else keyword.value
        return node

    def _parts(self, value: ast.expr, is_name_read: bool) -> ast.expr:
        if isinstance(value, (ast.List, ast.Tuple)):
            value.elts = [self._parts(one, is_name_read) for one in value.elts]
            return value
        if isinstance(value, ast.Dict):
            value.values = [self._parts(one, is_name_read) for one in value.values]
            return value
        plain = (
            (ast.Constant, ast.Starred, ast.Lambda)
            if is_name_read
            else (ast.Constant, ast.Starred, ast.Lambda, ast.Name)
        )
        if isinstance(value, plain) or any(isinstance(one, OUTER) for one in ast.walk(value)):
            return value
        nothing = ast.arguments(posonlyargs=[], args=[], kwonlyargs=[], kw_defaults=[], defaults=[])
        inner = ast.copy_location(ast.Lambda(nothing, value), value)
        return _call("__part__", inner, ast.copy_location(ast.Constant(is_name_read), value), at=value)

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        """Mark texts made by `%`."""
        super().generic_visit(node)
        return _call("__text__", node, at=node) if isinstance(node.op, ast.Mod) else node

    def visit_Compare(self, node: ast.Compare) -> ast.AST:
        """Judge whether two are the same with paths of packages in mind."""
        super().generic_visit(node)
        kind = SAME.get(type(node.ops[0]))
        if kind is None or len(node.ops) > 1:
            return node
        word = ast.copy_location(ast.Constant(kind), node)
        return _call("__same__", word, node.left, node.comparators[0], at=node)

    def _guarded(self, statement: ast.stmt, position: int) -> ast.stmt:
        if not isinstance(statement, ast.stmt) or isinstance(statement, WITHOUT):
            return statement
        if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
            return statement
        if isinstance(statement, ast.ImportFrom) and statement.module == "__future__":
            return statement
        kind = "does" if isinstance(statement, ast.Expr) else "decides" if isinstance(statement, BLOCKS) else "sets"
        value = _call("__after__", ast.Name("__stop__", ast.Load()), ast.Constant(kind), at=statement)
        targets = _targets(statement)
        do: list[ast.stmt]
        if isinstance(statement, ast.Return):
            do = [ast.Return(value)]
        else:
            do = [ast.Assign([ast.Name("__what__", ast.Store())], value), *(_set(one) for one in targets)]
        handler = ast.ExceptHandler(ast.Name("BaseException", ast.Load()), "__stop__", do)
        return ast.copy_location(ast.Try([statement], [handler], [], []), statement)


def _call(name: str, *args: ast.expr, at: ast.AST) -> ast.expr:
    made = ast.Call(ast.Name(name, ast.Load()), list(args), [])
    return ast.copy_location(made, at)


def _set(target: ast.expr) -> ast.stmt:
    """Return the statement that sets a name, or what else is assigned to, to what is not known."""
    assign = ast.Assign([target], ast.Name("__what__", ast.Load()))
    if isinstance(target, ast.Name):
        return assign
    return ast.Try([assign], [ast.ExceptHandler(ast.Name("BaseException", ast.Load()), None, [ast.Pass()])], [], [])


def _targets(statement: ast.stmt) -> list[ast.expr]:
    """Return what a statement assigns to, in its own scope."""
    found: list[ast.expr] = []
    names: set[str] = set()
    if isinstance(statement, (ast.FunctionDef, ast.ClassDef)):
        return [ast.Name(statement.name, ast.Store())]
    if isinstance(statement, (ast.Import, ast.ImportFrom)):
        some = [one.asname or one.name.partition(".")[0] for one in statement.names if one.name != "*"]
        return [ast.Name(one, ast.Store()) for one in some]

    def walk(node: ast.AST) -> None:
        if isinstance(node, INNER):
            if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
                names.add(node.name)
            return
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and not node.id.startswith("__"):
            names.add(node.id)
        if isinstance(node, (ast.Attribute, ast.Subscript)) and isinstance(node.ctx, ast.Store):
            found.append(node)
        for below in ast.iter_child_nodes(node):
            walk(below)

    walk(statement)
    if isinstance(statement, BLOCKS):
        found = []
    return [*(ast.Name(one, ast.Store()) for one in sorted(names)), *found]
