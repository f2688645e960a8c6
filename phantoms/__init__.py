"""Thoraces drawn from a seed, with collapse known at every point: arrays and points in RAS mm, no files."""

from phantoms.case import PhantomCase, make_case
from phantoms.spec import SPECS, SUITE, PhantomSpec

__all__ = ["SPECS", "SUITE", "PhantomCase", "PhantomSpec", "make_case"]
