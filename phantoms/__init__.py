"""Thoraces drawn from a seed, with collapse known at every point: arrays and points in RAS mm, no files."""

from phantoms.case import SPECS, PhantomCase, PhantomSpec, make_case

__all__ = ["SPECS", "PhantomCase", "PhantomSpec", "make_case"]
