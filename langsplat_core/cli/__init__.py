"""The `langsplat` commands; `app` gathers them, `run` is how every command ends."""
