"""Mechanics of a breathing lung: what moves it, and what it settles to.

`breathe_out` is the elastic lung that the wall of another state pulls; `balance` finds the equilibrium at finite strain
of a `Scene`: tissue, pressure, point constraints and a cavity.
"""

from poro.breathing.elastic import Breathing, Lung, breathe_out
from poro.breathing.equilibrium import ConstraintTerms, Scene, balance

__all__ = ["Breathing", "ConstraintTerms", "Lung", "Scene", "balance", "breathe_out"]
