"""The plugin's properties, camera rays for the current state of a scene, the composed image."""
