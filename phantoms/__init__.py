"""Thoraces drawn from a seed, with collapse known at every point: arrays and points in RAS mm, no files."""

from phantoms.case import PhantomCase, make_case
from phantoms.recipes import SPECS, SUITE
from phantoms.spec import PhantomSpec

__all__ = ["SPECS", "SUITE", "PhantomCase", "PhantomSpec", "make_case"]
