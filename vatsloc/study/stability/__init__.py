"""Stability: where a part of the method stops being right, and whether a run notices."""
