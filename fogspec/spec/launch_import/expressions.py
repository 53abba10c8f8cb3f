"""Expressions of Python launch files: their values, as far as they are known without running anything."""

import ast
import operator
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any, cast

from fogspec.spec.launch_import.found import LaunchImport, Made, Place, Unknown
from fogspec.spec.launch_import.methods import method
from fogspec.spec.launch_import.program import (
    MOST_ITEMS,
    Bound,
    Call,
    Function,
    Key,
    Named,
    Raised,
    Return,
    Scope,
    truth,
    wide,
)

if TYPE_CHECKING:
    from fogspec.spec.launch_import.interpreter import Interpreter

DEEPEST_CALL = 40
DEEPEST_EXPRESSION = 100
# What a call and an expression count as, in characters handled: about the time they take.
OF_CALL, OF_VALUE = 400, 20
LAUNCH = ("launch", "launch_ros", "nav2_common", "moveit_configs_utils", "launch_param_builder", "fogros2", "fogspec",
          "launch_xml", "launch_yaml", "webots_ros2_driver", "launch_testing")  # fmt: skip

BINARY: dict[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv, ast.Mod: operator.mod, ast.BitOr: operator.or_, ast.BitAnd: operator.and_,
}  # fmt: skip
COMPARE: dict[type[ast.cmpop], Callable[[Any, Any], Any]] = {
    ast.Eq: operator.eq, ast.NotEq: operator.ne, ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt,
    ast.GtE: operator.ge, ast.In: lambda a, b: a in b, ast.NotIn: lambda a, b: a not in b,
    ast.Is: operator.is_, ast.IsNot: operator.is_not,
}  # fmt: skip


