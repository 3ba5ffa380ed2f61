"""Browser code of an exported scene: plain JavaScript modules, inlined by `pipeline.webpage`."""
