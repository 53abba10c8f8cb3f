"""Mutants of a module's source: one small change each, such as a deleted call or a dropped flag."""

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

COMPARED = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.In: ast.NotIn, ast.NotIn: ast.In, ast.Is: ast.IsNot, ast.IsNot: ast.Is,
}  # fmt: skip
ARITHMETIC = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.BitAnd: ast.BitOr}
WITHOUT = ("annotation", "returns", "decorator_list", "bases", "type_comment")  # what runs when a module is imported
Place = ast.expr | ast.stmt
DELETED = (ast.Expr, ast.AugAssign, ast.Raise, ast.Delete, ast.Continue, ast.Break)


@dataclass(frozen=True, order=True)
class Mutant:
    """A change of one piece of a module: `now` in place of `was`, from `start` to `end` of its bytes.

    Line numbers change with every landing: `where` names the function, and `nth` counts the same pieces in it.
    """

    module: str
    where: str
    was: str
    now: str
    nth: int
    text: str
    start: int
    end: int

    @property
    def key(self) -> tuple[str, str, str, str, int]:
        """What names the mutant in the list of survivors."""
        return (self.module, self.where, self.was, self.now, self.nth)

    def source(self, content: bytes) -> bytes:
        """The module with this change."""
        return content[: self.start] + self.text.encode() + content[self.end :]


def mutants(root: Path, module: str) -> list[Mutant]:
    """Every mutant of a module, in the order of its source."""
    content = (root / module).read_bytes()
    starts = [0]
    for line in content.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    found: dict[tuple[str, str, str], int] = {}
    every = []
    for where, node, new in _changes(ast.parse(content), ()):
        if ast.dump(node) == ast.dump(new):  # `while True`
            continue
        start = starts[node.lineno - 1] + node.col_offset
        end = starts[(node.end_lineno or 0) - 1] + (node.end_col_offset or 0)
        was, now = content[start:end].decode(), ast.unparse(new)
        nth = found[where, was, now] = found.get((where, was, now), 0) + 1
        text = f"({now})" if isinstance(node, ast.expr) else now
        every.append(Mutant(module, where, was, now, nth, text, start, end))
    return every


def _changes(node: ast.AST, path: tuple[str, ...]) -> Iterator[tuple[str, Place, ast.AST]]:
    """Yield each change: the function that it is in, the node that it replaces, and the new one."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        path = (*path, node.name)
    where = ".".join(path) or "module"
    yield from ((where, old, new) for old, new in _replacements(node))
    for name, value in ast.iter_fields(node):
        if name not in WITHOUT:
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST) and not _is_text(child, node):
                    yield from _changes(child, path)


def _is_text(node: ast.AST, parent: ast.AST) -> bool:
    """Return whether a node is text for people, or a type: f-strings, docstrings, what is raised, literals of types."""
    if isinstance(node, ast.JoinedStr) or (isinstance(parent, ast.Raise) and isinstance(node, ast.Call)):
        return True
    if isinstance(node, ast.Subscript) and isinstance(node.value, ast.Name):
        return node.value.id in ("Literal", "Annotated")
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def _replacements(node: ast.AST) -> Iterator[tuple[Place, ast.AST]]:
    if isinstance(node, DELETED) and not (
        isinstance(node, ast.Expr) and isinstance(node.value, ast.Yield | ast.Constant)
    ):
        yield node, ast.Pass()
    if isinstance(node, ast.If | ast.While | ast.IfExp) and ast.unparse(node.test) != "TYPE_CHECKING":
        yield from ((node.test, ast.Constant(value)) for value in (True, False))
    if isinstance(node, ast.Return) and node.value is not None and ast.unparse(node.value) != "None":
        yield node.value, ast.Constant(None)
    if isinstance(node, ast.expr):
        yield from ((node, new) for new in _expressions(node))


def _expressions(node: ast.expr) -> Iterator[ast.expr]:
    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        yield ast.Compare(node.left, [COMPARED[type(node.ops[0])]()], node.comparators)
    elif isinstance(node, ast.BinOp):
        yield from _sums(node)
    elif isinstance(node, ast.BoolOp):
        for number in range(len(node.values)):
            rest = [one for at, one in enumerate(node.values) if at != number]
            yield rest[0] if len(rest) == 1 else ast.BoolOp(node.op, rest)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        yield node.operand
    elif isinstance(node, ast.Call):
        for dropped in node.keywords:
            yield ast.Call(node.func, node.args, [one for one in node.keywords if one is not dropped])
    elif isinstance(node, ast.ListComp | ast.SetComp | ast.GeneratorExp | ast.DictComp):
        for one in node.generators:
            if one.ifs:
                bare = ast.parse(ast.unparse(node), mode="eval").body
                bare.generators[node.generators.index(one)].ifs = []  # type: ignore[attr-defined]
                yield bare
    elif isinstance(node, ast.Constant):
        yield from _constants(node.value)


def _sums(node: ast.BinOp) -> Iterator[ast.expr]:
    if isinstance(node.op, ast.BitOr):
        yield from (node.left, node.right)
    elif (other := ARITHMETIC.get(type(node.op))) is not None:
        yield ast.BinOp(node.left, other(), node.right)


def _constants(value: object) -> Iterator[ast.expr]:
    """Yield another value; a text with spaces is a sentence."""
    if isinstance(value, bool):
        yield ast.Constant(not value)
    elif isinstance(value, int | float):
        yield ast.Constant(value + 1)
    elif isinstance(value, str | bytes) and value and len(value.split()) == 1:
        yield ast.Constant(value + ("x" if isinstance(value, str) else b"x"))
