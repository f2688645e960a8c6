"""A DICOM node: scans are pushed to it, answers are sent back. Needs the extra `dicom`.

`store` keeps on disk what has arrived, `arrival` says which series are whole, `roles` what each is, `progress` takes a
patient one step further, `server` and `sending` speak to the network, `listen` runs it all. Names are imported on
first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vatsloc.lazy import on_first_use

if TYPE_CHECKING:
    from vatsloc.dicomnet.listen import Node, listen
    from vatsloc.dicomnet.nodule import NoduleFiles
    from vatsloc.dicomnet.sending import Target
    from vatsloc.dicomnet.work import Work

__all__ = ["Node", "NoduleFiles", "Target", "Work", "listen"]

__getattr__ = on_first_use(
    {
        "vatsloc.dicomnet.listen": ("Node", "listen"),
        "vatsloc.dicomnet.nodule": ("NoduleFiles",),
        "vatsloc.dicomnet.sending": ("Target",),
        "vatsloc.dicomnet.work": ("Work",),
    }
)
