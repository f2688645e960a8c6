"""What the stage `check` finds left over, beside the true error at the same places."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from registration.volume import Array
from vatsloc.case import read_case
from vatsloc.evaluation.inputs import read_truth
from vatsloc.study.tables import Row, markdown
from vatsloc.workflow.localization import Localization
from vatsloc.workflow.localize import localize
from vatsloc.workflow.settings import Settings
from vatsloc.workflow.stages import Say, Stages, quiet

AGREE_MM = 0.5
"""Check and truth agree where their medians are no further apart than this."""
BESIDE_TRUTH = (
    "What the check finds left over in undisturbed runs, beside the true error at the same places (mean of the "
    "four nearest points of dense truth, weighted by distance), median / 90 % in mm:"
)


def bench_check(cases: Sequence[Path], settings: Settings, say: Say = quiet) -> dict[str, Any]:
    """Run each case and compare: `rows` of `beside_truth`, and `agree`, how many of them agree within 0.5 mm.

    Cases without dense truth have no rows. Raises CaseError and InputRefused as reading does.
    """
    rows: list[Row] = []
    for folder in cases:
        say(f"{folder.name} ...")
        found = localize(read_case(folder), settings, Stages())
        rows += [{"case": folder.resolve().name} | row for row in beside_truth(found, read_truth(folder).dense)]
    return {"rows": rows, "agree": sum(row["medians apart"] <= AGREE_MM for row in rows)}


def table(result: dict[str, Any]) -> str:
    """The rows as markdown, with how many of them agree."""
    rows = result["rows"]
    if not rows:
        return "No case has dense truth."
    told = f"Medians agree within {AGREE_MM:g} mm in {result['agree']} of {len(rows)} rows."
    return f"{BESIDE_TRUTH}\n\n{markdown(rows)}\n\n{told}"


def beside_truth(found: Localization, dense: Array | None) -> list[Row]:
    """What the check of a run found left over, a row each for phase 1 and the chain, beside the true error there.

    dense: (n, 3, 3) tissue points in CT, inflated and deflated CBCT, or None: no rows.
    """
    if dense is None or found.checks is None:
        return []
    rows: list[Row] = []
    for part, left, carry, image in (
        ("phase 1", found.checks.phase1, found.pose.inf_from_ct, 1),
        ("chain", found.checks.chain, found.def_from_ct, 2),
    ):
        if left is None:
            continue
        error = carry(dense[:, 0]) - dense[:, image]
        distance, number = cKDTree(dense[:, image]).query(left.points, 4)
        weight = 1 / (distance + 1) ** 2
        true = (error[number] * weight[..., None]).sum(axis=1) / weight.sum(axis=1, keepdims=True)
        rows.append(
            {
                "part": part,
                "looked for": left.looked_for,
                "recognized": len(left.points),
                "left over": _median_and_90(left.vectors),
                "true error": _median_and_90(true),
                "difference of both vectors": _median_and_90(left.vectors - true),
                "medians apart": round(abs(_median(left.vectors) - _median(true)), 2),
            }
        )
    return rows


def _median_and_90(vectors: Array) -> str:
    return " / ".join(f"{mm:.2f}" for mm in np.percentile(np.linalg.norm(vectors, axis=1), (50, 90)))


def _median(vectors: Array) -> float:
    return float(np.median(np.linalg.norm(vectors, axis=1)))
