"""From another skeleton's motion to a clip of the character."""
