"""Files that the window reads and writes beside scenes."""

PROJECTS = ".langsplat"  # suffix of project files
