"""Mechanics of a collapsing lung: numpy arrays in, numpy arrays out, lengths in mm and pressures in kPa.

A lung is meshed (`poro.mesh`), given tissue and forms (`poro.fem`), set in front of its chest wall (`poro.contact`),
collapsed at given parameters (`poro.collapse`) and fitted to what is seen of it (`poro.fit`), on linear solvers of
`poro.linalg`. Each room imports only those before it: linalg and mesh; fem and contact; collapse; fit.
"""

from poro.collapse import Theta, assemble, solve
from poro.errors import SolverError
from poro.fem import Tissue
from poro.fit import Target, fit_collapse
from poro.mesh import TetMesh, stuff

__all__ = ["SolverError", "Target", "TetMesh", "Theta", "Tissue", "assemble", "fit_collapse", "solve", "stuff"]
