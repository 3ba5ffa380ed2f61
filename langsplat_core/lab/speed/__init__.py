"""`langsplat bench`: speed against error."""
