"""Pictures of scenes and models."""
