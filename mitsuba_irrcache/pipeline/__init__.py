"""From a scene and settings to complete caches; defaults; progressive runs."""
