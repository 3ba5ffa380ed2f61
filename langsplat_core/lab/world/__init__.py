"""Procedural rooms with labelled objects, photographed by ray casting: demo data and its truth."""
