"""Which pictures the state asks for, and what they depend on."""
