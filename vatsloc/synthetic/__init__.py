"""Synthetic cases: phantoms and twins written as case folders, collapsed or breathing."""
