"""The image-domain cone-beam scanner of the phantoms beside the projection-domain one, on the same collapsed lung."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from phantoms.case import make_case
from phantoms.cbct import expose
from phantoms.imaging import image_state
from phantoms.projection import c_arm_of, develop, project, scene_grid
from phantoms.recipes import SPECS
from phantoms.scanner_figures import scanner_figures
from phantoms.thorax import ct_grid, draw_thorax, image_body
from phantoms.voxels import Image
from vatsloc.errors import CaseError
from vatsloc.synthetic.case import scanned
from vatsloc.workflow.stages import Say, quiet


def bench_cbct(name: str = "demo", seed: int = 0, say: Say = quiet) -> dict[str, Any]:
    """Figures of `scanner_figures` and seconds by domain for the collapsed lung of a phantom.

    Raises CaseError for an unknown name.
    """
    if name not in SPECS:
        raise CaseError(f'"{name}" is no phantom; choose one of {", ".join(SPECS)}.')
    spec = scanned(SPECS[name], "projection")
    case = make_case(SPECS[name], seed)
    thorax = draw_thorax(spec.side, spec.habitus, spec.lesion, seed, spec.fused)
    grid = ct_grid(thorax, spec.ct_spacing)
    other = "left" if spec.side == "right" else "right"
    body = Image(image_body(thorax, grid, (other,)), grid.ras_from_ijk)
    view = case.cbct_deflated.grid
    clean = image_state(case.patient, body, case.deflated, view).clean
    scanner = spec.scanner
    say("image domain ...")
    start = time.perf_counter()
    shots = [expose(clean, scanner, np.random.default_rng(n)) for n in (1, 2)]
    middle = time.perf_counter()
    say("projection domain ...")
    scene = image_state(case.patient, body, case.deflated, scene_grid(view)).clean
    arm = c_arm_of(scanner, float(view.spacing.mean()))
    exact = project(scene, arm)
    projected = time.perf_counter()
    seen = [develop(exact, view, scanner, np.random.default_rng(n), arm) for n in (1, 2)]
    end = time.perf_counter()
    return {
        "case": f"{name}, seed {seed}",
        "image": scanner_figures(clean, (shots[0], shots[1]), scanner.fov, scanner.end),
        "projection": scanner_figures(clean, (seen[0], seen[1]), scanner.fov, scanner.end),
        "seconds": {"image": (middle - start) / 2, "projection": projected - middle + (end - projected) / 2},
    }


def table(result: dict[str, Any]) -> str:
    """Markdown table, a line a figure: errors and noise in HU, grain in mm."""
    lines = [f"| {result['case']} | image domain | projection domain |", "|---|---|---|"]
    lines += [
        f"| {name} | {_number(name, value)} | {_number(name, result['projection'][name])} |"
        for name, value in result["image"].items()
    ]
    seconds = result["seconds"]
    lines.append(f"| seconds an image | {seconds['image']:.1f} | {seconds['projection']:.0f} |")
    return "\n".join(lines)


def _number(name: str, value: float) -> str:
    return f"{value:.2f}" if name.startswith("grain") else f"{value:.0f}"
