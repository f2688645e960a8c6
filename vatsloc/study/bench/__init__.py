"""Benchmarks: this program beside others, in seconds, memory and error."""
