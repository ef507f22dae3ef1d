"""Files of other programs: each reader returns a skeleton and its motion."""
