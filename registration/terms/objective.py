"""A sum of terms to be minimized over B-spline coefficients c (3, ni, nj, nk), mm."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from registration.volume import Array


@dataclass(frozen=True)
class QuadraticModel:
    """A term near c, to second order. value; gradient: (3, ni, nj, nk), exact; apply: d -> H d with H a positive
    semidefinite Gauss-Newton Hessian; diagonal: that of H, (3, ni, nj, nk)."""

    value: float
    gradient: Array
    apply: Callable[[Array], Array]
    diagonal: Array


class Term(Protocol):
    """One summand: its value alone, and its model near c."""

    def value(self, c: Array) -> float: ...

    def model(self, c: Array) -> QuadraticModel: ...


@dataclass(frozen=True)
class Objective:
    """Sum of terms, itself a term."""

    terms: Sequence[Term]

    def value(self, c: Array) -> float:
        """Sum of the terms' values."""
        return sum(term.value(c) for term in self.terms)

    def model(self, c: Array) -> QuadraticModel:
        """Sum of the terms' models."""
        models = [term.model(c) for term in self.terms]
        first, rest = models[0], models[1:]

        def apply(d: Array) -> Array:
            out = first.apply(d)
            for m in rest:
                out = out + m.apply(d)
            return out

        return QuadraticModel(
            sum(m.value for m in models),
            sum((m.gradient for m in rest), first.gradient),
            apply,
            sum((m.diagonal for m in rest), first.diagonal),
        )
