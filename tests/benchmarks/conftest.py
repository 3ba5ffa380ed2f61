"""Rooms that train in seconds."""

from tests.support.tiny_room import rough_colours

__all__ = ["rough_colours"]
