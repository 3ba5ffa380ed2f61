"""From photographs to a searchable scene, and what is made of a finished one."""
