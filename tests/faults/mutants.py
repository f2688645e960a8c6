"""Single faults of a Python source, for tests/mutation.py. Each keeps the lines of the rest of its file."""

from __future__ import annotations

import ast
import io
import tokenize
from bisect import bisect_left, bisect_right
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import accumulate, pairwise

import numpy as np

COMPARED: dict[type[ast.cmpop], tuple[str, ...]] = {
    ast.Lt: ("<=", ">"),
    ast.LtE: ("<", ">="),
    ast.Gt: (">=", "<"),
    ast.GtE: (">", "<="),
    ast.Eq: ("!=",),
    ast.NotEq: ("==",),
    ast.Is: ("is not",),
    ast.IsNot: ("is",),
    ast.In: ("not in",),
    ast.NotIn: ("in",),
}
ARITHMETIC = {"+": "-", "-": "+", "*": "/", "/": "*"}
ARITHMETIC |= {f"{old}=": f"{new}=" for old, new in ARITHMETIC.items()}
CONNECTIVE = {"and": "or", "or": "and", "&": "|", "|": "&"}
EXTREMES = {"min": "max", "argmin": "argmax", "minimum": "maximum", "nanmin": "nanmax", "any": "all", "floor": "ceil"}
EXTREMES |= {new: old for old, new in EXTREMES.items()}
SYMMETRIC = {"min", "max", "minimum", "maximum", "hypot", "allclose", "array_equal", "same_as"}
TALK = {"progress", "say", "warn", "TYPE_CHECKING"}

Span = tuple[int, int]
Edit = tuple[int, int, str]  # start and end in the text, what stands there instead


@dataclass(frozen=True)
class Mutant:
    """One fault: text[start:end] of a file becomes `after`. line, column: where it starts, from 1 and 0."""

    file: str
    line: int
    column: int
    operator: str
    before: str
    after: str
    source: str
    start: int
    end: int

    def plant(self, text: str) -> str:
        """The file's text with the fault in it."""
        return text[: self.start] + self.after + text[self.end :]


class Source:
    """A parsed text that knows where its nodes and operators stand. siblings: as of `sibling_fields`."""

    def __init__(self, text: str, siblings: Mapping[str, Iterable[str]] | None = None) -> None:
        self.text, self.tree, self.siblings = text, ast.parse(text), siblings or {}
        self.lines = io.StringIO(text).readlines()
        self.starts = [0, *accumulate(map(len, self.lines))]
        self.tokens = [
            (self.starts[token.start[0] - 1] + token.start[1], token.string)
            for token in tokenize.generate_tokens(io.StringIO(text).readline)
            if token.type in (tokenize.OP, tokenize.NAME)
        ]
        subscripts = (node for node in ast.walk(self.tree) if isinstance(node, ast.Subscript))
        places = (part for node in subscripts for part in index_parts(node) if whole(part) is not None)
        self.index_nodes = {id(node) for part in places for node in ast.walk(part)}

    def span(self, node: ast.AST) -> Span:
        """Where a node stands; ast counts columns in bytes."""
        ends = ((node.lineno, node.col_offset), (node.end_lineno, node.end_col_offset))  # type: ignore[attr-defined]
        start, end = (
            self.starts[row - 1] + len(self.lines[row - 1].encode()[:column].decode()) for row, column in ends
        )
        return start, end

    def segment(self, node: ast.AST) -> str:
        """The text of a node."""
        return self.text[slice(*self.span(node))]

    def between(self, left: ast.AST, right: ast.AST) -> Span:
        """Where the operator between two operands stands."""
        after, before = self.span(left)[1], self.span(right)[0]
        gap = self.tokens[bisect_left(self.tokens, (after, "")) : bisect_left(self.tokens, (before, ""))]
        found = [(at, word) for at, word in gap if word not in "()"]
        return found[0][0], found[-1][0] + len(found[-1][1])

    def drop(self, start: int, end: int) -> Edit:
        """An edit that leaves out a stretch, but for its line ends."""
        return start, end, "\n" * self.text.count("\n", start, end)