class Expressions(ABC):
    """The part of an interpreter that evaluates."""

    found: LaunchImport
    path: str
    lines: list[str]
    call_other: Call
    calls: int
    depth: int
    star: bool
    constructed: list[Made]

    @abstractmethod
    def statements(self, body: list[ast.stmt], scope: Scope) -> None:
        """Do statements in order."""

    @abstractmethod
    def assign(self, target: ast.expr, value: Any, scope: Scope) -> None:
        """Bind names, or set an item."""

    def place(self, node: ast.AST) -> Place:
        """Return line, column and width of a node's first line, in characters; Python counts bytes."""
        number = getattr(node, "lineno", 1)
        line = self.lines[number - 1] if number <= len(self.lines) else ""
        self.found.spend(len(line) // 16)
        start = getattr(node, "col_offset", 0)
        end = getattr(node, "end_col_offset", None) if getattr(node, "end_lineno", None) == number else None
        if not line.isascii():
            content = line.encode()
            end = None if end is None else len(content[:end].decode("utf-8", "ignore"))
            start = len(content[:start].decode("utf-8", "ignore"))
        return Place(self.path, number, start + 1, max(1, (len(line.rstrip()) if end is None else end) - start))

    def value(self, node: ast.expr, scope: Scope) -> Any:
        """Return an expression's value, or why only a launch would determine it."""
        self.depth += 1
        try:
            if self.depth > DEEPEST_EXPRESSION:
                return Unknown(self.place(node), "it is nested too deep")
            value = self._value(node, scope)
            self.found.spend(OF_VALUE + (len(value) if isinstance(value, (str, list, tuple, dict)) else 0))
            return value
        except (TypeError, ValueError, KeyError, IndexError, ZeroDivisionError, OverflowError, AttributeError) as wrong:
            return Unknown(self.place(node), f"it fails: {type(wrong).__name__}")
        finally:
            self.depth -= 1

    def _value(self, node: ast.expr, scope: Scope) -> Any:
        do = VALUES.get(type(node))
        return Unknown(self.place(node), f"{type(node).__name__} is not read") if do is None else do(self, node, scope)

    def _sequence(self, node: ast.List | ast.Tuple | ast.Set, scope: Scope) -> Any:
        items = self._items(node.elts, scope)
        return tuple(items) if isinstance(node, ast.Tuple) else items

    def _unary(self, node: ast.UnaryOp, scope: Scope) -> Any:
        value = self.value(node.operand, scope)
        if isinstance(value, Unknown):
            return value
        if isinstance(node.op, ast.Not):
            return not truth(value)
        return -value if isinstance(node.op, ast.USub) else +value

    def _choice(self, node: ast.IfExp, scope: Scope) -> Any:
        test = self.value(node.test, scope)
        if isinstance(test, Unknown):
            return test
        return self.value(node.body if truth(test) else node.orelse, scope)

    def _list_of(self, node: ast.ListComp | ast.GeneratorExp | ast.SetComp, scope: Scope) -> Any:
        return self._comprehension(node.elt, node.generators, scope)

    def _dict_of(self, node: ast.DictComp, scope: Scope) -> Any:
        pair = ast.copy_location(ast.Tuple([node.key, node.value], ast.Load()), node)
        pairs = self._comprehension(pair, node.generators, scope)
        return pairs if isinstance(pairs, Unknown) else dict(pairs)

    def _walrus(self, node: ast.NamedExpr, scope: Scope) -> Any:
        value = self.value(node.value, scope)
        self.assign(node.target, value, scope)
        return value

    def _name(self, node: ast.Name, scope: Scope) -> Any:
        try:
            return scope.find(node.id)
        except KeyError:
            of_launch = self.star and node.id[:1].isupper()
            return Named(f"launch.{node.id}" if of_launch else f"builtins.{node.id}")

    def _items(self, nodes: list[ast.expr], scope: Scope) -> list[Any]:
        items: list[Any] = []
        for one in nodes:
            value = self.value(one, scope)
            if isinstance(one, ast.Starred) and isinstance(value, (list, tuple)):
                items += value
            else:
                items.append(value)
        return items

    def _dict(self, node: ast.Dict, scope: Scope) -> Any:
        found: dict[Any, Any] = {}
        for key, one in zip(node.keys, node.values, strict=True):
            value = self.value(one, scope)
            if key is None:
                if not isinstance(value, dict):
                    return value if isinstance(value, Unknown) else Unknown(self.place(one), "it is not a dictionary")
                found |= value
            else:
                name = self.value(key, scope)
                if isinstance(name, Unknown):
                    return name
                found[Key(name) if isinstance(name, Made) else tuple(name) if isinstance(name, list) else name] = value
        return found

    def _joined(self, node: ast.JoinedStr, scope: Scope) -> Any:
        text = ""
        for one in node.values:
            if isinstance(one, ast.Constant):
                text += str(one.value)
                continue
            assert isinstance(one, ast.FormattedValue)
            value = self.value(one.value, scope)
            if not isinstance(value, (str, int, float, bool, PurePosixPath)) and value is not None:
                return value if isinstance(value, Unknown) else Unknown(self.place(one), "it has no text")
            layout = ""
            if one.format_spec is not None:
                layout = self.value(one.format_spec, scope)
                if not isinstance(layout, str) or len(layout) > 8:
                    return Unknown(self.place(one), "its format is not read")
            text += format(repr(value) if one.conversion == ord("r") else value, layout) if layout else str(value)
            self.found.spend(len(text))
        return text

    def _binary(self, node: ast.BinOp, scope: Scope) -> Any:
        left, right = self.value(node.left, scope), self.value(node.right, scope)
        for one in (left, right):
            if isinstance(one, Unknown):
                return one
        if isinstance(left, Made) and isinstance(node.op, ast.Div):
            return Made("PathJoinSubstitution", [[left, right]], {}, self.place(node))
        do = BINARY.get(type(node.op))
        if do is None or isinstance(left, (Made, Named, Function)) or isinstance(right, (Made, Named, Function)):
            return Unknown(self.place(node), "this operation is not read")
        if do is operator.mul:
            for some, times in ((left, right), (right, left)):
                if isinstance(some, (str, list, tuple)) and (
                    not isinstance(times, int) or len(some) * times > MOST_ITEMS
                ):
                    return Unknown(self.place(node), "it is too large")
        if do is operator.mod and isinstance(left, str) and (len(left) > 1000 or wide(left)):
            return Unknown(self.place(node), "its format is not read")
        value = do(left, right)
        if isinstance(value, int) and value.bit_length() > 4096:
            return Unknown(self.place(node), "it is too large")
        return value

    def _bool(self, node: ast.BoolOp, scope: Scope) -> Any:
        value: Any = None
        for one in node.values:
            value = self.value(one, scope)
            if isinstance(value, Unknown):
                return value
            if truth(value) == isinstance(node.op, ast.Or):
                return value
        return value

    def _compare(self, node: ast.Compare, scope: Scope) -> Any:
        left = self.value(node.left, scope)
        for op, one in zip(node.ops, node.comparators, strict=True):
            right = self.value(one, scope)
            for side in (left, right):
                if isinstance(side, Unknown):
                    return side
            if not COMPARE[type(op)](left, right):
                return False
            left = right
        return True

    def _subscript(self, node: ast.Subscript, scope: Scope) -> Any:
        of = self.value(node.value, scope)
        if isinstance(of, Unknown):
            return of
        if isinstance(node.slice, ast.Slice):
            ends = [
                None if one is None else self.value(one, scope)
                for one in (node.slice.lower, node.slice.upper, node.slice.step)
            ]
            return of[slice(*ends)]
        key = self.value(node.slice, scope)
        if isinstance(key, Unknown):
            return key
        if isinstance(of, (Made, Named)):
            kind = of.kind if isinstance(of, Made) else of.name
            return self.call_other(cast("Interpreter", self), f"{kind}.get", [of, key], {}, self.place(node))
        if isinstance(of, dict) and key not in of:
            raise Raised(self.place(node), f"there is no {key!r} here")
        return of[key]

    def _comprehension(self, item: ast.expr, generators: list[ast.comprehension], scope: Scope) -> Any:
        found: list[Any] = []
        inner = Scope({}, scope)

        def over(rest: list[ast.comprehension]) -> Unknown | None:
            if not rest:
                found.append(self.value(item, inner))
                return None
            values = self.value(rest[0].iter, inner)
            if isinstance(values, (Unknown, Made, Named, Function)):
                return values if isinstance(values, Unknown) else Unknown(self.place(rest[0].iter), "it is not a list")
            for one in list(values):
                self.found.spend(1)
                self.assign(rest[0].target, one, inner)
                tests = [self.value(test, inner) for test in rest[0].ifs]
                for test in tests:
                    if isinstance(test, Unknown):
                        return test
                if all(map(truth, tests)) and (wrong := over(rest[1:])) is not None:
                    return wrong
            return None

        wrong = over(generators)
        return found if wrong is None else wrong

    def defined(self, node: ast.FunctionDef | ast.Lambda, scope: Scope) -> Function:
        """Return a function of the launch file."""
        return Function(node, scope, [self.value(one, scope) for one in node.args.defaults])

    # Attributes and calls

    def _attribute(self, node: ast.Attribute, scope: Scope) -> Any:
        of = self.value(node.value, scope)
        if isinstance(of, Unknown):
            return of
        if isinstance(of, Named):
            if of.name == "os" and node.attr == "environ":
                return Made("environ", [], {}, self.place(node))
            if of.name in ("os", "os.path") and node.attr == "sep":
                return "/"
            if of.name == "math" and node.attr in ("pi", "tau", "e"):
                import math

                return getattr(math, node.attr)
            return Named(f"{of.name}.{node.attr}")
        if isinstance(of, PurePosixPath) and node.attr in ("name", "stem", "suffix", "parent", "parents", "parts"):
            return getattr(of, node.attr)
        if isinstance(of, Made) and of.kind == "LaunchContext" and node.attr == "launch_configurations":
            return of
        if isinstance(of, Made) and of.kind == "LaunchContext" and node.attr == "environment":
            return Made("environ", [], {}, self.place(node))
        return Bound(of, node.attr)

    def _call(self, node: ast.Call, scope: Scope) -> Any:
        function = self.value(node.func, scope)
        args = self._items(node.args, scope)
        words: dict[str, Any] = {}
        for one in node.keywords:
            value = self.value(one.value, scope)
            if one.arg is not None:
                words[one.arg] = value
            elif isinstance(value, dict):
                words |= {str(key): below for key, below in value.items()}
            else:
                self.found.note(self.place(one.value), "the arguments in ** are not read")
        value = self.call(function, args, words, self.place(node))
        if isinstance(value, Made) and value.kind == "SkyLaunchDescription":
            value.places = {one.arg: self.place(one.value) for one in node.keywords if one.arg is not None}
        return value

    def call(self, function: Any, args: list[Any], words: dict[str, Any], place: Place) -> Any:
        """Return what a function returns."""
        self.found.spend(OF_CALL)
        if isinstance(function, Unknown):
            return function
        if isinstance(function, Function):
            return self._called(function, args, words, place)
        if isinstance(function, Bound):
            if isinstance(function.of, Made):
                return self.call_other(
                    cast("Interpreter", self), f".{function.name}", [function.of, *args], words, place
                )
            return method(function.of, function.name, args, words, place, cast("Interpreter", self))
        if isinstance(function, Named):
            root = function.name.partition(".")[0]
            if root in LAUNCH and function.last[:1].isupper():
                made = Made(function.last, args, words, place)
                if function.last == "SkyLaunchDescription":
                    self.constructed.append(made)
                return made
            return self.call_other(cast("Interpreter", self), function.name, args, words, place)
        return Unknown(place, "what is called here is not read")

    def _called(self, function: Function, args: list[Any], words: dict[str, Any], place: Place) -> Any:
        if self.calls >= DEEPEST_CALL:
            return Unknown(place, f"functions call each other more than {DEEPEST_CALL} deep")
        given = function.node.args
        names = [one.arg for one in [*given.posonlyargs, *given.args]]
        local: dict[str, Any] = dict(zip(names[len(names) - len(function.defaults) :], function.defaults, strict=True))
        for one, default in zip(given.kwonlyargs, given.kw_defaults, strict=True):
            if default is not None:
                local[one.arg] = self.value(default, function.scope)
        local |= dict(zip(names, args, strict=False))
        if given.vararg:
            local[given.vararg.arg] = list(args[len(names) :])
        known = {*names, *(one.arg for one in given.kwonlyargs)}
        local |= {key: value for key, value in words.items() if key in known}
        if given.kwarg:
            local[given.kwarg.arg] = {key: value for key, value in words.items() if key not in known}
        for name in known - local.keys():
            local[name] = Unknown(place, f"the argument {name} is missing")
        scope = Scope(local, function.scope)
        self.calls += 1
        depth, self.depth = self.depth, self.depth // 2
        try:
            if isinstance(function.node, ast.Lambda):
                return self.value(function.node.body, scope)
            self.statements(function.node.body, scope)
            return None
        except Return as ended:
            return ended.value
        finally:
            self.calls, self.depth = self.calls - 1, depth


VALUES: dict[type[ast.expr], Callable[[Expressions, Any, Scope], Any]] = {
    ast.Constant: lambda _, node, __: node.value,
    ast.Name: Expressions._name,
    ast.Call: Expressions._call,
    ast.Attribute: Expressions._attribute,
    ast.List: Expressions._sequence,
    ast.Tuple: Expressions._sequence,
    ast.Set: Expressions._sequence,
    ast.Dict: Expressions._dict,
    ast.JoinedStr: Expressions._joined,
    ast.BinOp: Expressions._binary,
    ast.UnaryOp: Expressions._unary,
    ast.BoolOp: Expressions._bool,
    ast.Compare: Expressions._compare,
    ast.IfExp: Expressions._choice,
    ast.Subscript: Expressions._subscript,
    ast.ListComp: Expressions._list_of,
    ast.GeneratorExp: Expressions._list_of,
    ast.SetComp: Expressions._list_of,
    ast.DictComp: Expressions._dict_of,
    ast.Lambda: lambda at, node, scope: at.defined(node, scope),
    ast.NamedExpr: Expressions._walrus,
    ast.Starred: lambda at, node, scope: at.value(node.value, scope),
}
