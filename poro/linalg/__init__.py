"""Linear solvers for matrices with one or three unknowns a node, and acceleration of fixed points; knows no mesh.

`linear_solver` factors by nested dissection with dense fronts; where the factor would be too large it takes conjugate
gradients preconditioned by pyamg's smoothed aggregation. `inverse_at` gives chosen rows and columns of the inverse.
"""

from poro.linalg.anderson import Anderson
from poro.linalg.cholesky import Cholesky, cholesky
from poro.linalg.dissection import dissect
from poro.linalg.solver import LinearSolver, Multigrid, inverse_at, linear_solver

__all__ = ["Anderson", "Cholesky", "LinearSolver", "Multigrid", "cholesky", "dissect", "inverse_at", "linear_solver"]