def index_parts(node: ast.Subscript) -> list[ast.expr]:
    """What stands between the brackets, one for each axis."""
    return node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]


def whole(node: ast.AST) -> int | None:
    """Value of a whole number, with its sign."""
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        value = whole(node.operand)
        return None if value is None else -value
    return node.value if isinstance(node, ast.Constant) and type(node.value) is int else None


def word(node: ast.AST) -> str:
    """Last part of a (dotted) name, "" for anything else."""
    return node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""


def written(node: ast.AST) -> bool:
    """Whether a node is a piece of text, or a starred argument: nothing to reckon with."""
    return isinstance(node, ast.JoinedStr | ast.Starred) or (
        isinstance(node, ast.Constant) and isinstance(node.value, str)
    )


def comparison(source: Source, node: ast.AST) -> Iterator[Edit]:
    if isinstance(node, ast.Compare):
        for (left, right), op in zip(pairwise([node.left, *node.comparators]), node.ops, strict=True):
            for after in COMPARED[type(op)]:
                yield *source.between(left, right), after


def swapped_words(source: Source, left: ast.AST, right: ast.AST, table: Mapping[str, str]) -> Iterator[Edit]:
    start, end = source.between(left, right)
    if source.text[start:end] in table and not (written(left) or written(right)):
        yield start, end, table[source.text[start:end]]


def arithmetic(source: Source, node: ast.AST) -> Iterator[Edit]:
    if isinstance(node, ast.BinOp):
        yield from swapped_words(source, node.left, node.right, ARITHMETIC)
    elif isinstance(node, ast.AugAssign):
        yield from swapped_words(source, node.target, node.value, ARITHMETIC)


def connective(source: Source, node: ast.AST) -> Iterator[Edit]:
    pairs = pairwise(node.values) if isinstance(node, ast.BoolOp) else ()
    for left, right in [(node.left, node.right)] if isinstance(node, ast.BinOp) else pairs:
        yield from swapped_words(source, left, right, CONNECTIVE)


def arguments(source: Source, node: ast.AST) -> Iterator[Edit]:
    if isinstance(node, ast.Call) and word(node.func) not in SYMMETRIC:
        named = [keyword.value for keyword in node.keywords if keyword.arg not in {None, "dtype", *TALK}]
        for left, right in [*pairwise(node.args), *pairwise(named)]:
            (start, left_end), (right_start, end) = source.span(left), source.span(right)
            first, second = source.segment(left), source.segment(right)
            if first != second and not (written(left) or written(right)):
                yield start, end, second + source.text[left_end:right_start] + first


def index(source: Source, node: ast.AST) -> Iterator[Edit]:
    for part in index_parts(node) if isinstance(node, ast.Subscript) else ():
        if whole(part) in (0, -1):
            yield *source.span(part), "-1" if whole(part) == 0 else "0"


def transpose(source: Source, node: ast.AST) -> Iterator[Edit]:
    called = node.func if isinstance(node, ast.Call) else None
    access = called if word(called or ast.Pass()) in ("transpose", "swapaxes") else node
    if isinstance(access, ast.Attribute) and word(access.value) != "np" and (access is called or access.attr == "T"):
        yield source.drop(source.text.rindex(".", 0, source.span(access)[1]), source.span(node)[1])


def inverse(source: Source, node: ast.AST) -> Iterator[Edit]:
    if isinstance(node, ast.Call) and word(node.func) in ("inverse", "inv", "pinv"):
        if len(node.args) == 1:
            yield source.drop(*source.span(node.func))
        elif isinstance(node.func, ast.Attribute):
            yield source.drop(source.text.rindex(".", 0, source.span(node.func)[1]), source.span(node)[1])


