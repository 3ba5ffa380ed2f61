"""Queries: searches by phrases in a scene, and words for its contents."""
