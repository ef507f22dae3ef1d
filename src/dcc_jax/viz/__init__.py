"""Pictures of a scene, from plain arrays."""