def negation(source: Source, node: ast.AST) -> Iterator[Edit]:
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.Invert):
        start = source.span(node)[0]
        yield start, start + (4 if source.text.startswith("not ", start) else 3 if source.text[start] == "n" else 1), ""


def extreme(source: Source, node: ast.AST) -> Iterator[Edit]:
    if word(node) in EXTREMES and isinstance(node.ctx, ast.Load):  # type: ignore[attr-defined]
        end = source.span(node)[1]
        yield end - len(word(node)), end, EXTREMES[word(node)]


def constant(source: Source, node: ast.AST) -> Iterator[Edit]:
    value = node.value if isinstance(node, ast.Constant) and id(node) not in source.index_nodes else None
    if isinstance(value, int | float) and not isinstance(value, bool):
        for after in (f"{2 * value!r}", f"{value + 1!r}", f"(-{value!r})"):
            if value != 0 or after == "1":
                yield *source.span(node), after


def attribute(source: Source, node: ast.AST) -> Iterator[Edit]:
    if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load):
        end = source.span(node)[1]
        for other in sorted(source.siblings.get(node.attr, ())):
            yield end - len(node.attr), end, other


def truth(source: Source, node: ast.AST) -> Iterator[Edit]:
    if isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield *source.span(node), str(not node.value)


OPERATORS: dict[str, Callable[[Source, ast.AST], Iterator[Edit]]] = {
    operator.__name__: operator
    for operator in (
        *(comparison, arithmetic, connective, arguments, index, transpose),
        *(inverse, negation, extreme, constant, attribute, truth),
    )
}


def sibling_fields(trees: Iterable[ast.AST]) -> dict[str, set[str]]:
    """Fields of frozen dataclasses, each with the next one of the same class and annotation; arrays' own names not."""
    found = defaultdict(set)
    for node in (node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.ClassDef)):
        if any("frozen=True" in ast.unparse(decorator) for decorator in node.decorator_list):
            kinds = defaultdict(list)
            for field in node.body:
                if isinstance(field, ast.AnnAssign):
                    kinds[ast.unparse(field.annotation)].append(word(field.target))
            for names in kinds.values():
                for name, other in zip(names, names[1:] + names[:1], strict=True):
                    if name != other and not hasattr(np.ndarray, name):
                        found[name].add(other)
    return dict(found)


def idle(node: ast.AST) -> bool:
    """Whether a node decides nothing about a result: messages, progress, type checking, names shown or exported."""
    if isinstance(node, ast.Raise | ast.Assert | ast.JoinedStr):
        return True
    if isinstance(node, ast.keyword):
        return node.arg in TALK
    if isinstance(node, ast.FunctionDef):
        return node.name in ("__repr__", "__str__")
    if isinstance(node, ast.Assign):
        return any(word(target) == "__all__" for target in node.targets)
    asked = node.test if isinstance(node, ast.If) else node.func if isinstance(node, ast.Call) else ast.Pass()
    return any(word(part) in TALK for part in ast.walk(asked))


def deciding(node: ast.AST) -> Iterator[ast.AST]:
    """Nodes that may be changed: without annotations, decorators and what is `idle`."""
    yield node
    left_out = [getattr(node, "annotation", None), getattr(node, "returns", None), *getattr(node, "decorator_list", [])]
    for child in ast.iter_child_nodes(node):
        if not idle(child) and not any(child is part for part in left_out):
            yield from deciding(child)


def mutants(file: str, text: str, siblings: Mapping[str, Iterable[str]] | None = None) -> list[Mutant]:
    """All faults of a file's text, in the order of its nodes."""
    source = Source(text, siblings)
    found = []
    for node in deciding(source.tree):
        for name, operator in OPERATORS.items():
            for start, end, after in operator(source, node):
                line = bisect_right(source.starts, start)
                place = (file, line, start - source.starts[line - 1])
                shown = source.lines[line - 1].strip()
                found.append(Mutant(*place, name, text[start:end], after, shown, start, end))
    return found
