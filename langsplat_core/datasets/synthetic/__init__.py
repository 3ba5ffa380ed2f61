"""A procedural room with labelled objects, photographed by ray casting: the demo data and its truth."""
