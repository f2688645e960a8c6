"""Measurements of the product, as commands: benchmarks, stability studies, chart, the paper's experiments, cohorts.

Rooms: bench (beside other programs), stability (where a part stops being right), chart (speed against accuracy), paper
(Alvarez 2021 repeated), cohort (many cases in one table). Nothing in a run imports them. Names are imported on first
use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vatsloc.lazy import on_first_use

if TYPE_CHECKING:
    from vatsloc.study.bench.fit import bench_fit
    from vatsloc.study.bench.poro import bench_poro
    from vatsloc.study.bench.real import bench_real
    from vatsloc.study.bench.registration import bench_registration
    from vatsloc.study.chart.chart import run_chart
    from vatsloc.study.cohort.cohort import run_cohort
    from vatsloc.study.cohort.suite import write_suite
    from vatsloc.study.paper.paper import run_paper
    from vatsloc.study.stability.faults import stability_faults
    from vatsloc.study.stability.fit import stability_fit

__all__ = [
    "bench_fit",
    "bench_poro",
    "bench_real",
    "bench_registration",
    "run_chart",
    "run_cohort",
    "run_paper",
    "stability_faults",
    "stability_fit",
    "write_suite",
]

__getattr__ = on_first_use(
    {
        "vatsloc.study.bench.fit": ("bench_fit",),
        "vatsloc.study.bench.poro": ("bench_poro",),
        "vatsloc.study.bench.real": ("bench_real",),
        "vatsloc.study.bench.registration": ("bench_registration",),
        "vatsloc.study.chart.chart": ("run_chart",),
        "vatsloc.study.cohort.cohort": ("run_cohort",),
        "vatsloc.study.cohort.suite": ("write_suite",),
        "vatsloc.study.paper.paper": ("run_paper",),
        "vatsloc.study.stability.faults": ("stability_faults",),
        "vatsloc.study.stability.fit": ("stability_fit",),
    }
)
