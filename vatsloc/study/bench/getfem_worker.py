"""GetFEM's answer to lung problems that a file describes, run by the Python that carries GetFEM; file in, file out.

Written as a GetFEM user would: P1 fields, weak-form strings, MUMPS, augmented Lagrangian contact by Newton. Imports
nothing of the product. Ref: Alvarez 2021, eqs. 10-14; Alart & Curnier 1991 (augmented Lagrangian).
"""

from __future__ import annotations

import sys
import time
from typing import Any

import getfem as gf
import numpy as np

HILUM, WALL, OUTER = 1, 2, 3


class Lung:
    """GetFEM mesh with marked faces and P1 fields; node_of: given node of every scalar degree of freedom."""

    def __init__(self, data: Any) -> None:
        points, hilum = data["points"], data["hilum"]
        self.mesh = gf.Mesh("empty", 3)
        self.mesh.add_convex(
            gf.GeoTrans("GT_PK(3,1)"), np.ascontiguousarray(points[data["tets"]].transpose(2, 1, 0)).reshape(3, 4, -1)
        )
        self.scalar = gf.MeshFem(self.mesh, 1)
        self.scalar.set_fem(gf.Fem("FEM_PK(3,1)"))
        self.vector = gf.MeshFem(self.mesh, 3)
        self.vector.set_fem(gf.Fem("FEM_PK(3,1)"))
        self.node_of = matching(points, self.scalar.basic_dof_nodes().T)
        outer = self.mesh.outer_faces()
        held = np.zeros(len(points), bool)
        held[hilum] = True
        node_of_pid = matching(points, self.mesh.pts().T)
        between = self.mesh.faces_from_pid(np.flatnonzero(held[node_of_pid]))
        codes = np.array([[4], [1]])
        whole = np.isin((outer * codes).sum(axis=0), (between * codes).sum(axis=0))
        self.mesh.set_region(OUTER, outer)
        self.mesh.set_region(HILUM, outer[:, whole])
        self.mesh.set_region(WALL, outer[:, ~whole])
        # Nodal quadrature lumps the reaction and makes Signorini's conditions hold node by node.
        self.exact = gf.MeshIm(self.mesh, gf.Integ("IM_TETRAHEDRON(2)"))
        self.nodal = gf.MeshIm(self.mesh, gf.Integ("IM_NC(3,1)"))
        wall_dofs = np.setdiff1d(self.scalar.basic_dof_on_region(WALL), self.scalar.basic_dof_on_region(HILUM))
        self.multiplier = gf.MeshFem("partial", self.scalar, wall_dofs)

    def field(self, values: Any) -> Any:
        """Values (n,) or (n, 3) at the given nodes in the order of GetFEM's degrees of freedom."""
        return np.ascontiguousarray(values[self.node_of].ravel())

    def nodal_values(self, dofs: Any) -> Any:
        """Displacements (n, 3) at the given nodes."""
        u = np.empty((len(self.node_of), 3))
        u[self.node_of] = np.asarray(dofs).reshape(-1, 3)
        return u


def matching(points: Any, others: Any) -> Any:
    """Number in `points` of every row of `others`."""
    match = np.empty(len(points), int)
    match[np.lexsort(np.round(others, 6).T)] = np.lexsort(np.round(points, 6).T)
    if np.abs(points[match] - others).max() > 1e-9:
        raise ValueError("GetFEM's nodes are not the given ones")
    return match


def pressure(lung: Lung, data: Any, kappa_b: float) -> Any:
    """Pressure at GetFEM's degrees of freedom, kPa."""
    model = gf.Model("real")
    model.add_fem_variable("p", lung.scalar)
    model.add_initialized_data("mobility", float(data["mobility"]))
    model.add_initialized_data("evacuation", kappa_b)
    model.add_initialized_data("pleural", float(data["pleural"]))
    model.add_linear_term(lung.exact, "mobility*Grad_p.Grad_Test_p")
    model.add_linear_term(lung.nodal, "evacuation*p*Test_p")
    model.add_Dirichlet_condition_with_simplification("p", OUTER, "pleural")
    model.solve("lsolver", "mumps")
    return model.variable("p")


def elastic(lung: Lung, data: Any, p: Any, density: float) -> Any:
    """Model of the lung without wall."""
    model = gf.Model("real")
    model.add_fem_variable("u", lung.vector)
    model.add_fem_data("p", lung.scalar)
    model.set_variable("p", p)
    for name in ("lame", "shear", "biot"):
        model.add_initialized_data(name, float(data[name]))
    model.add_initialized_data("weight", density * data["weight"])
    model.add_initialized_fem_data("imposed", lung.vector, lung.field(data["imposed"]))
    model.add_isotropic_linearized_elasticity_brick(lung.exact, "u", "lame", "shear")
    model.add_linear_term(lung.exact, "biot*Grad_p.Test_u - weight.Test_u")
    model.add_Dirichlet_condition_with_simplification("u", HILUM, "imposed")
    return model


def add_wall(model: Any, lung: Lung, data: Any, travel: float) -> None:
    """Signorini's conditions on a wall given as an expression of x, y, z, moved by `travel` where it moves."""
    model.add_initialized_fem_data("offset", lung.scalar, lung.field(data["offset"]))
    model.add_initialized_fem_data("shift", lung.vector, lung.field(travel * data["moving"]))
    model.add_fem_variable("force", lung.multiplier)
    model.add_initialized_data("r", float(data["augmentation"]))
    gap = str(data["wall"])
    for name, axis in (("x", 1), ("y", 2), ("z", 3)):
        gap = gap.replace(name + "_", f"(X({axis})+u({axis})-shift({axis}))")
    model.add_nonlinear_term(lung.nodal, f"1/r*half_sqr_pos_part(force-r*(({gap})-offset)) - 1/(2*r)*sqr(force)", WALL)


def main(source: str, target: str) -> None:
    """Solve every case in `source`, without and with wall, and write displacements, processor seconds, steps."""
    data = np.load(source)
    started = time.process_time()
    lung = Lung(data)
    mesh_s = time.process_time() - started
    result: dict[str, list[Any]] = {name: [] for name in ("free", "contact", "free_s", "contact_s", "steps")}
    for kappa_b, density, travel in data["cases"]:
        for kind in ("free", "contact"):
            started = time.process_time()
            model = elastic(lung, data, pressure(lung, data, kappa_b), density)
            options: tuple[Any, ...] = ()
            if kind == "contact":
                add_wall(model, lung, data, travel)
                options = ("max_iter", 100, "max_res", 1e-7, "lsearch", "simplest")
            steps, converged = model.solve("lsolver", "mumps", *options)
            if not converged:
                raise RuntimeError(f"Newton did not converge in {steps} steps at kappa_b {kappa_b:.1e}")
            result[kind].append(lung.nodal_values(model.variable("u")))
            result[f"{kind}_s"].append(time.process_time() - started)
        result["steps"].append(steps)
    arrays: dict[str, Any] = {name: np.array(values) for name, values in result.items()}
    np.savez(target, mesh_s=mesh_s, **arrays)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
