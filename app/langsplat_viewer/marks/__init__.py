"""Which Gaussians are selected, hidden and deleted, and the tools that say so."""
