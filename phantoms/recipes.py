"""The phantoms that there are: named choices of person, side, nodule, disease, collapse, voxels and scanner."""

from __future__ import annotations

from dataclasses import replace

from phantoms.cbct import Flaws, Scanner
from phantoms.spec import Collapse, Disease, Lesion, PhantomSpec

_SMALL = PhantomSpec("small", "right", ct_spacing=(1.5, 1.5, 2.0), cbct_spacing=(1.5, 1.5, 1.5), element=18.0)
_CO2 = Collapse(dome_rise=-14.0, shift=18.0, gas="co2")

_C_ARM = Scanner(domain="projection")
_POOR = Scanner(domain="projection", noise=30.0, flaws=Flaws(scatter=0.05, heart=8.0, ports=3, gain=0.93, offset=30.0))
_OVER = Scanner(
    domain="projection", noise=24.0, flaws=Flaws(scatter=-0.01, heart=6.0, ports=2, gain=1.06, offset=-25.0)
)
_HARD = (
    PhantomSpec(
        "lobes-apart-left",
        "left",
        fused=0.05,
        lesion=Lesion(depth=9.0, radius=6.0, seen="ct"),
        collapse=Collapse(0.86, 0.30, 12.0, 26.0, patchiness=0.8, lobes_apart=0.25, airless=0.35, vessels=0.5),
        scanner=_POOR,
    ),
    PhantomSpec(
        "lobes-apart-right",
        "right",
        fused=0.1,
        lesion=Lesion(depth=7.0, radius=5.0, seen="ct and inflated"),
        collapse=Collapse(0.86, 0.28, 10.0, 24.0, lobes_apart=0.3, airless=0.30, vessels=0.5),
        scanner=_OVER,
    ),
    PhantomSpec(
        "total-collapse",
        "left",
        fused=0.6,
        lesion=Lesion(depth=11.0, radius=6.0, seen="ct"),
        collapse=Collapse(0.87, 0.25, 14.0, 28.0, patchiness=0.6, airless=0.50, vessels=0.5),
        scanner=_C_ARM,
    ),
    PhantomSpec(
        "airless-left",
        "left",
        lesion=Lesion(depth=6.0, radius=5.0, seen="ct and inflated"),
        collapse=Collapse(0.87, 0.46, 10.0, 28.0, airless=0.40, vessels=0.6),
        scanner=replace(_POOR, flaws=Flaws(0.06, heart=8.0, ports=4, gain=0.90, offset=40.0)),
    ),
    PhantomSpec(
        "airless-right",
        "right",
        fused=0.4,
        lesion=Lesion(depth=14.0, radius=6.0, seen="ct"),
        collapse=Collapse(0.86, 0.36, 8.0, 24.0, lobes_apart=0.15, airless=0.50, vessels=0.5),
        scanner=_OVER,
    ),
    PhantomSpec(
        "effusion",
        "right",
        fused=0.3,
        lesion=Lesion(depth=8.0, radius=6.0),
        collapse=Collapse(0.86, 0.36, 8.0, 22.0, lobes_apart=0.1, airless=0.25, vessels=0.7, fluid=45.0),
        scanner=_C_ARM,
    ),
    PhantomSpec(
        "emphysema",
        "left",
        fused=0.5,
        lesion=Lesion(depth=12.0, radius=7.0, seen="ct and inflated"),
        disease=Disease(emphysema=0.35),
        collapse=Collapse(0.88, 0.50, 6.0, 24.0, airless=0.15, vessels=0.8),
        scanner=_C_ARM,
    ),
    PhantomSpec(
        "fibrosis",
        "right",
        fused=0.3,
        size=0.85,
        lesion=Lesion(depth=10.0, radius=5.0, seen="ct"),
        disease=Disease(fibrosis=0.40),
        collapse=Collapse(0.82, 0.36, 6.0, 22.0, lobes_apart=0.15, stiffness=2.5, airless=0.20, vessels=0.7),
        scanner=_POOR,
    ),
    PhantomSpec(
        "child",
        "right",
        ct_spacing=(0.8, 0.8, 1.2),
        cbct_spacing=(0.8, 0.8, 0.8),
        fused=0.2,
        size=0.68,
        lesion=Lesion(depth=5.0, radius=4.0, seen="ct"),
        collapse=Collapse(0.86, 0.36, 10.0, 24.0, lobes_apart=0.1, airless=0.25, vessels=0.7),
        scanner=Scanner(fov=180.0, length=130.0, domain="projection", flaws=Flaws(heart=4.0, ports=2)),
    ),
    PhantomSpec(
        "large-chest",
        "left",
        fused=0.3,
        size=1.16,
        lesion=Lesion(depth=16.0, radius=8.0, seen="ct and inflated"),
        collapse=Collapse(0.86, 0.38, 10.0, 26.0, airless=0.30, vessels=0.6),
        scanner=_POOR,
    ),
)
SPECS = {
    s.name: s
    for s in (
        replace(_SMALL, name="demo", collapse=Collapse(inflated=0.89, deflated=0.55, patchiness=0.6)),
        replace(_SMALL, name="small-right"),
        replace(_SMALL, name="small-left", side="left"),
        PhantomSpec(
            "right",
            "right",
            fused=0.5,
            lesion=Lesion(depth=13.0, seen="ct and inflated"),
            collapse=Collapse(shift=24.0, lobes_apart=0.1),
            scanner=_C_ARM,
        ),
        PhantomSpec(
            "left",
            "left",
            lesion=Lesion(depth=25.0),
            collapse=Collapse(inflated=0.85, deflated=0.46, shift=32.0, patchiness=0.3),
        ),
        PhantomSpec(
            "small-collapse",
            "right",
            fused=0.8,
            lesion=Lesion(depth=8.0, radius=6.0, seen="ct"),
            scanner=_C_ARM,
            collapse=Collapse(deflated=0.64, dome_rise=3.0, shift=24.0, patchiness=0.6),
        ),
        PhantomSpec(
            "near-total-collapse",
            "left",
            fused=0.2,
            collapse=Collapse(deflated=0.40, dome_rise=12.0, shift=30.0, patchiness=0.5, lobes_apart=0.1),
        ),
        PhantomSpec(
            "co2-right",
            "right",
            fused=0.3,
            lesion=Lesion(depth=20.0, radius=6.0, seen="ct and inflated"),
            collapse=_CO2,
            scanner=_C_ARM,
        ),
        PhantomSpec("co2-left", "left", lesion=Lesion(radius=10.0), collapse=replace(_CO2, deflated=0.46, shift=30.0)),
        PhantomSpec(
            "high-diaphragm",
            "right",
            "obese",
            lesion=Lesion(depth=10.0, seen="ct and inflated"),
            collapse=Collapse(dome_rise=14.0, shift=22.0),
            scanner=replace(_C_ARM, noise=26.0),
        ),
        PhantomSpec(
            "apex",
            "left",
            view=(0.0, 0.0, 45.0),
            fused=0.4,
            lesion=Lesion(place="apex", depth=12.0, radius=7.0),
            collapse=Collapse(deflated=0.48, shift=29.0),
        ),
        PhantomSpec(
            "base",
            "right",
            fused=0.0,
            lesion=Lesion(place="base", depth=10.0),
            collapse=Collapse(shift=19.0, lobes_apart=0.1),
        ),
        PhantomSpec(
            "ground-glass",
            "right",
            lesion=Lesion("ground-glass", depth=14.0, radius=7.0, seen="ct"),
            collapse=Collapse(deflated=0.48, shift=32.0, patchiness=0.4),
        ),
        PhantomSpec(
            "part-solid",
            "left",
            fused=0.4,
            lesion=Lesion("part-solid", depth=12.0, radius=9.0),
            collapse=Collapse(shift=25.0),
            scanner=_C_ARM,
        ),
        PhantomSpec(
            "tight-view",
            "left",
            view=(0.0, 0.0, 38.0),
            lesion=Lesion(radius=7.0),
            collapse=Collapse(inflated=0.89, deflated=0.42, dome_rise=14.0, shift=38.0),
            scanner=Scanner(fov=190.0, length=130.0),
        ),
        PhantomSpec(
            "poor-dose",
            "left",
            fused=0.6,
            lesion=Lesion(depth=9.0, radius=6.0, seen="ct and inflated"),
            collapse=Collapse(deflated=0.49, shift=26.0),
            scanner=Scanner(noise=60.0),
        ),
        PhantomSpec(
            "atelectasis",
            "right",
            fused=0.5,
            collapse=Collapse(shift=16.0, atelectasis=0.10),
            scanner=_C_ARM,
        ),
        PhantomSpec(
            "too-little-seen",
            "right",
            view=(36.0, 0.0, -44.0),
            refused=True,
            collapse=Collapse(shift=7.0),
            scanner=Scanner(fov=120.0, length=80.0),
        ),
        PhantomSpec(
            "stiff-lung",
            "right",
            collapse=Collapse(
                inflated=0.91, deflated=0.58, dome_rise=14.0, shift=21.0, patchiness=0.3, stiffness=4.0, root=0.01
            ),
        ),
        PhantomSpec(
            "adhesion",
            "left",
            view=(0.0, 0.0, 24.0),
            fused=0.1,
            collapse=Collapse(deflated=0.42, shift=32.0, lobes_apart=0.1, adhesion=28.0),
        ),
        *_HARD,
    )
}
SUITE = {name: 100 + n for n, name in enumerate(list(SPECS)[3:])}
"""Cases that cover the clinic, by name, and the seed of each one's person."""
