"""The answer on a navigation screen, by OpenIGTLink. Needs the extra `navigation`. Names are imported on first use."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vatsloc.lazy import on_first_use

if TYPE_CHECKING:
    from vatsloc.navigation.messages import messages_of
    from vatsloc.navigation.server import Link, serving

__all__ = ["Link", "messages_of", "serving"]

__getattr__ = on_first_use(
    {
        "vatsloc.navigation.messages": ("messages_of",),
        "vatsloc.navigation.server": ("Link", "serving"),
    }
)
