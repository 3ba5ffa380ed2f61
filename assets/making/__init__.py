"""How the bundled files were made: procedural rooms, the demo encoder's training, the demo scene.

It runs from a checkout (`python -m assets.making --help`); no part of it is installed.
"""
