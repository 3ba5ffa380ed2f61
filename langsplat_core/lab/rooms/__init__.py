"""`langsplat eval synthetic`: the method measured in fresh rooms, beside oracles."""
