"""Benchmarks of this project in rooms with known truth, and of its speed and memory at large sizes.

They run from a checkout: `python -m tests.benchmarks --help`; no part of them is installed.
"""
