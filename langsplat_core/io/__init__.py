"""Files: scenes in every supported format, their companions, tables, images; whole or damaged."""
