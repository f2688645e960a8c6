"""Synthetic cases whose truth comes from other physics than the product solves."""
