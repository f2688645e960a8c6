"""GetFEM's answer to two elastic bodies pressed together, run by the Python that carries GetFEM; file in, file out.

Rays from quadrature points of the lower body's surface find the upper one's; augmented Lagrangian, Newton. Imports
nothing of the product.
"""

from __future__ import annotations

import sys
from typing import Any

import getfem as gf
import numpy as np

HELD, TOUCHING = 1, 2


def body(points: Any, tets: Any, held: Any, touching: Any) -> Any:
    """Mesh, P1 displacement field and given node of every scalar degree of freedom of one body."""
    mesh = gf.Mesh("empty", 3)
    corners = np.ascontiguousarray(points[tets].transpose(2, 1, 0)).reshape(3, 4, -1)
    mesh.add_convex(gf.GeoTrans("GT_PK(3,1)"), corners)
    node_of_pid = matching(points, mesh.pts().T)
    outer = mesh.outer_faces()
    for region, nodes in ((HELD, held), (TOUCHING, touching)):
        marked = np.isin(node_of_pid, nodes)
        faces = mesh.faces_from_pid(np.flatnonzero(marked))
        codes = np.array([[4], [1]])
        mesh.set_region(region, outer[:, np.isin((outer * codes).sum(axis=0), (faces * codes).sum(axis=0))])
    field = gf.MeshFem(mesh, 3)
    field.set_fem(gf.Fem("FEM_PK(3,1)"))
    scalar = gf.MeshFem(mesh, 1)
    scalar.set_fem(gf.Fem("FEM_PK(3,1)"))
    return mesh, field, scalar, matching(points, scalar.basic_dof_nodes().T)


def matching(points: Any, others: Any) -> Any:
    """Number in `points` of every row of `others`."""
    match = np.empty(len(points), int)
    match[np.lexsort(np.round(others, 6).T)] = np.lexsort(np.round(points, 6).T)
    if np.abs(points[match] - others).max() > 1e-9:
        raise ValueError("GetFEM's nodes are not the given ones")
    return match


def main(source: str, target: str) -> None:
    """Solve the problem in `source`; write displacements (n, 3) mm and the force between the bodies, kPa mm2."""
    data = np.load(source)
    model = gf.Model("real")
    model.add_initialized_data("lame", float(data["lame"]))
    model.add_initialized_data("shear", float(data["shear"]))
    bodies = []
    for number in (0, 1):
        mesh, field, scalar, node_of = body(
            *(data[f"{name}{number}"] for name in ("points", "tets", "held", "touching"))
        )
        rule = gf.MeshIm(mesh, gf.Integ("IM_TETRAHEDRON(6)"))
        name = f"u{number}"
        model.add_fem_variable(name, field)
        model.add_isotropic_linearized_elasticity_brick(rule, name, "lame", "shear")
        model.add_initialized_fem_data(f"imposed{number}", field, data[f"imposed{number}"][node_of].ravel())
        model.add_Dirichlet_condition_with_simplification(name, HELD, f"imposed{number}")
        bodies.append((mesh, field, scalar, node_of, rule))
    (_, field, _, _, rule), upper = bodies
    model.add_filtered_fem_variable("stress", field, TOUCHING)
    model.add_initialized_data("r", float(data["augmentation"]))
    contact = model.add_integral_large_sliding_contact_brick_raytracing("r", float(data["reach"]))
    model.add_slave_contact_boundary_to_large_sliding_contact_brick(contact, rule, TOUCHING, "u0", "stress")
    model.add_master_contact_boundary_to_large_sliding_contact_brick(contact, upper[4], TOUCHING, "u1")
    steps, converged = model.solve("max_iter", 100, "max_res", 1e-9, "lsolver", "mumps", "lsearch", "simplest")
    if not converged:
        raise RuntimeError(f"Newton did not converge in {steps} steps")
    answer = []
    for number, (_, _, _, node_of, _) in enumerate(bodies):
        u = np.empty((len(node_of), 3))
        u[node_of] = np.asarray(model.variable(f"u{number}")).reshape(-1, 3)
        answer.append(u)
    force = gf.asm_generic(rule, 0, "stress(3)", TOUCHING, model)
    np.savez(target, u=np.concatenate(answer), force=abs(float(np.ravel(force)[0])))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
