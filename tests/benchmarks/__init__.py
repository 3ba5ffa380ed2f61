"""Benchmarks in rooms with known truth and at large sizes, not installed: `python -m tests.benchmarks -h`."""
