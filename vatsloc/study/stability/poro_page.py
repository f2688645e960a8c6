"""What the tables of the poroelastic lung's stability say, in sentences that carry their numbers."""

from __future__ import annotations

from vatsloc.study.tables import Row, markdown


def page(result: dict[str, list[Row]], claims: dict[str, str]) -> str:
    """The study as a page of the documentation. claims: what each table shows, by name."""
    lines = ["# Where the poroelastic lung stops being right", ""]
    lines += ["Made by `vatsloc stability poro --out DIR` (about a minute), beside each table as CSV and the plots."]
    lines += ["The lung is 1 l with a bay for the heart and a dome for the diaphragm, 3,000 tetrahedra unless a table"]
    lines += ["says otherwise."]
    lines += ["", "What the tables say:", "", *(f"- {sentence}" for sentence in findings(result))]
    for name, rows in result.items():
        lines += ["", f"## {name}", claims[name], "", markdown(rows)]
    return "\n".join(lines) + "\n"


def findings(result: dict[str, list[Row]]) -> list[str]:
    """One sentence or two per table."""
    return [
        _pressure(result["pressure_bounds"]),
        _inverted(result["inverted_elements"]),
        _incompressible(result["towards_incompressible"]),
        _penalty(result["contact_methods"]),
        _meshes(result["contact_meshes"]),
        _slivers(result["slivers"]),
        _hila(result["small_hila"]),
    ]


def _pressure(rows: list[Row]) -> str:
    lumped, consistent = (-min(row[f"min_pa_{kind}"] for row in rows) for kind in ("lumped", "consistent"))
    return (
        f"Lumping the reaction keeps the pressure within {lumped:.1f} Pa of its range at every kappa_b; the consistent "
        f"matrix leaves it by up to {consistent:.0f} Pa once the layer is thinner than an element."
    )


def _inverted(rows: list[Row]) -> str:
    worst = max(row["linear_inverted_percent"] for row in rows)
    inverted = (
        f"up to {worst:.2g} % of this smooth lung's elements invert" if worst else "no element of this lung inverts"
    )
    more = max(row["finite_volume"] - row["linear_volume"] for row in rows)
    carried = sum(row["finite_load_carried"] == 1 for row in rows)
    return (
        f"In the linear model {inverted}; det F falls to "
        f"{min(row['linear_min_det'] for row in rows):.2f}, and the lung loses up to {100 * more:.0f} points more of "
        f"its volume than the neo-Hookean one, which carried the whole load at {carried} of {len(rows)} values."
    )


def _incompressible(rows: list[Row]) -> str:
    coarse, fine = (key for key in rows[0] if key.startswith("rel_error"))
    first, last = rows[0], rows[-1]
    return (
        f"Linear elements lock: the same volume-preserving motion is off by {100 * first[fine]:.0f} % on the fine mesh "
        f"at nu {first['poisson']} (order {first['order']:.1f}) and by {100 * last[fine]:.0f} % at nu "
        f"{last['poisson']}, where the fine mesh is no better than the coarse one ({100 * last[coarse]:.0f} %). At the "
        f"lung's 0.35 nothing of it shows; above 0.45 these elements should not be used."
    )


def _penalty(rows: list[Row]) -> str:
    soft = [row for row in rows if row["method"].startswith("penalty")]
    most = max(row["iterations"] for row in soft)
    held = [row for row in soft if row["iterations"] < most]
    exact = max(row["deepest_mm"] for row in rows if row["method"] == "active set")
    return (
        f"Penalty contact converges only while it is soft: {min(row['deepest_mm'] for row in held):.2f} mm of "
        f"penetration remain at the stiffest value that does, beyond which plain Newton cycles until it is stopped at "
        f"{most} steps. The active set leaves {exact:.0e} mm."
    )


def _meshes(rows: list[Row]) -> str:
    steps = sorted({row["iterations"] for row in rows})
    share = [row["touching_percent"] for row in rows]
    return (
        f"Contact takes {' or '.join(map(str, steps))} steps from {rows[0]['tets']} to {rows[-1]['tets']} tetrahedra, "
        f"touches {min(share):.0f} to {max(share):.0f} % of the wall, and the motion of {rows[0]['tets']} tetrahedra "
        f"is {rows[0]['off_finest_mm']:.1f} mm off the finest, that of {rows[-2]['tets']} "
        f"{rows[-2]['off_finest_mm']:.1f} mm (the hilum's faces differ between them too). A penalty of the same "
        f"stiffness lets finer meshes sink in deeper, {rows[0]['penalty_deepest_mm']:.2f} to "
        f"{rows[-1]['penalty_deepest_mm']:.2f} mm."
    )


def _slivers(rows: list[Row]) -> str:
    solved = [row for row in rows if row["multigrid_iterations"] != ">200"]
    worst, lost = solved[-1], len(rows) - len(solved)
    inverted = [row["min_dihedral"] for row in rows if row["min_det"] <= 0]
    return (
        f"Slivers cost multigrid steps ({rows[0]['multigrid_iterations']} at {rows[0]['min_dihedral']:.0f} degrees, "
        f"{worst['multigrid_iterations']} at {worst['min_dihedral']:.2g}, {lost} of {len(rows)} meshes not solved in "
        f"200), the factor a few digits (residual {rows[-1]['factor_residual']:.0e} at "
        f"{rows[-1]['min_dihedral']:.2g}) and contact no step; the answer moves by {worst['factor_off_mm']:.2f} mm in "
        f"the mean and {worst['factor_off_max_mm']:.1f} beside them. The elements themselves invert from "
        f"{max(inverted, default=0):.2g} degrees down, where det F no longer speaks of the lung."
    )


def _hila(rows: list[Row]) -> str:
    held = [row for row in rows if row["hung_min_det"] != "-"]
    turned = max((row["hilum_nodes"] for row in held if row["hung_min_det"] <= 0), default=0)
    refused = [row["hilum_nodes"] for row in rows if row["status"].startswith("refused")]
    return (
        f"A small hilum lets the lung swing on it without the wall ({held[0]['hung_mean_mm']:.0f} mm to "
        f"{held[-1]['hung_mean_mm'] / 1e3:.1f} m under linear strain), and elements invert from {turned} nodes down; "
        f"with the wall the answer hardly changes ({held[0]['gentle_mean_mm']:.1f} to "
        f"{held[-1]['gentle_mean_mm']:.1f} mm), and strongly collapsed the smallest det F falls from "
        f"{held[0]['strong_min_det']:.2f} to {held[-1]['strong_min_det']:.2f}. {refused[0]} nodes are refused."
    )
