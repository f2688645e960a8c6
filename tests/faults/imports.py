"""Who imports whom, read from the sources: which tests reach a module, and whose kernels are compiled with it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

LEFT_OUT = {".git", ".venv", "venv", ".mypy_cache", ".ruff_cache", ".pytest_cache", "build", "dist", "results"}


class Imports:
    """Python files below a root. trees: their syntax, by path from there."""

    def __init__(self, root: Path) -> None:
        self.root = root
        paths = (path.relative_to(root) for path in sorted(root.rglob("*.py")))
        files = [path.as_posix() for path in paths if not LEFT_OUT & set(path.parts)]
        self.trees = {file: ast.parse((root / file).read_text(encoding="utf-8")) for file in files}
        self._files = {file.removesuffix(".py").removesuffix("/__init__").replace("/", "."): file for file in files}
        self._names = {file: dict(self._imported(file)) for file in files}
        self._compiled = {file: [self._names[file].get(name) for name in self._in_kernels(file)] for file in files}

    def reached(self, file: str) -> dict[str, int]:
        """Files that a file imports, and in how many steps; what a package only passes on is no step."""
        steps = {file: 0}
        waiting = [file]
        for here in waiting:
            for there in self._names[here].values():
                if there not in steps:
                    steps[there] = steps[here] + 1
                    waiting.append(there)
        return steps

    def compiled_with(self, file: str) -> set[str]:
        """The file and all whose kernels hold something of it: numba keeps them when only the file itself changes."""
        found = {file}
        waiting = [file]
        for there in waiting:
            using = [here for here, used in self._compiled.items() if there in used and here not in found]
            found.update(using)
            waiting += using
        return found

    def function(self, file: str, line: int) -> str | None:
        """`file:line` of the innermost function whose body holds a line, by its own first line, as Python counts it.

        None outside of functions and in a kernel, which nobody sees entered.
        """
        found = None
        for node in ast.walk(self.trees[file]):  # outer ones first
            if isinstance(node, ast.FunctionDef) and node.body[0].lineno <= line <= (node.end_lineno or 0):
                if any("jit" in ast.unparse(word) for word in node.decorator_list):
                    return None
                found = f"{file}:{min(part.lineno for part in (node, *node.decorator_list))}"
        return found

    def _imported(self, file: str) -> Iterator[tuple[str, str]]:
        """Names a file imports from others of the tree, each with the file that defines it."""
        for node in ast.walk(self.trees[file]):
            if isinstance(node, ast.Import | ast.ImportFrom):
                for alias in node.names:
                    whole = alias.name if isinstance(node, ast.Import) else f"{node.module}.{alias.name}"
                    found = self._defining(whole) or self._beside(file, whole)
                    if found:
                        yield alias.asname or alias.name, found

    def _defining(self, name: str) -> str | None:
        """File that defines a dotted name, looked for behind the packages that pass it on."""
        if name in self._files:
            return self._files[name]
        module, _, last = name.rpartition(".")
        file = self._files.get(module)
        if file and file.endswith("__init__.py"):
            for node in self.trees[file].body:
                if isinstance(node, ast.ImportFrom) and last in [alias.asname or alias.name for alias in node.names]:
                    return self._defining(f"{node.module}.{last}")
        return file

    def _beside(self, file: str, name: str) -> str | None:
        """File of the same folder: tests import their scenes so."""
        path = Path(file).with_name(f"{name.split('.')[0]}.py").as_posix()
        return path if path in self.trees else None

    def _in_kernels(self, file: str) -> set[str]:
        """Names in the kernels of a file and in its constants, which kernels take in; none where it has no kernel."""
        body = self.trees[file].body
        kernels = [
            node
            for node in body
            if isinstance(node, ast.FunctionDef) and any("jit" in ast.unparse(word) for word in node.decorator_list)
        ]
        constants = [node.value for node in body if isinstance(node, ast.Assign | ast.AnnAssign) and node.value]
        parts = [*(line for node in kernels for line in node.body), *constants] if kernels else []
        return {node.id for part in parts for node in ast.walk(part) if isinstance(node, ast.Name)}
