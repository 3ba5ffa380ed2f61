"""Queries: phrases asked of a scene, and words for what is in it."""
