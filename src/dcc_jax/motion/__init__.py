"""Motion: clips of the character, importers, retargeting, and our own clips."""
