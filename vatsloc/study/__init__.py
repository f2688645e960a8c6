"""Benchmarks, stability studies, charts and cohorts: commands that measure the product."""
