"""What stands in a room: builders of every class of thing."""
