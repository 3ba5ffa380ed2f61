"""Files: scenes in every supported format, their companions, tables, pictures; whole or damaged."""
