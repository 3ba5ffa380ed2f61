"""The workshop: our own world, the demo encoder, measurements of ourselves. Only `cli` imports it."""
