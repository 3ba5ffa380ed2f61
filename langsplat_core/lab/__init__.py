"""Measurements of ourselves. Only `cli` imports it."""
