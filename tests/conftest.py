"""Fixtures for every test."""

from tests.gl_context import gl, gl_session

__all__ = ["gl", "gl_session"]
