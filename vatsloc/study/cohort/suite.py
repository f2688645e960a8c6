"""The suite of phantoms: made in parallel, kept where it is already there, and a table of how hard its cases are."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from phantoms.recipes import SUITE
from vatsloc.synthetic.case import read_info, recipe, write_phantom
from vatsloc.workflow.stages import Say, quiet

_COLUMNS = {
    "rigid CT to inflated": lambda i: _two(i["pose_mm"][:2]),
    "rigid CT to deflated": lambda i: _two(i["total_mm"][:2]),
    "collapse": lambda i: _two(i["pneumothorax_mm"][:2]),
    "affine leaves %": lambda i: f"{100 * i['affine_share'][1]:.0f}",
    "wall slip": lambda i: _two(i["wall_slip_mm"][1][:2]),
    "lobes": lambda i: str(len(i["lobes"])),
    "fissures fused %": lambda i: f"{100 * i['spec']['fused']:.0f}",
    "fissure slip": lambda i: _two(i["fissure_slip_mm"][1][::2]),
    "volume ratio": lambda i: " / ".join(f"{v:.2f}" for v in i["volume_ratio"]),
    "diaphragm up": lambda i: _two(i["dome_mm"]),
    "landmarks": lambda i: str(i["n_landmarks"]),
    "s": lambda i: f"{i['seconds']:.0f}",
    "MB": lambda i: f"{i['peak_mb']:.0f}",
}


def write_suite(folder: Path, jobs: int = 1, say: Say = quiet, cbct: str | None = None) -> dict[str, dict[str, Any]]:
    """Make the cases of `SUITE` that `folder` lacks, `jobs` at once, each in a process of its own; truth/info.json of
    all of them by name. cbct: domain of the scanners, default those of the recipes."""
    missing = [name for name, seed in SUITE.items() if not _made(folder / name, recipe(name, seed, cbct))]
    say(f"{len(SUITE) - len(missing)} of {len(SUITE)} cases are there, {len(missing)} to make")
    with ProcessPoolExecutor(jobs, get_context("spawn"), max_tasks_per_child=1) as pool:
        running = {pool.submit(write_phantom, name, folder / name, SUITE[name], cbct=cbct): name for name in missing}
        for done in as_completed(running):
            done.result()
            say(f"{running[done]} written")
    return {name: read_info(folder / name) or {} for name in SUITE}


def table(suite: dict[str, dict[str, Any]]) -> str:
    """Markdown table, a line a case: mean / 95 % in mm at the landmarks where two numbers stand; fissure slip mean /
    max in mm; volume and diaphragm (mm) inflated / deflated; affine column and slips are those of the collapse."""
    lines = ["| case | " + " | ".join(_COLUMNS) + " |", "|---" * (len(_COLUMNS) + 1) + "|"]
    lines += [
        f"| {name} | " + " | ".join(cell(info) for cell in _COLUMNS.values()) + " |" for name, info in suite.items()
    ]
    shares = [info["affine_share"][1] for info in suite.values()]
    hard = sum(share > 0.2 for share in shares) / len(shares)
    lines.append("")
    lines.append(
        f"A rigid registration leaves {_span(suite, 'pose_mm')} mm from the CT to the inflated lung, "
        f"{_span(suite, 'total_mm')} mm to the collapsed one, {_span(suite, 'pneumothorax_mm')} mm between them."
    )
    lines.append(
        f"The best affine map leaves {100 * min(shares):.0f} to {100 * max(shares):.0f} % of the collapse, "
        f"more than 20 % in {100 * hard:.0f} % of the cases. Lobes slide along the fissures by up to "
        f"{max(info['fissure_slip_mm'][1][2] for info in suite.values()):.0f} mm."
    )
    return "\n".join(lines)


def _made(folder: Path, made_from: dict[str, Any]) -> bool:
    info = read_info(folder)
    return info is not None and all(info.get(key) == value for key, value in made_from.items())


def _span(suite: dict[str, dict[str, Any]], motion: str) -> str:
    """Least and greatest mean of a motion over the cases, mm."""
    means = [info[motion][0] for info in suite.values()]
    return f"{min(means):.1f} to {max(means):.1f}"


def _two(pair: list[float]) -> str:
    return " / ".join(f"{v:.1f}" for v in pair)
