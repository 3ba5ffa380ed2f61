"""Masks of photographs, image-text encoders, and the features that they give."""
