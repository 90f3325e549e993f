"""From a scene and settings to complete caches."""
