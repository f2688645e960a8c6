"""A page in a headless browser: what became of it, what was logged, what was asked of the network."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)


def visit(page: Path, folder: Path, fragment: str = "", size: str = "1280,800") -> tuple[str, str, str]:
    """The document after its scripts ran, what the browser logged, and what it asked of the network."""
    assert CHROMIUM is not None
    log = folder / "net.json"
    command = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"]
    command += ["--disable-background-networking", "--disable-component-update", "--disable-sync"]
    command += ["--enable-logging=stderr", f"--user-data-dir={folder / 'profile'}", f"--log-net-log={log}"]
    command += [f"--window-size={size}", "--virtual-time-budget=2000", "--dump-dom", f"{page.as_uri()}{fragment}"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    return done.stdout, done.stderr, log.read_text(encoding="utf-8")


def printed(page: Path, folder: Path) -> Path:
    """The page as PDF, as it is printed."""
    assert CHROMIUM is not None
    pdf = folder / "page.pdf"
    command = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"]
    command += ["--disable-background-networking", "--disable-component-update", "--disable-sync"]
    command += [f"--user-data-dir={folder / 'profile'}", "--window-size=1280,800", "--virtual-time-budget=2000"]
    command += ["--no-pdf-header-footer", f"--print-to-pdf={pdf}", page.as_uri()]
    subprocess.run(command, capture_output=True, timeout=120, check=True)
    return pdf


def asked_by_the_page(network: str) -> set[str]:
    """Origins of requests in a network log but the browser's own."""
    return set(re.findall(r'"initiator":"([^"]*)"', network)) - {"not an origin"}
